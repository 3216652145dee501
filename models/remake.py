"""Remake the trained model of this folder: ``python models/remake.py [FOLDER]`` (a minute and a half of one core).

It learns from six simulated flights of 30 s at 10 frames/s (stereo tracks and IMU, no pictures) and is judged by
leaving each flight out in turn; the scores are in the card beside the model.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from gpvo.io import open_source
from gpvo.io.run import Run, read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import rows_path, save_model
from gpvo.learning.train import train
from gpvo.runner import run
from gpvo.sim.points import simulate_points

FLIGHTS = 6
# File name to the scenarios that its flights are drawn from in turn.
MODELS = {
    "tunnel": ("tunnel-bursts", "tunnel-bursts", "tunnel-clean", "tunnel-noise"),
}


def fly(scenarios: tuple[str, ...], folder: Path) -> list[Run]:
    """Simulate the flights and run the odometry over each."""
    runs = []
    for k in range(FLIGHTS):
        scenario = scenarios[k % len(scenarios)]
        name = f"{scenario}-{200 + k}"
        tracks = simulate_points(scenario, 200 + k, duration_s=30.0, rate_hz=10.0).save(folder / f"{name}.npz")
        run(open_source(tracks), folder / name)
        runs.append(read_run(folder / name))
    return runs


def remake(name: str, folder: Path) -> Path:
    """Write ``folder/name.gpvo`` and its card."""
    with tempfile.TemporaryDirectory() as temporary:
        trained = train(fly(MODELS[name], Path(temporary)), TrainConfig(jobs=2))
    path = folder / f"{name}.gpvo"
    save_model(trained, path)
    # Larger than the model, and they follow from the seeds above.
    rows_path(path).unlink()
    return path


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    target.mkdir(parents=True, exist_ok=True)
    for model in MODELS:
        print(remake(model, target))

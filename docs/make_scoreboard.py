"""The scoreboard of the documentation: ``python docs/make_scoreboard.py`` (a few minutes).

The five small flights of ``data/`` are simulated again, with what odometry saw. Each is left out in turn: a model
learns from the other four, and every method states its covariances of the flight left out. ``gpvo score`` then judges
the files alone.
"""

from __future__ import annotations

import runpy
import shutil
import sys
import tempfile
from pathlib import Path

from baselines import baselines
from gpvo.dataset.build import build_run, leave_out
from gpvo.dataset.errors import motion_errors
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.score import score_folder, write_board, write_statements
from gpvo.io.run import Run, read_run, read_tracks
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import save_model
from gpvo.learning.train import train_sets
from gpvo.online.predictor import Predictor
from gpvo.twin.replicate import TwinSettings, make_twins

ROOT = Path(__file__).parents[1]


def fly(folder: Path) -> list[Run]:
    """The flights of ``data/`` as run folders with tracks."""
    made = runpy.run_path(str(ROOT / "data" / "remake.py"))
    return [read_run(made["remake"](name, folder, keep_tracks=True)) for name in made["FLIGHTS"]]


def state(folder: Path) -> None:
    """Files of what every method states of every flight."""
    for (run,), others in leave_out(fly(folder / "runs")):
        training = [build_run(other) for other in others]
        save_model(train_sets(training, TrainConfig(), judge=False), folder / "model.gpvo")
        predictor = Predictor.load(folder / "model.gpvo")
        assert run.truth is not None
        twins = [read_run(p) for p in make_twins(run.path, folder / "twins" / run.name, TwinSettings())]
        further = baselines(
            run.log, motion_errors(run.log, run.truth), training, tracks=read_tracks(run.path), twins=twins
        )
        write_statements(evaluate_run(run, predictor, further=further), folder / "stated", run.name)


if __name__ == "__main__":
    out = Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parent / "scoreboard"
    with tempfile.TemporaryDirectory() as scratch:
        state(Path(scratch))
        shutil.rmtree(out / "stated", ignore_errors=True)
        shutil.copytree(Path(scratch) / "stated", out / "stated")
    write_board(score_folder(out / "stated"), out)

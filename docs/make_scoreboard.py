"""The scoreboard of the documentation: ``python docs/make_scoreboard.py`` (a few minutes).

Each of the five small flights of ``data/`` is left out in turn: a model learns from the other four, and every method
states its covariances of the flight left out. ``gpvo score`` then judges the files alone.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from gpvo.dataset.build import build_run
from gpvo.dataset.errors import motion_errors
from gpvo.dataset.splits import leave_one_out
from gpvo.evaluation.baselines import baselines
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.score import score_folder, write_board, write_statements
from gpvo.io.run import read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import save_model
from gpvo.learning.train import train_sets
from gpvo.online.predictor import Predictor

ROOT = Path(__file__).parents[1]
FLIGHTS = ("tunnel-1", "tunnel-2", "tunnel-3", "tunnel-4", "unseen")


def state(folder: Path) -> None:
    """Files of what every method states of every flight."""
    for run, others in leave_one_out([read_run(ROOT / "data" / name) for name in FLIGHTS]):
        training = [build_run(other) for other in others]
        save_model(train_sets(training, TrainConfig(), judge=False), folder / "model.gpvo")
        predictor = Predictor.load(folder / "model.gpvo")
        assert run.truth is not None
        further = baselines(run.log, motion_errors(run.log, run.truth), training)
        write_statements(evaluate_run(run, predictor, further=further), folder / "stated", run.name)


if __name__ == "__main__":
    out = Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parent / "scoreboard"
    with tempfile.TemporaryDirectory() as scratch:
        state(Path(scratch))
        write_board(score_folder(Path(scratch) / "stated"), out)

"""A small trained model, shared by the tests of learning and prediction."""

from __future__ import annotations

from functools import cache

from gpvo.dataset.build import TrainingSet, build
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import TrainedModel, train_sets
from synthetic_runs import make_run


def training_sets(seeds, **options) -> list[TrainingSet]:
    return [build(*make_run(s, **options), name=f"flight{s}") for s in seeds]


@cache
def small_model() -> TrainedModel:
    """Trained once per test process on four short flights with geometric covariances."""
    config = TrainConfig(features="velocity,rotation,n_inliers")
    return train_sets(training_sets(range(4), n=300), config, judge=False)

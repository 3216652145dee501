"""Another odometry's flight as messages, and a model of it."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from bag_maker import BagMaker
from gpvo.dataset.build import build
from gpvo.geometry import se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.live.engine import Engine, Health
from gpvo.live.intake import Arrival
from gpvo.live.stages import PoseStage
from gpvo.online import modelfile
from gpvo.online.predictor import Predictor
from gpvo.publish.odometry import Odometry
from synthetic_runs import make_run

TOPIC = "/vio/odometry"
STATED = np.diag([1e-4, 2e-4, 3e-4, 4e-5, 5e-5, 6e-5])


@cache
def _trained() -> Any:
    sets = [build(*make_run(s, n=300, geometry=False), name=f"flight{s}") for s in range(3)]
    config = TrainConfig(features="velocity,rotation")
    return train_sets(sets, config, judge=False)


def shim_predictor() -> Predictor:
    return _trained().predictor()


def save_model(path: Path) -> Path:
    model = _trained()
    modelfile.save(path, model.arrays, model.header)
    return path


def flight(seed: int = 9, n: int = 120, rate_hz: float = 20.0, t0_ns: int = 1_700_000_000_000_000_000):
    """Stamps and body poses (n, 4, 4) in ``odom``, which starts turned and away from its origin."""
    log, _ = make_run(seed, n=n, rate_hz=rate_hz, geometry=False)
    start = se3.exp(np.array([3.0, -2.0, 1.0, 0.1, -0.2, 2.0]))
    T = start @ T_FLU_OPTICAL @ log.trajectory() @ se3.inverse(T_FLU_OPTICAL)
    return t0_ns + np.arange(len(T)) * round(1e9 / rate_hz), T


def messages(
    stamps, T, *, twist_covariance: np.ndarray | None = None, ros1: bool = False, child: str = "base_link"
) -> BagMaker:
    """``nav_msgs/Odometry`` on TOPIC, without a covariance unless one of the twist is given."""
    maker = BagMaker(ros1)
    C = np.zeros((6, 6)) if twist_covariance is None else twist_covariance
    for t, pose in zip(stamps, T, strict=True):
        maker.odometry(TOPIC, int(t), pose, np.zeros((6, 6)), C, child)
    return maker


def flown(stamps, T, **options: Any) -> list[Arrival]:
    """The same as arrivals, each received a millisecond after its stamp."""
    rows = messages(stamps, T, **options).messages
    return [Arrival(topic, m, t + 1_000_000) for t, topic, m in rows]


class Kept:
    """An output that keeps everything."""

    def __init__(self) -> None:
        self.frames: list[Odometry] = []
        self.reports: list[Health] = []

    def odometry(self, odometry: Odometry) -> None:
        self.frames.append(odometry)

    def health(self, health: Health) -> None:
        self.reports.append(health)

    def close(self) -> None:
        pass


def engine(predictor: Predictor | None = None, **more: Any) -> tuple[Engine, Kept, list[str]]:
    kept, told = Kept(), []
    return Engine(PoseStage(TOPIC), predictor or shim_predictor(), [kept], tell=told.append, **more), kept, told

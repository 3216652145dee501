"""What ``gpvo live`` keeps in a file, so that a restart continues from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpvo.errors import GpvoError
from gpvo.files import read_json, write_json
from gpvo.geometry.covariance import are_positive_definite, symmetrise
from gpvo.geometry.se3 import is_rigid
from gpvo.io.trajectory import FARTHEST_M
from gpvo.types import Array


@dataclass(frozen=True)
class State:
    """Pose (4, 4) and its covariance (6, 6) in ``odom``, and the scale (6,) of sigma that late truth taught."""

    T_odom_body: Array
    pose_covariance: Array
    scale: Array


def save_state(path: Path, state: State) -> None:
    """Write it, whole or not at all."""
    write_json(path, {"schema": 1, **vars(state)})


def load_state(path: Path | None) -> State | None:
    """Of a state file; None where there is none yet. Raises GpvoError, one line, for a pose, covariance or scale that
    cannot be."""
    if path is None or not path.exists():
        return None
    try:
        document = read_json(path)
        T, C = (np.array(document[k], dtype=np.float64) for k in ("T_odom_body", "pose_covariance"))
        scale = np.array(document.get("scale", np.ones(6)), dtype=np.float64)
        if T.shape != (4, 4) or not is_rigid(T, FARTHEST_M):
            raise ValueError("it holds no pose")
        if C.shape != (6, 6) or not are_positive_definite(C[None], semi=True).all():
            raise ValueError("its covariance is not positive semidefinite")
        if scale.shape != (6,) or not ((scale > 1e-3) & (scale < 1e3)).all():
            raise ValueError("it holds an impossible scale")
    except (GpvoError, ValueError, KeyError, TypeError) as error:
        raise GpvoError(f"is not a state file of gpvo live: {error}", where=path, cure="remove it") from None
    return State(T, symmetrise(C), scale)

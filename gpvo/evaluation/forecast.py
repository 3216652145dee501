"""The covariance that odometry would have along a planned path.

The plan says how fast the camera moves and turns. What else the model looks at (points, texture, noise) is not known
before the flight: it is drawn, several times, from training rows of like motion, and each draw keeps to few training
sequences, so that what differs between flights stays together along the path. Draws are joined by the law of total
variance, the mean of their covariances: a model states no mean error that could differ between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.accumulation import along
from gpvo.errors import GpvoError, SourceError
from gpvo.geometry import se3
from gpvo.geometry.covariance import position_in_world, symmetrise, variances
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.trajectory import Trajectory, read_tum
from gpvo.learning.sample import TrainingSample
from gpvo.online.base import TWIST_COLUMNS, positions
from gpvo.online.features import FeatureStream
from gpvo.online.guard import DEGRADED_BELOW
from gpvo.online.predictor import Predictor
from gpvo.types import Array, MotionError, Prediction, Status, VoRecord

DRAWS = 8
PLANNED = (*TWIST_COLUMNS, "acceleration_mps2", "angular_acceleration_radps2")
"""Features that follow from the plan."""

_NEIGHBOURS = 16
MAX_MOTIONS = 200_000
_MIN_MOTIONS = 2


@dataclass(frozen=True)
class Plan:
    """``t_s`` (N,) from zero, evenly spaced; ``T_world_cam`` (N, 4, 4) in the plan's own world [m]."""

    t_s: Array
    T_world_cam: Array

    @property
    def step_s(self) -> float:
        """Time between two poses."""
        return float(self.t_s[1] - self.t_s[0])

    @property
    def motions(self) -> Array:
        """(N - 1, 4, 4) ``T_prev_cur``."""
        return se3.inverse(self.T_world_cam[:-1]) @ self.T_world_cam[1:]

    @property
    def distance_m(self) -> Array:
        """(N,) length of the path up to each pose."""
        return se3.path_length_m(self.T_world_cam[:, :3, 3])


def read_plan(path: Path, dt_s: float, frame: str = "cam") -> Plan:
    """A TUM file of poses at any spacing, resampled every ``dt_s``.

    ``frame``: ``cam``, poses of the left camera (x right, y down, z forward), or ``body`` (FLU), whose camera then
    looks forward from the body's origin. Raises SourceError where the file cannot be read, or the plan is too short or
    too long.
    """
    if frame not in ("cam", "body"):
        raise GpvoError(f"unknown frame '{frame}'", cure="cam or body")
    given = read_tum(path, any_spacing=True)
    T = given.T_world_body @ T_FLU_OPTICAL if frame == "body" else given.T_world_body
    n = 1 + int((given.t_ns[-1] - given.t_ns[0]) * 1e-9 / dt_s + 1e-6)
    if n < _MIN_MOTIONS + 1:
        raise SourceError(f"lasts less than {_MIN_MOTIONS} motions of {dt_s:.3g} s", where=path, cure="lengthen it")
    if n > MAX_MOTIONS:
        raise SourceError(f"lasts for {n} motions of {dt_s:.3g} s, more than {MAX_MOTIONS}", where=path)
    return resample(Trajectory(given.t_ns, T), np.arange(n, dtype=np.float64) * dt_s)


def resample(given: Trajectory, t_s: Array) -> Plan:
    """Poses at seconds since the first one, smooth in velocity: a vehicle does not change its speed at waypoints."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    known_s = (given.t_ns - given.t_ns[0]) * 1e-9
    position = CubicSpline(known_s, given.T_world_body[:, :3, 3])(t_s)
    turned = RotationSpline(known_s, Rotation.from_matrix(given.T_world_body[:, :3, :3]))(t_s).as_matrix()
    return Plan(t_s, se3.from_rt(turned, position))


@dataclass(frozen=True)
class Outside:
    """A planned feature that leaves the training's range: share of the motions, the plan's range and the training's."""

    feature: str
    share: float
    planned: tuple[float, float]
    trained: tuple[float, float]


@dataclass(frozen=True)
class Forecast:
    """Of the N poses of a plan, the first known exactly.

    ``covariance`` (N, 6, 6): of each pose's error, right perturbation, in ``cam`` there [m, rad]; its mean is zero.
    ``independent_m``: the last pose's position sigma if motions were independent. ``in_domain`` (N - 1,): of each
    motion, averaged over the draws, in [0, 1].
    """

    plan: Plan
    covariance: Array
    independent_m: float
    in_domain: Array
    outside: tuple[Outside, ...]
    draws: int

    @property
    def position_covariance(self) -> Array:
        """(N, 3, 3) in the axes of the plan's world [m^2]."""
        return position_in_world(self.plan.T_world_cam, self.covariance)

    @property
    def position_sigma_m(self) -> Array:
        """(N, 3) standard deviation per axis of the plan's world [m]."""
        return np.sqrt(variances(self.position_covariance))

    @property
    def sigma_m(self) -> Array:
        """(N,) square root of the trace of the position's covariance [m]."""
        return np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))

    @property
    def outside_share(self) -> float:
        """Share of the motions that lie outside the training domain."""
        return float((self.in_domain < DEGRADED_BELOW).mean())


def forecast(
    predictor: Predictor,
    plan: Plan,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    on_draw: Callable[[], None] = lambda: None,
) -> Forecast:
    """Fly the plan ``draws`` times in the conditions of training flights; ``on_draw`` is called after each.

    Raises ModelError if the model predicts something else than the error of a motion, or keeps no sample of its
    training rows.
    """
    predictor.require_motions()
    sample = TrainingSample.from_arrays(predictor.arrays, len(predictor.features))
    rng = np.random.default_rng(seed)
    C, independent_m2, in_domain = np.zeros((len(plan.t_s), 6, 6)), 0.0, np.zeros(len(plan.t_s) - 1)
    for _ in range(draws):
        parent, said = _fly(predictor, plan, sample, rng)
        covariance, alone_m2 = _sum_up(parent, said, plan)
        C, independent_m2, in_domain = C + covariance, independent_m2 + alone_m2, in_domain + said.in_domain
        on_draw()
    return Forecast(
        plan=plan,
        covariance=symmetrise(C / draws),
        independent_m=float(np.sqrt(independent_m2 / draws)),
        in_domain=in_domain / draws,
        outside=_outside(predictor, plan),
        draws=draws,
    )


def _fly(
    predictor: Predictor, plan: Plan, sample: TrainingSample, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Prediction]:
    """One draw: the pose that each motion starts from (N,), -1 for the first pose, and what the model says of the
    motions that end at poses 1 to N - 1, in the conditions, and with the references, of training rows that moved alike.

    A row is taken with the velocities as odometry measured them, noise and all: the model knows no others. The plan's
    own stand in their place only where it leaves the range of the training.
    """
    names = [n for n in PLANNED if n in predictor.features]
    at, domain = positions(predictor.features, names), predictor.model.domain
    planned = _features(names, plan)
    like = _like(planned[:, : len(TWIST_COLUMNS)], sample, at[: len(TWIST_COLUMNS)], domain.scale, rng)
    parent, rows = _references(like, np.round(sample.dt_s / plan.step_s).astype(int))
    X = sample.X[rows].copy()
    low, high = (edge[at] for edge in domain.reach)
    X[:, at] = np.where((planned < low) | (planned > high), planned, X[:, at])
    dt_s = plan.t_s[1:] - plan.t_s[parent[1:]]
    return parent, predictor.predict(X, None if sample.geometry is None else sample.geometry[rows], dt_s)


def _references(like: NDArray[np.int64], frames: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Parents of the N poses and rows of the N - 1 motions, from the row that each motion (N - 1,) is most like and the
    number of frames that each row's motion spans."""
    n = len(like)
    parent, rows = np.full(n + 1, -1, dtype=np.int64), np.empty(n, dtype=np.int64)
    here = 0
    while here < n:
        end = min(here + max(1, int(frames[like[here]])), n)
        parent[here + 1 : end + 1], rows[here:end] = here, like[here]
        here = end
    return parent, rows


def _like(twist: Array, sample: TrainingSample, at: list[int], scale: Array, rng: np.random.Generator) -> NDArray:
    """Index (n,) of a row for each motion (n, 6): of those that moved most alike, the one whose sequence comes first in
    an order drawn once, so that conditions last as long as the motion allows."""
    A, B = twist / scale[at], sample.X[:, at] / scale[at]
    order = rng.permutation(int(sample.sequence.max()) + 1)[sample.sequence] + rng.random(len(B))
    few = min(_NEIGHBOURS, len(B))
    out = np.empty(len(A), dtype=np.int64)
    for k, a in enumerate(A):
        near = np.argpartition(np.nan_to_num(((B - a) ** 2).sum(axis=1), nan=np.inf), few - 1)[:few]
        out[k] = near[np.argmin(order[near])]
    return out


def _features(names: list[str], plan: Plan) -> Array:
    """(n, len(names)) by the one definition that flight and training share."""
    stream, t_ns = FeatureStream(names), np.round(plan.t_s * 1e9).astype(np.int64).tolist()
    records = (VoRecord(t_ns[k + 1], t_ns[k], Status.OK, T) for k, T in enumerate(plan.motions))
    return np.array([stream.step(r) for r in records]).reshape(-1, len(names))


def _sum_up(parent: NDArray[np.int64], said: Prediction, plan: Plan) -> tuple[Array, float]:
    """Covariance (N, 6, 6) of every pose's error, and the last position's variance if motions were independent."""
    T = se3.inverse(plan.T_world_cam[parent]) @ plan.T_world_cam
    nothing = MotionError.independent(np.zeros((6, 6)))
    errors = [nothing, *(said.row(k) for k in range(len(parent) - 1))]
    _, covariance = along(T, errors, parent)
    _, plain = along(T, [MotionError.independent(error.covariance) for error in errors], parent)
    return covariance, float(np.trace(plain[-1, :3, :3]))


def _outside(predictor: Predictor, plan: Plan) -> tuple[Outside, ...]:
    """Planned velocities and turn rates beyond the training's range, the most frequent first."""
    domain, at = predictor.model.domain, positions(predictor.features, TWIST_COLUMNS)
    low, high = domain.reach
    twist = se3.log(plan.motions) / plan.step_s
    found = []
    for name, i, v in zip(TWIST_COLUMNS, at, twist.T, strict=True):
        share = float(((v < low[i]) | (v > high[i])).mean())
        if share > 0:
            found.append(Outside(name, share, (float(v.min()), float(v.max())), (float(low[i]), float(high[i]))))
    return tuple(sorted(found, key=lambda o: -o.share))

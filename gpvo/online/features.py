"""What the error model looks at: the one causal, streaming definition, used in flight and replayed for training.

A feature at frame k depends on the records up to k and on nothing later. Rates are per second and image lengths per
focal length, so that a model survives another frame rate and another camera. Values a producer does not know are NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.types import IMPORTED, Array, StereoCamera, VoRecord

AXES = ("x", "y", "z", "rx", "ry", "rz")
GEOMETRIC_METHODS = ("pointing_matching", "triangulation")
TREND_S = 1.0
"""Time constant of the running means that the trends are measured against [s]."""

AGILITY_S = 0.5
"""Time constant of the running mean of the squared jerk [s]."""
_STILL = 1e-3

Step = Callable[[VoRecord], Sequence[float] | Array]


@dataclass(frozen=True)
class Feature:
    """Name and unit of one column. ``cam`` axes unless the name says otherwise."""

    name: str
    unit: str


@dataclass(frozen=True)
class FeatureGroup:
    """Columns computed together. ``start(camera)`` gives a step function with its own, empty memory.

    The step function is called once per record, in time order, and returns one number per column.
    """

    name: str
    columns: tuple[Feature, ...]
    start: Callable[[StereoCamera | None], Step]


def twist(record: VoRecord) -> Array:
    """(6,) velocity of the camera over the motion [m/s, rad/s]; NaN where there is no motion."""
    global _latest
    latest = _latest
    if latest is not None and latest[0] is record:
        return latest[1]
    moves = record.usable and record.dt_s > 0
    out = se3.log(record.T_prev_cur) / record.dt_s if moves else np.full(6, np.nan)
    out.setflags(write=False)
    _latest = (record, out)
    return out


# Several groups and the slip detector ask for the twist of one record in turn.
_latest: tuple[VoRecord, Array] | None = None


def _ln(value: float) -> float:
    return math.log(value) if value > 0 else math.nan


def _count(value: int) -> float:
    return float(value) if value >= 0 else math.nan


def _stateless(values: Callable[[VoRecord, float], Sequence[float]]) -> Callable[[StereoCamera | None], Step]:
    """A group without memory; ``values`` gets the record and the focal length [px] (NaN where there is no camera)."""

    def start(camera: StereoCamera | None) -> Step:
        focal = camera.fx_px if camera is not None else math.nan
        return lambda record: values(record, focal)

    return start


def _counts(r: VoRecord, _: float) -> Sequence[float]:
    return (*(_count(n) for n in (r.n_detected, r.n_stereo, r.n_tracked, r.n_inliers)), r.inlier_ratio)


def _geometry(r: VoRecord, focal: float) -> Sequence[float]:
    disparities = [_ln(d / focal) for d in (r.disparity_p10_px, r.disparity_p50_px, r.disparity_p90_px)]
    out = [*disparities, r.spread_u, r.spread_v, _ln(r.reproj_rms_px / focal), r.log10_condition]
    return [*out, *(value for method in GEOMETRIC_METHODS for value in _stated(r, method))]


def _stated(r: VoRecord, method: str) -> list[float]:
    """Logs of the variances by a method and of their covariance's determinant."""
    C = r.covariances.get(method)
    if C is None or not np.isfinite(C).all():
        return [math.nan] * 7
    sign, log_det = np.linalg.slogdet(C)
    return [*(_ln(c) for c in np.diagonal(C)), float(log_det) if sign > 0 else math.nan]


def _image(r: VoRecord, _: float) -> Sequence[float]:
    return r.brightness, r.contrast, r.sharpness, r.noise_level


def _norm(v: Array | None) -> float:
    return math.nan if v is None else float(np.linalg.norm(v))


def _imu(r: VoRecord, _: float) -> Sequence[float]:
    return tuple(
        _norm(v) for v in (r.imu_acc_mean_mps2, r.imu_gyro_mean_radps, r.imu_acc_std_mps2, r.imu_gyro_std_radps)
    )


def _imu_axes(r: VoRecord, _: float) -> Sequence[float]:
    nothing = np.full(3, np.nan)
    acc, gyro = r.imu_acc_mean_mps2, r.imu_gyro_mean_radps
    return (*(nothing if acc is None else acc), *(nothing if gyro is None else gyro))


class _Trend:
    """Change against the motion before and against running means of the last second."""

    def __init__(self, _: StereoCamera | None) -> None:
        self._twist: Array | None = None
        self._t_ns = 0
        self._mean: Array | None = None

    def __call__(self, r: VoRecord) -> Sequence[float]:
        if not r.usable:
            return (math.nan,) * 5
        now = twist(r)
        level = np.array([_ln(r.n_inliers), _ln(r.reproj_rms_px), r.brightness])
        change, acceleration = np.full(3, np.nan), np.full(2, np.nan)
        if self._twist is not None and self._mean is not None:
            # A clock may be set back: a trend then begins anew.
            step_s = max((r.t_ns - self._t_ns) * 1e-9, 1e-6)
            delta = (now - self._twist) / step_s
            acceleration = np.array([np.linalg.norm(delta[:3]), np.linalg.norm(delta[3:])])
            change = level - self._mean
            gain = -math.expm1(-step_s / TREND_S)
            level = np.where(np.isnan(change), level, self._mean + gain * change)
        self._twist, self._t_ns, self._mean = now, r.t_ns, level
        return (*acceleration, *change)


class _Agility:
    """Logs of how fast the vehicle moves and turns, and of how its velocity jerks: now, and lately on average.

    A vehicle moves smoothly from frame to frame, so that most of a jerk is VO's own noise.
    """

    def __init__(self, _: StereoCamera | None) -> None:
        self._before: list[Array] = []
        self._square = np.full(2, np.nan)

    def __call__(self, r: VoRecord) -> Sequence[float]:
        if not r.usable or r.dt_s <= 0:
            self._before = []
            return (math.nan,) * 6
        now = twist(r)
        velocity, jerk = _lengths(now), np.full(2, np.nan)
        if len(self._before) == 2:
            jerk = _lengths(now - 2.0 * self._before[1] + self._before[0]) / r.dt_s**2
            gain = -math.expm1(-r.dt_s / AGILITY_S)
            last = np.where(np.isnan(self._square), jerk**2, self._square)
            self._square = last + gain * (jerk**2 - last)
        self._before = [*self._before[-1:], now]
        values = np.concatenate([velocity, jerk, np.sqrt(self._square)])
        out: list[float] = np.log(values + _STILL).tolist()
        return out


def _lengths(rate: Array) -> Array:
    """(2,) of the translation's and the rotation's half of a twist or its derivative."""
    return np.sqrt(np.array([rate[:3] @ rate[:3], rate[3:] @ rate[3:]]))


def _columns(listed: str) -> tuple[Feature, ...]:
    """Of ``"name [unit], name [unit]"``."""
    return tuple(Feature(*pair.rstrip("]").split(" [")) for pair in listed.split(", "))


def _of_axes(name: str, unit: str) -> str:
    """The same column for x, y and z, which stand in place of ``*``."""
    return ", ".join(f"{name.replace('*', axis)} [{unit}]" for axis in "xyz")


def _stated_columns(method: str) -> str:
    variances = (f"ln_var_{method}_{a} [ln {'rad' if a.startswith('r') else 'm'}^2]" for a in AXES)
    return ", ".join([*variances, f"ln_det_{method} [ln]"])


BUILT_IN = (
    FeatureGroup("velocity", _columns(_of_axes("v_*_mps", "m/s")), lambda c: lambda r: twist(r)[:3]),
    FeatureGroup("rotation", _columns(_of_axes("w_*_radps", "rad/s")), lambda c: lambda r: twist(r)[3:]),
    FeatureGroup(
        "counts",
        _columns("n_detected [1], n_stereo [1], n_tracked [1], n_inliers [1], inlier_ratio [1]"),
        _stateless(_counts),
    ),
    FeatureGroup(
        "geometry",
        _columns(
            "ln_disparity_p10 [ln focal lengths], ln_disparity_p50 [ln focal lengths], "
            "ln_disparity_p90 [ln focal lengths], spread_u [focal lengths], spread_v [focal lengths], "
            "ln_reproj_rms [ln focal lengths], log10_condition [log10], "
            + ", ".join(_stated_columns(method) for method in GEOMETRIC_METHODS)
        ),
        _stateless(_geometry),
    ),
    FeatureGroup(
        "image",
        _columns("brightness [0..1], contrast [0..1], sharpness [log10], noise_level [0..1]"),
        _stateless(_image),
    ),
    FeatureGroup(
        "trend",
        _columns(
            "acceleration_mps2 [m/s^2], angular_acceleration_radps2 [rad/s^2], "
            "ln_inliers_change [ln], ln_reproj_rms_change [ln], brightness_change [0..1]"
        ),
        _Trend,
    ),
    FeatureGroup(
        "agility",
        _columns(
            "ln_speed [ln m/s], ln_turn_rate [ln rad/s], ln_jerk [ln m/s^3], ln_angular_jerk [ln rad/s^3], "
            "ln_jerk_lately [ln m/s^3], ln_angular_jerk_lately [ln rad/s^3]"
        ),
        _Agility,
    ),
    FeatureGroup(IMPORTED, _columns(_stated_columns(IMPORTED)), _stateless(lambda r, _: _stated(r, IMPORTED))),
    # In pixels, as the geometric covariance at one pixel is scaled by it.
    FeatureGroup("residual", _columns("ln_residual_px [ln px]"), _stateless(lambda r, _: (_ln(r.reproj_rms_px),))),
    # Lengths of the vectors: they survive another mounting of the IMU, its axes (imu_axes) do not.
    FeatureGroup(
        "imu",
        _columns("imu_acc_mps2 [m/s^2], imu_gyro_radps [rad/s], imu_acc_std_mps2 [m/s^2], imu_gyro_std_radps [rad/s]"),
        _stateless(_imu),
    ),
    FeatureGroup(
        "imu_axes",
        _columns(f"{_of_axes('imu_acc_*_mps2', 'm/s^2')}, {_of_axes('imu_gyro_*_radps', 'rad/s')}"),
        _stateless(_imu_axes),
    ),
)

THESIS = ("v_x_mps", "v_y_mps", "v_z_mps", "n_inliers")


@cache
def groups() -> dict[str, FeatureGroup]:
    """All groups by name: the built-in ones, then those of installed packages.

    A package joins with ``[project.entry-points."gpvo.features"]`` and ``name = "package.module:GROUP"``, GROUP being a
    :class:`FeatureGroup`. A model that uses its columns is refused where the package is not installed. A built-in name
    cannot be taken over.
    """
    found = {g.name: g for g in BUILT_IN}
    for entry in entry_points(group="gpvo.features"):
        group = entry.load()
        found.setdefault(group.name, group)
    return found


def resolve(selection: str | Sequence[str]) -> tuple[str, ...]:
    """Column names of a selection: ``thesis``, ``full``, or names of groups and columns, as a list or comma-separated.

    ``full`` is every group but ``imu_axes`` and ``residual``. Raises GpvoError for an unknown name.
    """
    if selection == "thesis":
        return THESIS
    wanted = [w for w in groups() if w not in ("imu_axes", "residual")] if selection == "full" else selection
    if isinstance(wanted, str):
        wanted = [w.strip() for w in wanted.split(",") if w.strip()]
    columns = known_columns()
    out: dict[str, None] = {}
    for name in wanted:
        if name in groups():
            out.update(dict.fromkeys(c.name for c in groups()[name].columns))
        elif name in columns:
            out[name] = None
        else:
            raise GpvoError(
                f"unknown feature '{name}'",
                cure=f"thesis, full, or any of: {', '.join(groups())}, or a column of them",
            )
    if not out:
        raise GpvoError("the selection of features is empty", cure="thesis, full, or a comma-separated list")
    return tuple(out)


@cache
def known_columns() -> dict[str, str]:
    """All columns with their units, those of installed packages included."""
    return {c.name: c.unit for g in groups().values() for c in g.columns}


def units(names: Sequence[str]) -> tuple[str, ...]:
    """Unit of each column."""
    return tuple(known_columns()[n] for n in names)


class FeatureStream:
    """Features of one run, frame by frame.

    ``names``: columns, in the order of the output (see :func:`resolve`). ``camera`` makes image lengths independent of
    the focal length; without it those columns are NaN.
    """

    def __init__(self, names: Sequence[str], camera: StereoCamera | None = None) -> None:
        self.names = tuple(names)
        self._pick: list[tuple[Step, list[tuple[int, int]]]] = []
        place = {name: i for i, name in enumerate(self.names)}
        for group in groups().values():
            picked = [(place[c.name], j) for j, c in enumerate(group.columns) if c.name in place]
            if picked:
                self._pick.append((group.start(camera), picked))
        unknown = set(self.names) - known_columns().keys()
        if unknown:
            raise GpvoError(
                f"unknown features: {', '.join(sorted(unknown))}", cure="install the package that defines them"
            )

    def step(self, record: VoRecord) -> Array:
        """(d,) features of the record's motion. Call once per record, in time order."""
        out = np.empty(len(self.names))
        for step, picked in self._pick:
            values = step(record)
            for i, j in picked:
                out[i] = values[j]
        return out

"""What the error model looks at: a single causal, streaming definition, used in flight and replayed for training.

A feature at frame k depends on the records up to k and on nothing later. Rates are per second and image lengths are in
focal lengths, so that a model survives a change of frame rate or camera. Values that a producer does not know are NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import entry_points
from operator import attrgetter

import numpy as np

from gpvo.errors import GpvoError
from gpvo.online.lately import Agility, Trend, log_of, twist
from gpvo.types import IMPORTED, Array, StereoCamera, VoRecord

AXES = ("x", "y", "z", "rx", "ry", "rz")
GEOMETRIC_METHODS = ("pointing_matching", "triangulation")

Step = Callable[[VoRecord], Sequence[float] | Array]


@dataclass(frozen=True)
class Feature:
    """Name and unit of one column. ``cam`` axes unless the name says otherwise."""

    name: str
    unit: str


@dataclass(frozen=True)
class FeatureGroup:
    """Columns computed together. ``start(camera)`` gives a step function with its own, empty memory.

    The step function is called once per record, in time order, and returns one number per column; one with a memory
    is an object, so that a predictor can be copied and pickled. Several groups may share a ``name``, by which they are
    selected: each is computed only if one of its own columns is wanted.
    """

    name: str
    columns: tuple[Feature, ...]
    start: Callable[[StereoCamera | None], Step]


def _stateless(values: Callable[[float, VoRecord], Sequence[float]]) -> Callable[[StereoCamera | None], Step]:
    """A group without memory; ``values`` gets the focal length [px] (NaN where there is no camera) and the record."""
    return lambda camera: partial(values, math.nan if camera is None else camera.fx_px)


def _twist(first: int, _: float, r: VoRecord) -> Sequence[float]:
    return twist(r).tolist()[first : first + 3]


def _counts(_: float, r: VoRecord) -> Sequence[float]:
    counts = (r.n_detected, r.n_stereo, r.n_tracked, r.n_inliers)
    return (*(float(n) if n >= 0 else math.nan for n in counts), r.inlier_ratio)


def _seen(focal: float, r: VoRecord) -> Sequence[float]:
    disparities = [log_of(d / focal) for d in (r.disparity_p10_px, r.disparity_p50_px, r.disparity_p90_px)]
    return [*disparities, r.spread_u, r.spread_v, log_of(r.reproj_rms_px / focal), r.log10_condition]


def _residual(_: float, r: VoRecord) -> Sequence[float]:
    return (log_of(r.reproj_rms_px),)


def _variances(method: str, _: float, r: VoRecord) -> Sequence[float]:
    return [log_of(c) for c in _stated_covariance(r, method).diagonal().tolist()]


def _determinant(method: str, _: float, r: VoRecord) -> Sequence[float]:
    sign, log_det = np.linalg.slogdet(_stated_covariance(r, method))
    return (float(log_det) if sign > 0 else math.nan,)


def _stated(name: str, method: str) -> tuple[FeatureGroup, FeatureGroup]:
    """Logs of the variances that a record states by a method, and of the covariance's determinant."""
    units = ", ".join(f"ln_var_{method}_{a} [ln {'rad' if a.startswith('r') else 'm'}^2]" for a in AXES)
    return (
        FeatureGroup(name, _columns(units), _stateless(partial(_variances, method))),
        FeatureGroup(name, _columns(f"ln_det_{method} [ln]"), _stateless(partial(_determinant, method))),
    )


def _stated_covariance(r: VoRecord, method: str) -> Array:
    C = r.covariances.get(method)
    return C if C is not None and np.isfinite(C).all() else np.zeros((6, 6))


def _imu(_: float, r: VoRecord) -> Sequence[float]:
    vectors = (r.imu_acc_mean_mps2, r.imu_gyro_mean_radps, r.imu_acc_std_mps2, r.imu_gyro_std_radps)
    return [math.nan if v is None else math.hypot(*v) for v in vectors]


def _imu_axes(_: float, r: VoRecord) -> Sequence[float]:
    means = (r.imu_acc_mean_mps2, r.imu_gyro_mean_radps)
    return [x for v in means for x in ((math.nan,) * 3 if v is None else v)]


def _columns(listed: str) -> tuple[Feature, ...]:
    """Parse ``"name [unit], name [unit]"``."""
    return tuple(Feature(*pair.rstrip("]").split(" [")) for pair in listed.split(", "))


def _of_axes(name: str, unit: str) -> str:
    """The same column for x, y and z, which replace ``*``."""
    return ", ".join(f"{name.replace('*', axis)} [{unit}]" for axis in "xyz")


BUILT_IN = (
    FeatureGroup("velocity", _columns(_of_axes("v_*_mps", "m/s")), _stateless(partial(_twist, 0))),
    FeatureGroup("rotation", _columns(_of_axes("w_*_radps", "rad/s")), _stateless(partial(_twist, 3))),
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
            "ln_reproj_rms [ln focal lengths], log10_condition [log10]"
        ),
        _stateless(_seen),
    ),
    *(group for method in GEOMETRIC_METHODS for group in _stated("geometry", method)),
    FeatureGroup(
        "image",
        _columns("brightness [0..1], contrast [0..1], sharpness [log10], noise_level [0..1]"),
        lambda c: attrgetter("brightness", "contrast", "sharpness", "noise_level"),
    ),
    FeatureGroup(
        "trend",
        _columns(
            "acceleration_mps2 [m/s^2], angular_acceleration_radps2 [rad/s^2], "
            "ln_inliers_change [ln], ln_reproj_rms_change [ln], brightness_change [0..1]"
        ),
        lambda _: Trend(),
    ),
    FeatureGroup(
        "agility",
        _columns(
            "ln_speed [ln m/s], ln_turn_rate [ln rad/s], ln_jerk [ln m/s^3], ln_angular_jerk [ln rad/s^3], "
            "ln_jerk_lately [ln m/s^3], ln_angular_jerk_lately [ln rad/s^3]"
        ),
        lambda _: Agility(),
    ),
    *_stated(IMPORTED, IMPORTED),
    # In pixels, as the geometric covariance at one pixel is scaled by it.
    FeatureGroup("residual", _columns("ln_residual_px [ln px]"), _stateless(_residual)),
    # Magnitudes of the vectors: they survive a change of the IMU's mounting; its axes (imu_axes) do not.
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
def groups() -> dict[str, tuple[FeatureGroup, ...]]:
    """All groups by name: the built-in ones, then those of installed packages.

    A package joins with ``[project.entry-points."gpvo.features"]`` and ``name = "package.module:GROUP"``, GROUP being a
    :class:`FeatureGroup`. A model that uses its columns is refused if the package is not installed. A built-in name
    cannot be overridden.
    """
    found: dict[str, tuple[FeatureGroup, ...]] = {}
    for group in BUILT_IN:
        found[group.name] = (*found.get(group.name, ()), group)
    for entry in entry_points(group="gpvo.features"):
        group = entry.load()
        found.setdefault(group.name, (group,))
    return found


def resolve(selection: str | Sequence[str]) -> tuple[str, ...]:
    """Column names of a selection: ``thesis``, ``full``, names of groups and columns, as a list or comma-separated.

    ``full`` is every group but ``imu_axes`` and ``residual``. Raises GpvoError for an unknown name.
    """
    if isinstance(selection, str):
        selection = [w.strip() for w in selection.split(",") if w.strip()]
    out: dict[str, None] = {}
    for name in selection:
        if name == "thesis":
            out.update(dict.fromkeys(THESIS))
        elif name in ("full", *groups()):
            parts = [g for g in groups() if g not in ("imu_axes", "residual")] if name == "full" else [name]
            out.update(dict.fromkeys(c.name for part in parts for group in groups()[part] for c in group.columns))
        elif name in known_columns():
            out[name] = None
        else:
            cure = f"thesis, full, or any of: {', '.join(groups())}, or a column of them"
            raise GpvoError(f"unknown feature '{name}'", cure=cure)
    if not out:
        raise GpvoError("the selection of features is empty", cure="thesis, full, or a comma-separated list")
    return tuple(out)


@cache
def known_columns() -> dict[str, str]:
    """All columns with their units, those of installed packages included."""
    return {c.name: c.unit for of_name in groups().values() for group in of_name for c in group.columns}


class FeatureStream:
    """Features of one run, frame by frame.

    ``names``: columns, in the order of the output (see :func:`resolve`). ``camera`` makes image lengths independent of
    the focal length; without it those columns are NaN.
    """

    def __init__(self, names: Sequence[str], camera: StereoCamera | None = None) -> None:
        self.names = tuple(names)
        self._pick: list[tuple[Step, list[tuple[int, int]]]] = []
        place = {name: i for i, name in enumerate(self.names)}
        for group in (group for of_name in groups().values() for group in of_name):
            picked = [(place[c.name], j) for j, c in enumerate(group.columns) if c.name in place]
            if picked:
                self._pick.append((group.start(camera), picked))
        if unknown := set(self.names) - known_columns().keys():
            cure = "install the package that defines them, or update gpvo"
            raise GpvoError(f"features that are needed are not installed: {', '.join(sorted(unknown))}", cure=cure)

    def step(self, record: VoRecord) -> Array:
        """(d,) features of the record's motion. Call once per record, in time order."""
        out = [0.0] * len(self.names)
        for step, picked in self._pick:
            values = step(record)
            for i, j in picked:
                out[i] = values[j]
        return np.array(out, dtype=np.float64)

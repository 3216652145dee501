"""Flights without images: what is flown, where, and how it is seen, and the kinds of flight that come with gpvo."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from gpvo.cameras.rig import Tolerance
from gpvo.errors import GpvoError
from gpvo.files import read_toml
from gpvo.sim import imu
from gpvo.sim.events import CAUSES
from gpvo.types import StereoCamera, field_names


@dataclass(frozen=True)
class PointsScenario:
    """A kind of flight. Times in s, lengths in m, pixels of the rectified image."""

    world: str = "tunnel"  # tunnel, lunar, room, street
    world_seed: int | None = None  # of landmarks and path, in place of the flight's own
    path: str = "along"  # along, wander, straight, hover, waypoints, or a recorded one: a TUM file, or a run folder
    waypoints: tuple[tuple[float, float, float], ...] = ()
    duration_s: float = 60.0
    rest_s: float = 3.0  # at the start
    rate_hz: float = 20.0
    speed_mps: float = 1.2
    camera: StereoCamera = field(default_factory=lambda: StereoCamera(380.0, 380.0, 319.5, 239.5, 0.12, 640, 480))
    imu: str = "euroc"
    imu_rate_hz: float = 200.0
    # These five: one value, or several, of the frames in turn and then from the first again.
    tracks: int | tuple[int, ...] = 220  # wanted per frame
    sigma_px: float | tuple[float, ...] = 0.15  # of each image coordinate
    outliers: float | tuple[float, ...] = 0.03  # share of the tracks that jump
    drop: float | tuple[float, ...] = 0.04  # share of the tracks that end, per frame
    reach_m: float | tuple[float, ...] = 40.0  # as far as points are seen
    # At the median of sigma_px, and in proportion to it elsewhere.
    persistent_px: float = 0.0  # of a point's disparity, the same for as long as it is followed
    drift_px: float = 0.0  # by which a followed point slips in both images, per frame and coordinate, for about drift_s
    drift_s: float = 1.0
    shared_px: tuple[tuple[float, float], ...] = ()  # of (u, v) and d, by all points, of each of twin.common.KINDS
    blur_px: float = 0.008  # further noise per pixel of image motion
    spread: float = 0.15  # standard deviation of log sigma between flights
    episodes_share: float = 0.0  # share of the flight in episodes in which VO gets ten times worse
    causes: tuple[str, ...] = tuple(CAUSES)  # of the episodes
    noise_every: int = 0  # every n-th frame is noisy by noise_px
    noise_px: float = 0.0
    dark: tuple[float, float] | None = None  # no tracks from, to
    frozen: tuple[float, float] | None = None  # the same image from, to
    cars: int = 0  # that drive beside, before or towards the camera, for 5 to 20 s each
    smoke: float = 0.0  # share of the time with a plume that drifts along
    dust: float = 0.0  # share of the time with dust that turns about the vehicle
    texture: float = 1.0  # share of the world's points that are there
    tolerance: Tolerance = field(default_factory=Tolerance)
    offset: Tolerance = field(default_factory=Tolerance)  # fixed part of the difference

    @property
    def imu_samples_per_frame(self) -> int:
        """The IMU's rate over that of the frames, nearest whole number."""
        return max(1, round(self.imu_rate_hz / self.rate_hz))


def _landmarks_alone(table: Mapping[str, Any]) -> PointsScenario:
    """The flight without images of a scenario's file: its table ``landmarks`` holds what flights with images lack."""
    values = {**table, **table["landmarks"]}
    values["tolerance"] = replace(Tolerance(**table.get("calibration", {})), distortion=0.0)  # of a rectified pair
    if "camera" in values:
        values["camera"] = StereoCamera(**values["camera"])
    return PointsScenario(**{name: values[name] for name in field_names(PointsScenario) if name in values})


_MOST_FRAMES = 1_000_000
FOLDER = Path(__file__).parent / "scenarios"


@cache
def scenarios() -> dict[str, PointsScenario]:
    """Those that come with gpvo and can be flown without images, by name."""
    tables = {file.stem: read_toml(file) for file in sorted(FOLDER.glob("*.toml"))}
    return {name: _landmarks_alone(table) for name, table in tables.items() if "landmarks" in table}


def _within(least: float, most: float, kind: type = float) -> Callable[[Any], bool]:
    kinds = (int,) if kind is int else (int, float)
    return lambda v: isinstance(v, kinds) and not isinstance(v, bool) and least <= v <= most


def _list_of(fits: Callable[[Any], bool], count: int | None = None) -> Callable[[Any], bool]:
    """Of so many, any number by default."""
    return lambda v: isinstance(v, (list, tuple)) and count in (None, len(v)) and all(map(fits, v))


def _one_or_more(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    several = _list_of(fits)
    return lambda v: fits(v) or (several(v) and 0 < len(v) <= _MOST_FRAMES)


_are_times, _is_place = _list_of(_within(0.0, 1e6), 2), _list_of(_within(-1e6, 1e6), 3)
_are_causes = _list_of(lambda c: c in tuple(CAUSES))


_RULES: tuple[tuple[str, str, Callable[[Any], bool]], ...] = (
    ("duration_s rate_hz imu_rate_hz drift_s", "a number from 0.1 to 1e6", _within(0.1, 1e6)),
    ("rest_s speed_mps persistent_px drift_px blur_px spread noise_px", "a number from 0 to 1e3", _within(0.0, 1e3)),
    ("reach_m", "a number from 0.1 to 1e6, or a list of them", _one_or_more(_within(0.1, 1e6))),
    (
        "shared_px",
        "up to four pairs of numbers from 0 to 1e3, [[u and v, d], ...]",
        lambda v: _list_of(_list_of(_within(0.0, 1e3), 2))(v) and len(v) <= 4,
    ),
    ("smoke dust texture", "a share from 0 to 1", _within(0.0, 1.0)),
    ("sigma_px", "a number from 0 to 1e3, or a list of them", _one_or_more(_within(0.0, 1e3))),
    ("outliers drop", "a share from 0 to 1, or a list of them", _one_or_more(_within(0.0, 1.0))),
    ("episodes_share", "a share from 0 to 0.5", _within(0.0, 0.5)),
    ("tracks", "a whole number from 1 to 100000, or a list of them", _one_or_more(_within(1, 1e5, int))),
    ("cars noise_every", "a whole number from 0 to 1000", _within(0, 1e3, int)),
    ("world_seed", "a whole number from 0 on", lambda v: v is None or _within(0, float("inf"), int)(v)),
    (
        "dark frozen",
        "two times in s, the earlier one first",
        lambda v: v is None or (_are_times(v) and v[0] <= v[1]),
    ),
    ("waypoints", "places, [[x, y, z], ...]", _list_of(_is_place)),
    ("causes", f"some of {', '.join(CAUSES)}", lambda v: _are_causes(v) and len(v) > 0),
    ("imu", f"one of {', '.join(imu.PRESETS)}", lambda v: isinstance(v, str) and v in imu.PRESETS),
    ("world path", "text", lambda v: isinstance(v, str)),
    ("camera", "a StereoCamera; in a file, set camera itself", lambda v: isinstance(v, StereoCamera)),
    (
        "tolerance offset",
        "a Tolerance; in a file, set calibration, or calibration_offset",
        lambda v: isinstance(v, Tolerance),
    ),
)


def check_values(values: Mapping[str, object], prefix: str = "") -> None:
    """Raise GpvoError for a value that is not of the kind or range of its field of :class:`PointsScenario`."""
    for names, wanted, fits in _RULES:
        for name in names.split():
            if name in values and not fits(values[name]):
                raise GpvoError(f"{prefix}{name} is {_short(values[name])}", cure=f"give {wanted}")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."

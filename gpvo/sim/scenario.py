"""Scenarios: what is flown, where, with which sensors and faults, as one validated set of values in a small TOML file;
and their flights, one or many, on the cores of this machine or on a dask cluster."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gpvo.cameras.rig import Tolerance
from gpvo.errors import GpvoError
from gpvo.files import read_toml
from gpvo.geometry.se3 import path_length_m
from gpvo.parallel import map_jobs
from gpvo.sim.points import simulate_points
from gpvo.sim.points_scenario import FOLDER, PointsScenario, check_values, scenarios
from gpvo.sim.rig import CAMERAS, camera_rig
from gpvo.types import field_names

CalibrationKey = Literal["baseline", "focal", "rotation_rad", "distortion"]
Cause = Literal["darkness", "dust", "motion_blur", "bare_wall", "image_noise"]
Deviation = Annotated[float, Field(ge=-0.5, le=0.5)]  # beyond, not even the simulator's cameras would make a pair
Share = Field(0.0, ge=0.0, le=0.5)
_IMAGES_ALONE = {
    "noise_sigma": "points.sigma_px", "noise_every": "points.noise_every", "frozen": "points.frozen",
    "dropped": "points.drop", "black": "points.dark", "late": "", "imu_offset_s": "",
    "camera_pitch_deg": "", "right_light": "", "exposure_s": "", "sway_m": "", "agility": "", "depth": "", "flow": "",
}  # fmt: skip
"""What only flights with images take, and what is like it without."""


class Scenario(BaseModel):
    """Everything that decides a sequence beside its seed. Times in s, lengths in m.

    ``world_seed``: that of the flight where not given. ``path``: ``along`` the world's centre line (a hall has none:
    there it wanders), ``wander``, ``straight``, ``hover``, through ``waypoints``. ``trajectory``: a TUM or EuRoC file
    whose motion is flown instead. ``agility``: how quickly the vehicle bends and turns at its speed, 1 is calm.
    ``noise_sigma``: standard deviation on a 0..1 scale, in every ``noise_every``-th frame. ``episodes_share``: share of
    the flight in which seeing goes wrong, by one of the ``causes`` each time. ``dark``: from, to. ``dropped, frozen,
    late, black``: shares of the frames; a late one is stamped ``late_s`` after it was taken. ``camera_pitch_deg``: how
    far the cameras look down. ``right_light``: light of the right camera over that of the left. ``depth``: write the
    left camera's depth too; ``flow``: and where each of its pixels is in the next image. ``calibration``: standard
    deviations of how the rig that draws the images differs from the written one; ``calibration_offset``: the fixed
    part of that difference. ``points``: values for flights without images alone.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    about: str = ""
    world: Literal["tunnel", "lunar", "room", "street"] = "tunnel"
    world_seed: int | None = Field(None, ge=0)
    world_params: dict[str, Any] = {}
    vehicle: Literal["quadrotor", "rover", "path"] = "quadrotor"
    path: Literal["along", "wander", "straight", "hover", "waypoints"] = "along"
    waypoints: tuple[tuple[float, float, float], ...] = ()
    trajectory: str | None = None
    needs_trajectory: bool = False
    duration_s: float = Field(60.0, ge=4.0, le=7200.0)
    rate_hz: float = Field(20.0, ge=1.0, le=200.0)
    speed_mps: float = Field(1.2, ge=0.05, le=40.0)
    sway_m: float = Field(0.3, ge=0.0, le=2.0)
    agility: float = Field(1.0, ge=0.1, le=5.0)
    rest_s: float = Field(3.0, ge=0.0, le=60.0)
    camera: str = "pinhole"
    camera_pitch_deg: float = Field(0.0, ge=-60.0, le=60.0)
    right_light: float = Field(1.0, ge=0.1, le=10.0)
    exposure_s: float = Field(0.0, ge=0.0, le=0.1)
    sensor: dict[str, Any] = {}
    noise_sigma: float = Field(0.0, ge=0.0, le=1.0)
    noise_every: int = Field(1, ge=1)
    episodes_share: float = Field(0.0, ge=0.0, le=0.5)
    causes: tuple[Cause, ...] = Field(get_args(Cause), min_length=1)
    dark: tuple[float, float] | None = None
    dropped: float = Share
    frozen: float = Share
    late: float = Share
    late_s: float = Field(0.005, ge=0.0, le=0.5)
    black: float = Share
    imu: Literal["perfect", "euroc", "t265"] = "euroc"
    imu_rate_hz: float = Field(200.0, ge=50.0, le=1000.0)
    imu_offset_s: float = Field(0.0, ge=-0.1, le=0.1)
    depth: bool = False
    flow: bool = False
    calibration: dict[CalibrationKey, Deviation] = {}
    calibration_offset: dict[CalibrationKey, Deviation] = {}
    points: dict[str, Any] = {}

    @property
    def tolerance(self) -> Tolerance:
        """Standard deviations of the calibration's error."""
        return Tolerance(**self.calibration)

    @property
    def offset(self) -> Tolerance:
        """Fixed part of the calibration's error."""
        return Tolerance(**self.calibration_offset)


@dataclass(frozen=True)
class Flight:
    """What came of a scenario and a seed. ``redone`` is False where ``path`` already held this very flight.

    ``error``: one line where it failed, else empty.
    """

    seed: int
    path: Path
    frames: int = 0
    distance_m: float = 0.0
    redone: bool = True
    error: str = ""


def names() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    return tuple(sorted(file.stem for file in FOLDER.glob("*.toml")))


def load_scenario(name: str, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """A scenario by its name or TOML file, with some values replaced; dots reach into tables (``points.sigma_px``).

    Raises GpvoError for an unknown name or value, with the nearest one that is known.
    """
    if not name.endswith(".toml") and name not in names():
        raise GpvoError(f"unknown scenario '{name}'", cure=_nearest(name, names()))
    file = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    table = read_toml(file)
    # A resolved scenario, as it lies beside a sequence, may be flown again.
    for beside in ("seed", "files", "drawn"):
        table.pop(beside, None)
    if file.parent == FOLDER:
        table.pop("landmarks", None)  # scenarios() holds them
    table.setdefault("name", file.stem)
    for key, value in (overrides or {}).items():
        _put(table, key, value)
    return _validated(table, name)


def stated_seed(name: str) -> int:
    """The seed in a scenario's file, 0 where there is none."""
    seed = read_toml(Path(name)).get("seed", 0) if name.endswith(".toml") else 0
    return seed if isinstance(seed, int) and seed >= 0 else 0


def points_scenario(scenario: Scenario) -> PointsScenario:
    """The same flight without images."""
    from gpvo.cameras.rectify import Rectifier

    base = scenarios().get(scenario.name, PointsScenario())
    own = load_scenario(scenario.name).camera if scenario.name in scenarios() else None
    camera = base.camera if scenario.camera == own else Rectifier(camera_rig(scenario.camera)).camera
    alike = set(field_names(PointsScenario)) & Scenario.model_fields.keys() - _IMAGES_ALONE.keys()
    values: dict[str, Any] = {
        **{name: getattr(scenario, name) for name in alike},
        "path": scenario.trajectory or scenario.path,
        "camera": camera,
        # A rectified pair has no distortion to be wrong.
        "tolerance": replace(scenario.tolerance, distortion=0.0),
        "offset": replace(scenario.offset, distortion=0.0),
    }
    return replace(base, **{**values, **scenario.points})


def warn_of_unused(scenario: Scenario) -> None:
    """Warn of values, other than the scenario's usual ones, that a flight without images does not use."""
    own = scenario.name
    usual = load_scenario(own) if own in names() else Scenario.model_validate({"name": own})
    for name, instead in _IMAGES_ALONE.items():
        if getattr(scenario, name) != getattr(usual, name) and instead.removeprefix("points.") not in scenario.points:
            cure = f"; set {instead}" if instead else ""
            warnings.warn(f"{name} is not used without images{cure}", stacklevel=2)


def require_pictures(scenario: Scenario) -> None:
    """Raise GpvoError for a scenario that exists as landmarks alone: a street, and what moves beside the camera."""
    flown = points_scenario(scenario)
    if scenario.world == "street" or flown.cars or flown.smoke or flown.dust:
        raise GpvoError(f"'{scenario.name}' has no images", cure="add --points: landmark tracks instead of images")


def _put(table: dict[str, Any], key: str, value: Any) -> None:
    *heads, last = key.split(".")
    for head in heads:
        table = table.setdefault(head, {})
        if not isinstance(table, dict):
            raise GpvoError(f"'{head}' is not a table", cure=f"set {head} itself")
    table[last] = value


def _validated(table: dict[str, Any], where: object) -> Scenario:
    if unknown := sorted(set(table) - set(Scenario.model_fields)):
        cure = _nearest(unknown[0], Scenario.model_fields)
        raise GpvoError(f"unknown parameter '{unknown[0]}'", where=where, cure=cure)
    try:
        scenario = Scenario(**table)
    except ValidationError as error:
        first = error.errors()[0]
        if first["loc"][-1] == "[key]":
            word = str(first["input"])
            cure = _nearest(word, get_args(CalibrationKey))
            raise GpvoError(f"unknown parameter '{first['loc'][0]}.{word}'", where=where, cure=cure) from None
        key = ".".join(str(part) for part in first["loc"])
        raise GpvoError(f"{key} = {first['input']!r}: {first['msg']}", where=where) from None
    known = {f.name for f in fields(PointsScenario)}
    if unknown := sorted(set(scenario.points) - known):
        raise GpvoError(f"unknown parameter 'points.{unknown[0]}'", where=where, cure=_nearest(unknown[0], known))
    check_values(scenario.points, "points.")
    if scenario.camera not in CAMERAS and not Path(scenario.camera).exists():
        cure = f"choose from {', '.join(CAMERAS)}, or give a Kalibr, OpenCV, ROS or KITTI file, or a run"
        raise GpvoError(f"camera is '{scenario.camera}'", where=where, cure=cure)
    if scenario.path == "waypoints" and len(scenario.waypoints) < 2:
        raise GpvoError("path = waypoints needs at least two places", where=where, cure="waypoints = [[x, y, z], ...]")
    # Frames lie on whole milliseconds: the shortest time between two.
    if scenario.late and 1e3 * scenario.late_s >= 1e3 // scenario.rate_hz:
        raise GpvoError("late_s is longer than the time between frames", where=where)
    return scenario


def _nearest(word: str, known: Any) -> str:
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.4)
    return f"nearest: {close[0]}" if close else f"known: {', '.join(sorted(known))}"


def fly_campaign(
    scenario: Scenario,
    seeds: Sequence[int],
    out: Path,
    *,
    points: bool = False,
    jobs: int = 1,
    backend: str = "local",
    scheduler: str | None = None,
) -> list[Flight]:
    """Simulate every seed into ``out/seed_N`` (``out/seed_N.npz`` for points); one failure does not stop the others.

    Raises GpvoError for an unknown backend; MissingExtraError for ``dask`` without the extra.
    """
    suffix = ".npz" if points else ""
    tasks = [(scenario, seed, out / f"seed_{seed}{suffix}", points) for seed in seeds]
    out.mkdir(parents=True, exist_ok=True)
    return map_jobs(fly_one, tasks, jobs=jobs, backend=backend, scheduler=scheduler)


def fly_one(scenario: Scenario, seed: int, out: Path, points: bool = False) -> Flight:
    """One flight; what goes wrong with it comes back as its ``error``."""
    try:
        return fly(scenario, seed, out, points)
    except GpvoError as error:
        return Flight(seed, out, error=str(error))


def fly(
    scenario: Scenario, seed: int, out: Path, points: bool = False, threads: int = 1,
    on_frame: Callable[[], None] = lambda: None,
) -> Flight:  # fmt: skip
    """One flight with images, a folder that stays if it is this very flight, or without, an ``.npz``, always written
    anew. Raises GpvoError where it goes wrong."""
    if points:
        flight = simulate_points(points_scenario(scenario), seed)
        flight.save(out)
        return Flight(seed, out, len(flight.t_s), float(path_length_m(flight.motion.position_m)[-1]))
    from gpvo.sim.sequence import simulate

    return simulate(scenario, seed, out, threads=threads, on_frame=on_frame)

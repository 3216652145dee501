"""What sensors and sources give: cameras, images, tracks, IMU samples, the vehicle they sit on, and the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import CalibrationError

Array = NDArray[np.float64]
"""Of double precision, any shape."""

# Beyond it, of any stereo head for odometry, the number is wrong, not the rig unusual.
MAX_BASELINE_M = 10.0
STANDARD_GRAVITY_MPS2 = 9.80665


def field_names(cls: type) -> tuple[str, ...]:
    """Names of a dataclass' fields, in order."""
    return tuple(f.name for f in fields(cls))


def within(default: Any, least: float, most: float) -> Any:
    """A field of settings that lies between two limits, or is None; the limits are among what it may be."""
    return field(default=default, metadata={"limits": (least, most)})


def out_of_limits(settings: Any) -> Iterator[tuple[str, Any, float, float]]:
    """Name, value and limits of each such field that lies beyond them, or is no number."""
    for name, (low, high) in ((f.name, f.metadata["limits"]) for f in fields(settings) if f.metadata):
        value = getattr(settings, name)
        if value is not None and not low <= value <= high:
            yield name, value, low, high


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo pair: two identical pinhole cameras, rows aligned, the right one at +x.

    ``fx_px, fy_px, cx_px, cy_px``: intrinsics [px], pixel (0, 0) is the centre of the first pixel.
    ``baseline_m``: distance of the optical centres [m], positive. ``width, height``: image size [px]. Raises
    CalibrationError for an impossible camera.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    width: int
    height: int

    def __post_init__(self) -> None:
        for name in field_names(type(self)):
            value = getattr(self, name)
            number = float(value) if isinstance(value, int | float | np.number) else np.nan
            least = {"cx_px": -1e9, "cy_px": -1e9, "width": 1.0, "height": 1.0}.get(name, 1e-9)
            if not least <= number < 1e9:
                raise CalibrationError(f"the camera's {name} is {value!r}, which is impossible")
        if self.baseline_m > MAX_BASELINE_M:
            raise CalibrationError(f"the camera's baseline_m is {self.baseline_m:g}", cure="is it in metres?")

    @property
    def K(self) -> Array:
        """(3, 3) camera matrix."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def project(self, points_cam: Array) -> Array:
        """(N, 3) points in ``cam`` [m] to (N, 3) measurements (u, v, disparity) [px]."""
        X, Y, Z = np.asarray(points_cam, dtype=np.float64).T
        return np.stack(
            [
                self.fx_px * X / Z + self.cx_px,
                self.fy_px * Y / Z + self.cy_px,
                self.fx_px * self.baseline_m / Z,
            ],
            axis=1,
        )


@dataclass(frozen=True)
class StereoFrame:
    """One stereo pair: ``left`` and ``right`` are (H, W) uint8, raw or rectified as the source says."""

    t_ns: int
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]


@dataclass(frozen=True)
class TrackFrame:
    """One frame of stereo tracks: ``track`` (N,) identities, ``uv_left``/``uv_right`` (N, 2) rectified pixels."""

    t_ns: int
    track: NDArray[np.int64]
    uv_left: Array
    uv_right: Array


@dataclass(frozen=True)
class StereoTracks:
    """Points that odometry followed: one row per observation.

    ``t_ns`` (M,) stamp of the frame; ``track`` (M,) identity of the point; ``uvd`` (M, 3) left column, row and
    disparity [px]; ``is_inlier`` (M,) whether the observation agrees with the motion found.
    """

    t_ns: NDArray[np.int64]
    track: NDArray[np.int64]
    uvd: Array
    is_inlier: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def join(cls, tables: Sequence[StereoTracks]) -> StereoTracks:
        """All rows in order of time, then of track."""
        t_ns, track, uvd, is_inlier = (np.concatenate([getattr(t, f.name) for t in tables]) for f in fields(cls))
        order = np.lexsort((track, t_ns))
        return cls(t_ns[order], track[order], uvd[order], is_inlier[order])


@dataclass(frozen=True)
class ImuNoise:
    """White noise densities and random walks of an IMU, in Kalibr's units."""

    gyro_density_radps_sqrthz: float
    acc_density_mps2_sqrthz: float
    gyro_walk_radps2_sqrthz: float
    acc_walk_mps3_sqrthz: float


@dataclass(frozen=True)
class ImuLog:
    """IMU samples in the IMU's own frame, already shifted to the camera's clock.

    ``t_ns`` (N,) int64; ``gyro_radps`` (N, 3); ``acc_mps2`` (N, 3) specific force (+9.8 up at rest), NaN throughout
    where there is a gyroscope alone.
    """

    t_ns: NDArray[np.int64]
    gyro_radps: Array
    acc_mps2: Array
    noise: ImuNoise | None = None


MOST_RADPS, MOST_MPS2 = 30.0, 150.0
"""A reading of an IMU beyond is saturation or a fault: usual sensors end at 2000 deg/s and 16 g, and VO long before."""


@dataclass(frozen=True)
class Mounting:
    """Where the rectified left camera sits: ``T_body_cam`` and ``T_imu_cam`` (4, 4), None where unknown.

    ``body`` is FLU ``base_link``, or the robot's frame that is named.
    """

    T_body_cam: Array | None = None
    T_imu_cam: Array | None = None
    body: str = "base_link"


@dataclass(frozen=True)
class Vehicle:
    """What a camera's acceleration [m/s^2] and angular acceleration [rad/s^2] never exceed on this vehicle."""

    max_acceleration_mps2: float = 40.0
    max_turn_radps2: float = 200.0


VEHICLES = {
    "any": Vehicle(),
    "car": Vehicle(12.0, 20.0),
    "rover": Vehicle(20.0, 50.0),
    "multirotor": Vehicle(40.0, 200.0),
    "handheld": Vehicle(40.0, 100.0),
}
"""Tyres hold a car to about one g, a rover that drops off a stone sees two; a multirotor has two to four times its
weight in thrust and turns over within a tenth of a second; an arm moves a camera at up to four g, a wrist flicks."""


@dataclass(frozen=True)
class TruthLog:
    """Ground truth poses of the rectified left camera: ``t_ns`` (N,), ``T_world_cam`` (N, 4, 4).

    ``sigma_translation_m`` and ``sigma_rotation_rad``: standard deviation of the truth's own white noise per
    pose and axis; 0 for simulation. ``v_world_mps`` (N, 3): velocity of the camera as the source measures it beside the
    positions, None where it does not.
    """

    t_ns: NDArray[np.int64]
    T_world_cam: Array
    sigma_translation_m: float = 0.0
    sigma_rotation_rad: float = 0.0
    v_world_mps: Array | None = None

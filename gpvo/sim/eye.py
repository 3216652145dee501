"""From world to images, by the renderer and the sensor of one flight's true rig; what a camera makes of light: optics,
exposure, noise and 8 bits; and the flow between two images."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.cameras.rig import StereoRig
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import sequence_plan
from gpvo.sim.imu import Motion
from gpvo.sim.scenario import Scenario
from gpvo.sim.worlds import World
from gpvo.types import Array, out_of_limits, within

Image = NDArray[np.float32]
Grey = NDArray[np.uint8]

_BARE_SIGMA_PX = 16.0
# A point further away than what the next image shows there, by this share, is hidden in it.
_HIDDEN = 0.01


class Eye:
    """Draws what a rig sees on a motion.

    Raises GpvoError for an unknown value of the scenario's ``sensor``; MissingExtraError without numba.
    """

    def __init__(
        self, scenario: Scenario, seed: int, world: World, rig: StereoRig, motion: Motion, threads: int
    ) -> None:
        from gpvo.sim.render import StereoRenderer

        known = [f.name for f in fields(SensorParams)]
        if unknown := sorted(set(scenario.sensor) - set(known)):
            raise GpvoError(f"unknown value 'sensor.{unknown[0]}'", cure=f"known: {', '.join(known)}")
        assert rig.T_body_left is not None
        self._renderer = StereoRenderer(world, rig.left, rig.right, rig.T_right_left, threads=threads)
        self._sensor = SensorModel(SensorParams(**scenario.sensor), seed, threads=threads)
        self._motion, self._T_body_left, self._right_light = motion, rig.T_body_left, scenario.right_light
        self.model, self.T_world_cam = rig.left, np.eye(4)
        self.depth_m: NDArray[np.float32] | None = None

    def see(self, index: int, plan: sequence_plan.FramePlan) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Left and right image (H, W). ``depth_m`` then holds the left camera's depth, NaN where there is nothing;
        ``T_world_cam`` its pose."""
        pose, blur = sequence_plan.camera_poses(self._motion, plan.step, plan.exposure_s, self._T_body_left)
        left, right, depth = self._renderer.render(pose, motion=blur)
        self.depth_m, self.T_world_cam = depth, pose
        if plan.bare:
            left, right = without_texture(left, plan.bare), without_texture(right, plan.bare)
        if self._right_light != 1.0:
            right = right * np.float32(self._right_light)
        depths = [depth, self._renderer.depth_right] if plan.dust else None
        pair = self._sensor.expose(
            left, right, index, depth=depths, darkness=plan.light, dust=plan.dust, noise_sigma=plan.noise_sigma
        )
        return (np.zeros_like(pair[0]), np.zeros_like(pair[1])) if plan.fate == "black" else pair


def without_texture(linear: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    """Radiance (H, W) with ``share`` of its detail finer than about 40 px gone, as on a plastered wall."""
    seen = (linear > 0).astype(np.float32)
    weight = cv2.GaussianBlur(seen, (0, 0), _BARE_SIGMA_PX)
    smooth = cv2.GaussianBlur(linear, (0, 0), _BARE_SIGMA_PX) / np.maximum(weight, np.float32(1e-6))
    return np.asarray(seen * (np.float32(share) * smooth + np.float32(1 - share) * linear), np.float32)


def optical_flow(
    model: CameraModel, depth_m: Image, depth_next_m: Image, T_world_cam: Array, T_world_next: Array
) -> Image:
    """Where each pixel is in the next image, less where it is now: (H, W, 2) [px].

    ``depth_m``, ``depth_next_m`` (H, W): along the optical axis, NaN where there is nothing; poses (4, 4) of the two
    images. NaN where nothing is seen, where it leaves the image, and where something nearer hides it.
    """
    height, width = depth_m.shape
    v, u = np.mgrid[:height, :width]
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    rays = model.unproject(uv)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = rays * (depth_m.reshape(-1, 1) / rays[:, 2:])
    known = np.isfinite(points[:, 2])
    moved = se3.transform(se3.inverse(T_world_next) @ T_world_cam, np.where(known[:, None], points, 1.0))
    there, valid = model.project(moved)
    inside = (there[:, 0] >= 0) & (there[:, 1] >= 0) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    good: NDArray[np.bool_] = known & valid & inside
    at = np.where(good[:, None], there, 0.0).astype(np.float32)
    # The farthest of the neighbours: on a slope the point itself lies between them.
    around = cv2.dilate(np.nan_to_num(depth_next_m, nan=0.0), np.ones((3, 3), np.uint8))
    seen = cv2.remap(around, at[:, 0].reshape(height, width), at[:, 1].reshape(height, width), cv2.INTER_NEAREST)
    good &= moved[:, 2] <= (1 + _HIDDEN) * seen.ravel()
    return np.where(good[:, None], there - uv, np.nan).astype(np.float32).reshape(height, width, 2)


_SHOT_STREAM, _ADDED_STREAM, _FIXED_STREAM = 0, 1, 2


@dataclass(frozen=True)
class SensorParams:
    """A small global-shutter camera.

    ``psf_sigma_px``: Gaussian point spread (0: none). ``vignetting``: loss of light in the corners, 0..1. ``prnu``:
    standard deviation of the pixels' gains. ``full_well_e, read_noise_e``: electrons; together the shot and read
    noise, both 0 for none. ``auto_exposure``: share of the way to the wanted exposure done per frame, 0 for a fixed
    ``gain``. ``target``: wanted linear value of bright parts of the image, 0..1. ``max_gain``: limit of exposure
    times gain per unit of radiance. ``gamma``: exponent of the tone curve.
    """

    psf_sigma_px: float = within(0.55, 0, 5)
    vignetting: float = within(0.3, 0, 0.95)
    prnu: float = within(0.006, 0, 0.2)
    full_well_e: float = within(6000.0, 0, 1e7)
    read_noise_e: float = within(6.0, 0, 1e5)
    auto_exposure: float = within(0.08, 0, 1)
    gain: float | None = None
    target: float = within(0.30, 0.01, 0.99)
    max_gain: float = within(60.0, 1e-3, 1e6)
    gamma: float = within(0.5, 0.2, 1)

    def __post_init__(self) -> None:
        for name, value, low, high in out_of_limits(self):
            raise GpvoError(f"the sensor's {name} = {value} is not between {low} and {high}")


class SensorModel:
    """A stereo pair of sensors with shared exposure.

    All noise comes from a counter-based generator keyed by seed, frame index and camera, so a frame's bytes depend
    neither on threads nor on the frames drawn before, except through the exposure: ``exposure`` is its state, to be
    kept and set again when a sequence is taken up in the middle.
    """

    def __init__(self, params: SensorParams | None = None, seed: int = 0, *, threads: int = 2) -> None:
        self.params = params or SensorParams()
        self.exposure: float | None = self.params.gain
        self._seed = int(seed)
        self._fixed: dict[tuple[int, tuple[int, ...]], Image] = {}
        self._pool = ThreadPoolExecutor(2) if threads > 1 else None

    def expose(
        self,
        left_linear: Image,
        right_linear: Image,
        frame_index: int,
        *,
        depth: Sequence[Image] | None = None,
        darkness: float = 1.0,
        dust: float = 0.0,
        noise_sigma: float = 0.0,
    ) -> tuple[Grey, Grey]:
        """Two (H, W) uint8 images from linear radiance.

        ``darkness``: factor on all light, 1 is as drawn. ``dust``: extinction of the air [1/m], which needs the
        ``depth`` of both. ``noise_sigma``: additional white noise on the 0..1 scale of the grey values. Raises
        GpvoError for dust without depth, or a negative amount of anything.
        """
        if min(darkness, dust, noise_sigma) < 0:
            raise GpvoError("darkness, dust and noise_sigma cannot be negative")
        images = [left_linear, right_linear]
        if darkness != 1.0:
            images = [image * np.float32(darkness) for image in images]
        if dust > 0:
            if depth is None:
                raise GpvoError("dust needs the depth of the image", cure="pass depth=")
            images = [through_dust(image, d, dust) for image, d in zip(images, depth, strict=True)]
        self._adjust(images[0])
        jobs = [(image, side, frame_index, noise_sigma) for side, image in enumerate(images)]
        run = map if self._pool is None else self._pool.map
        left, right = run(lambda job: self._develop(*job), jobs)
        return left, right

    def _adjust(self, image: Image) -> None:
        """Move the shared exposure towards the one that puts the bright parts of the left image at the target."""
        p = self.params
        if self.exposure is not None and p.auto_exposure == 0:
            return
        sample = image[::8, ::8]
        sample = sample[sample > 0]
        bright = float(np.percentile(sample, 70)) if len(sample) else 0.0
        wanted = min(p.target / max(bright, 1e-9), p.max_gain)
        old = wanted if self.exposure is None else self.exposure
        self.exposure = old * (wanted / old) ** p.auto_exposure

    def _develop(self, linear: Image, side: int, frame: int, noise_sigma: float) -> Grey:
        p = self.params
        x = np.ascontiguousarray(linear, dtype=np.float32)
        if p.psf_sigma_px > 0:
            x = cv2.GaussianBlur(x, (0, 0), p.psf_sigma_px)
        x = x * (self._fixed_pattern(side, x.shape) * np.float32(self.exposure or 1.0))
        if p.full_well_e > 0:
            variance = np.maximum(x, 0) * np.float32(1 / p.full_well_e) + np.float32(
                (p.read_noise_e / p.full_well_e) ** 2
            )
            x += np.sqrt(variance, out=variance) * self._normal(x.shape, frame, side, _SHOT_STREAM)
        np.clip(x, 0, 1, out=x)
        x = np.sqrt(x, out=x) if p.gamma == 0.5 else np.power(x, np.float32(p.gamma), out=x)
        if noise_sigma > 0:
            x += np.float32(noise_sigma) * self._normal(x.shape, frame, side, _ADDED_STREAM)
        x *= np.float32(255)
        return np.clip(np.rint(x, out=x), 0, 255, out=x).astype(np.uint8)

    def _normal(self, shape: tuple[int, ...], frame: int, side: int, stream: int) -> Image:
        key = np.array([self._seed & (2**64 - 1), ((frame + 1) << 8) | (stream << 1) | side], dtype=np.uint64)
        return np.random.Generator(np.random.Philox(key=key)).standard_normal(shape, dtype=np.float32)

    def _fixed_pattern(self, side: int, shape: tuple[int, ...]) -> Image:
        """Vignetting and the pixels' gains of one camera."""
        if (side, shape) not in self._fixed:
            H, W = shape
            y, x = np.mgrid[:H, :W].astype(np.float32)
            r2 = ((x - (W - 1) / 2) ** 2 + (y - (H - 1) / 2) ** 2) / ((W / 2) ** 2 + (H / 2) ** 2)
            gains = 1 + np.float32(self.params.prnu) * self._normal(shape, -1, side, _FIXED_STREAM)
            self._fixed[side, shape] = ((1 - np.float32(self.params.vignetting) * r2) * gains).astype(np.float32)
        return self._fixed[side, shape]


def through_dust(linear: Image, depth: Image, extinction_per_m: float) -> Image:
    """Radiance seen through air with dust, which dims what is behind it and glows itself.

    H. Koschmieder, "Theorie der horizontalen Sichtweite" (1924): ``L exp(-b d) + A (1 - exp(-b d))``. The airlight A
    is the median radiance of the image. NaN depth counts as infinitely far.
    """
    transmission = np.exp(-np.float32(extinction_per_m) * np.nan_to_num(np.abs(depth), nan=1e4))
    seen = linear[linear > 0]
    airlight = np.float32(np.median(seen[::16])) if len(seen) else np.float32(0)
    return (linear * transmission + airlight * (1 - transmission)).astype(np.float32)

"""What a camera makes of light: optics, exposure, noise and 8 bits."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError

Image = NDArray[np.float32]
Grey = NDArray[np.uint8]

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

    psf_sigma_px: float = 0.55
    vignetting: float = 0.3
    prnu: float = 0.006
    full_well_e: float = 6000.0
    read_noise_e: float = 6.0
    auto_exposure: float = 0.08
    gain: float | None = None
    target: float = 0.30
    max_gain: float = 60.0
    gamma: float = 0.5

    def __post_init__(self) -> None:
        limits = (
            ("psf_sigma_px", self.psf_sigma_px, 0, 5),
            ("vignetting", self.vignetting, 0, 0.95),
            ("prnu", self.prnu, 0, 0.2),
            ("full_well_e", self.full_well_e, 0, 1e7),
            ("read_noise_e", self.read_noise_e, 0, 1e5),
            ("auto_exposure", self.auto_exposure, 0, 1),
            ("target", self.target, 0.01, 0.99),
            ("max_gain", self.max_gain, 1e-3, 1e6),
            ("gamma", self.gamma, 0.2, 1),
        )
        for name, value, low, high in limits:
            if not low <= value <= high:
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
        depth: Image | Sequence[Image] | None = None,
        darkness: float = 1.0,
        dust: float = 0.0,
        noise_sigma: float = 0.0,
    ) -> tuple[Grey, Grey]:
        """Two (H, W) uint8 pictures from linear radiance.

        ``darkness``: factor on all light, 1 is as drawn. ``dust``: extinction of the air [1/m], which needs ``depth``:
        that of the left camera, or of both. ``noise_sigma``: additional white noise on the 0..1 scale of the grey
        values. Raises GpvoError for dust without depth, or a negative amount of anything.
        """
        if min(darkness, dust, noise_sigma) < 0:
            raise GpvoError("darkness, dust and noise_sigma cannot be negative")
        images = [left_linear, right_linear]
        if darkness != 1.0:
            images = [image * np.float32(darkness) for image in images]
        if dust > 0:
            if depth is None:
                raise GpvoError("dust needs the depth of the picture", cure="pass depth=")
            both = [depth, depth] if isinstance(depth, np.ndarray) else list(depth)
            images = [through_dust(image, d, dust) for image, d in zip(images, both, strict=True)]
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
    is the median radiance of the picture. NaN depth counts as infinitely far.
    """
    transmission = np.exp(-np.float32(extinction_per_m) * np.nan_to_num(np.abs(depth), nan=1e4))
    seen = linear[linear > 0]
    airlight = np.float32(np.median(seen[::16])) if len(seen) else np.float32(0)
    return (linear * transmission + airlight * (1 - transmission)).astype(np.float32)

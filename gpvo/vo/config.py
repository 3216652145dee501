"""Settings of the odometry and the two named presets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, get_type_hints

from gpvo.errors import GpvoError
from gpvo.types import Vehicle, out_of_limits, within

METHODS = ("triangulation", "pointing_matching", "spherical")


KNOWN_DEPTH_PX = 0.5  # disparity below which depth is unknown even in order of magnitude
TELLING_PX = 2 * KNOWN_DEPTH_PX  # disparity above which a point alone tells something of the translation


@dataclass(frozen=True)
class VoConfig:
    """Everything that changes what the odometry does. Pixels are those of the rectified image.

    Limits include both ends; values of OpenCV stop the process where they are out of range.
    """

    preset: str = "fast"
    max_features: int = within(300, 8, 20_000)  # corners kept per frame
    min_distance_px: float = within(9.0, 1, 1000)  # between corners
    corner_quality: float = within(0.004, 1e-6, 1)  # relative to the best corner of the image
    klt_window_px: int = within(15, 3, 101)
    klt_levels: int = within(4, 1, 10)
    max_row_error_px: float = within(1.5, 0.01, 1000)  # of a left-right match; 0 in an ideal rectification
    min_disparity_px: float = within(-2.0, -1000, 1000)  # noise puts far points below 0: it must not choose
    max_disparity_share: float = within(0.25, 0.01, 1)  # of the image width
    ransac_threshold_px: float = within(2.0, 0.01, 1000)
    ransac_iterations: int = within(1000, 1, 100_000)  # at most: few where most points agree
    min_inliers: int = within(8, 4, 10_000)  # fewer: lost; P3P needs four
    weak_inliers: int = within(20, 0, 10_000)  # fewer: degraded
    max_acceleration_mps2: float = within(40.0, 1e-6, 1e6)  # of the vehicle: beyond, a motion is another's
    max_turn_radps2: float = within(200.0, 1e-6, 1e6)  # its angular acceleration: beyond, a motion is a slip
    keyframe_parallax_px: float = within(1.0, 0, 1000)  # of the median point: below, the reference is kept; 0: never
    methods: tuple[str, ...] = ("triangulation", "pointing_matching")
    sigma_px: float = within(1.0, 1e-6, 100)  # triangulation: of each image coordinate
    sigma_p_px: float | None = within(None, 1e-6, 100)  # pointing; None: estimated from the residuals so far
    sigma_m_px: float | None = within(None, 1e-6, 100)  # matching; None: likewise
    sigma_pairs_px: tuple[tuple[float, float], ...] = ()  # further pairs, each stated as a method of its own
    self_calibration: bool = True  # estimate what the calibration has wrong between the cameras
    persistent_noise: bool = True  # estimate the error of disparity that a point keeps while it is followed
    window: int = within(2, 2, 20)  # frames adjusted together; 2: each motion for itself
    seed: int = within(0, 0, 2**31 - 1)

    @property
    def vehicle(self) -> Vehicle:
        """What carries the camera."""
        return Vehicle(self.max_acceleration_mps2, self.max_turn_radps2)

    @property
    def stated(self) -> tuple[str, ...]:
        """Every covariance that a record states: the methods, then the further pairs."""
        return (*self.methods, *(pair_method(p, m) for p, m in self.sigma_pairs_px))


def pair_method(sigma_p_px: float, sigma_m_px: float) -> str:
    """Name of pointing/matching with these sigmas [px], such as ``pointing_matching_0p1_0p5``."""
    return f"pointing_matching_{sigma_p_px:.6g}_{sigma_m_px:.6g}".replace(".", "p").replace("-", "m")


PRESETS: dict[str, VoConfig] = {
    "fast": VoConfig(),
    # What the thesis describes, to the letter: every frame is matched afresh to the one before.
    "thesis": VoConfig(
        preset="thesis",
        keyframe_parallax_px=0.0,
        max_features=500,
        min_disparity_px=KNOWN_DEPTH_PX,
        ransac_iterations=150,
        sigma_p_px=0.1,
        sigma_m_px=0.5,
        self_calibration=False,
        persistent_noise=False,
    ),
}


_SWITCH = {"on": True, "true": True, "off": False, "false": False}


def make_config(preset: str = "fast", **overrides: object) -> VoConfig:
    """A preset with single values replaced.

    Raises GpvoError for an unknown preset, setting or covariance method, or a value out of its range.
    """
    if preset not in PRESETS:
        raise GpvoError(f"unknown preset '{preset}'", cure=f"choose one of {', '.join(PRESETS)}")
    try:
        config = replace(PRESETS[preset], **overrides)  # type: ignore[arg-type]
    except TypeError as error:
        raise GpvoError(f"unknown odometry setting: {error}", cure="see gpvo.vo.config.VoConfig") from None
    for method in config.methods:
        if method not in METHODS:
            raise GpvoError(f"unknown covariance method '{method}'", cure=f"choose from {', '.join(METHODS)}")
    for name, value, low, high in out_of_limits(config):
        raise GpvoError(f"{name} is {value}", cure=f"give a value from {low:g} to {high:g}")
    return config


def read_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Values of :class:`VoConfig` from texts such as ``klt_window_px=21``; ``auto`` is None, commas part lists.

    Raises GpvoError for an unknown name, or a value of the wrong type.
    """
    kinds = get_type_hints(VoConfig)
    names = [f.name for f in fields(VoConfig) if f.name not in ("preset", "sigma_pairs_px")]
    out: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or name not in names:
            raise GpvoError(f"unknown odometry setting '{text}'", cure=f"give NAME=VALUE, NAME of {', '.join(names)}")
        try:
            out[name] = _read(value, kinds[name])
        except (KeyError, ValueError):
            usual = getattr(VoConfig(), name)
            cure = f"its default is {'auto' if usual is None else usual}"
            raise GpvoError(f"{name} cannot be '{value}'", cure=cure) from None
    return out


def _read(text: str, kind: Any) -> object:
    """One value of this type."""
    if kind is bool:
        return _SWITCH[text.lower()]
    if kind is int:
        return int(text)
    if kind is float:
        return float(text)
    if kind == float | None:
        return None if text == "auto" else float(text)
    return tuple(part.strip() for part in text.split(",") if part.strip())

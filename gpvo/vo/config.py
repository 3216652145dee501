"""Settings of the odometry and the two named presets."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gpvo.errors import GpvoError

METHODS = ("triangulation", "pointing_matching", "spherical")


@dataclass(frozen=True)
class VoConfig:
    """Everything that changes what the odometry does. Pixels are those of the rectified image."""

    preset: str = "fast"
    max_features: int = 300  # corners kept per frame
    min_distance_px: float = 9.0  # between corners
    corner_quality: float = 0.004  # relative to the best corner of the image
    klt_window_px: int = 15
    klt_levels: int = 4
    max_row_error_px: float = 1.5  # of a left-right match; an ideal rectification gives 0
    min_disparity_px: float = 0.5  # below, depth is unknown even in order of magnitude
    max_disparity_share: float = 0.25  # of the image width
    ransac_threshold_px: float = 2.0
    ransac_iterations: int = 150
    min_inliers: int = 8  # fewer: lost
    weak_inliers: int = 20  # fewer: degraded
    keyframe_parallax_px: float = 1.0  # keep the reference while the median image motion is below this; 0: never
    methods: tuple[str, ...] = ("triangulation", "pointing_matching")
    sigma_px: float = 1.0  # triangulation: of each image coordinate
    sigma_p_px: float | None = 0.1  # pointing; None: estimated from the residuals so far
    sigma_m_px: float | None = 0.5  # matching; None: likewise
    sigma_pairs_px: tuple[tuple[float, float], ...] = ()  # further pairs, each stated as a method of its own
    self_calibration: bool = True  # estimate what the calibration has wrong between the cameras
    seed: int = 0

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
    "thesis": VoConfig(preset="thesis", keyframe_parallax_px=0.0, max_features=500, self_calibration=False),
}


def make_config(preset: str = "fast", **overrides: object) -> VoConfig:
    """A preset with single values replaced.

    Raises
    ------
    GpvoError
        For an unknown preset, setting or covariance method.
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
    for name in ("sigma_px", "sigma_p_px", "sigma_m_px"):
        value = getattr(config, name)
        if value is not None and not 0 < value < 100:
            raise GpvoError(f"{name} is {value}", cure="give a standard deviation between 0 and 100 pixels")
    return config

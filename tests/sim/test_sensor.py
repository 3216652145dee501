"""The sensor: the same bytes whatever the threads, noise of the stated size, shared exposure."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.sim.eye import SensorModel, SensorParams, through_dust


def _ramp(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (0.05 + 0.5 * rng.random((48, 64))).astype(np.float32)


def test_same_bytes_in_any_number_of_threads_and_after_taking_up() -> None:
    frames = [(_ramp(k), _ramp(k + 50)) for k in range(6)]
    one, two = SensorModel(seed=3, threads=1), SensorModel(seed=3, threads=2)
    first = [one.expose(*pair, k, noise_sigma=0.02) for k, pair in enumerate(frames)]
    exposure = None
    for k, pair in enumerate(frames):
        np.testing.assert_array_equal(first[k], two.expose(*pair, k, noise_sigma=0.02))
        exposure = two.exposure if k == 3 else exposure
    again = SensorModel(seed=3)
    again.exposure = exposure
    np.testing.assert_array_equal(first[4], again.expose(*frames[4], 4, noise_sigma=0.02))


def test_frames_cameras_and_seeds_have_noise_of_their_own() -> None:
    flat = np.full((64, 64), 0.3, np.float32)
    params = SensorParams(gain=1.0, auto_exposure=0, vignetting=0, prnu=0)
    model = SensorModel(params, seed=1)
    pictures = [
        *model.expose(flat, flat, 0),
        *model.expose(flat, flat, 1),
        *SensorModel(params, 2).expose(flat, flat, 0),
    ]
    deviations = np.array([p.astype(float).ravel() - p.mean() for p in pictures])
    correlation = np.corrcoef(deviations) - np.eye(len(pictures))
    assert np.abs(correlation).max() < 0.08


@pytest.mark.parametrize("level", [0.1, 0.4])
def test_shot_and_read_noise_are_as_stated(level: float) -> None:
    params = SensorParams(
        psf_sigma_px=0, vignetting=0, prnu=0, gain=1.0, auto_exposure=0, gamma=1.0, full_well_e=2000, read_noise_e=12
    )
    flat = np.full((300, 300), level, np.float32)
    left, _ = SensorModel(params).expose(flat, flat, 0)
    expected = np.sqrt(level / 2000 + (12 / 2000) ** 2 + 1 / 12 / 255**2)
    assert np.std(left / 255) == pytest.approx(expected, rel=0.02)
    assert np.mean(left / 255) == pytest.approx(level, abs=2e-3)


def test_added_noise_is_on_the_scale_of_grey_values() -> None:
    params = SensorParams(psf_sigma_px=0, vignetting=0, prnu=0, gain=1.0, auto_exposure=0, full_well_e=0)
    flat = np.full((300, 300), 0.25, np.float32)
    left, right = SensorModel(params).expose(flat, flat, 7, noise_sigma=0.025)
    for picture in (left, right):
        assert np.std(picture / 255) == pytest.approx(0.025, rel=0.02)
        assert np.mean(picture / 255) == pytest.approx(0.5, abs=1e-3)


def test_exposure_is_shared_follows_slowly_and_has_a_limit() -> None:
    bright = np.full((64, 64), 0.6, np.float32)
    model = SensorModel(SensorParams(full_well_e=0, prnu=0, vignetting=0, psf_sigma_px=0))
    left, right = model.expose(bright, 0.5 * bright, 0)
    assert np.mean(left) == pytest.approx(255 * np.sqrt(0.3), abs=1)
    assert np.mean(right) == pytest.approx(255 * np.sqrt(0.15), abs=1)
    dark = model.expose(bright, bright, 1, darkness=0.05)[0]
    assert np.mean(dark) < 80
    for k in range(2, 150):
        left, _ = model.expose(bright, bright, k, darkness=0.05)
    assert np.mean(left) == pytest.approx(255 * np.sqrt(0.3), abs=2)
    black, _ = SensorModel(SensorParams(full_well_e=0)).expose(0 * bright, 0 * bright, 0)
    assert black.max() == 0


def test_dust_hides_what_is_far() -> None:
    checks = (np.indices((64, 64)).sum(axis=0) % 2 * 0.5 + 0.1).astype(np.float32)
    depth = np.full((64, 64), 5.0, np.float32)
    depth[:, 32:] = np.nan
    seen = through_dust(checks, depth, 0.4)
    assert seen[:, :32].std() / checks.std() == pytest.approx(np.exp(-2.0), rel=1e-3)
    assert seen[:, 32:].std() < 1e-6
    with pytest.raises(GpvoError, match="depth"):
        SensorModel().expose(checks, checks, 0, dust=0.1)


def test_impossible_parameters_are_refused() -> None:
    with pytest.raises(GpvoError, match="vignetting"):
        SensorParams(vignetting=2)
    with pytest.raises(GpvoError, match="negative"):
        SensorModel().expose(_ramp(), _ramp(), 0, noise_sigma=-1)

"""A rig that cannot exist is refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.cameras.models import PinholeRadtan
from gpvo.cameras.rig import StereoRig
from gpvo.errors import CalibrationError
from gpvo.geometry import se3

LENS = PinholeRadtan(400.0, 400.0, 320.0, 240.0, 640, 480)


def _T(x, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    return se3.from_rt(se3.so3_exp(np.array(turn)), np.array([x, y, z]))


@pytest.mark.parametrize(
    ("T", "reason"),
    [
        (_T(0.11), "left and right are swapped"),
        (_T(0.0), "both cameras in one place"),
        (_T(-1e-5), "both cameras in one place"),
        (_T(-110.0), "more than 10 m"),
        (_T(-0.01, 0.05, 0.11), "in front of or behind"),
        (_T(-0.01, 0.0, 0.11), "in front of or behind"),
        (_T(-0.11, turn=(0, 0.8, 0)), "rotated by 46 degrees to each other"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.diag([2.0, 1, 1, 1]), "rigid transform"),
        (np.eye(3), r"shape \(3, 3\)"),
    ],
)
def test_impossible_geometry(T, reason):
    with pytest.raises(CalibrationError, match=reason):
        StereoRig(LENS, LENS, T, where="calib.yaml")


@pytest.mark.parametrize(
    ("lens", "reason"),
    [
        (PinholeRadtan(800.0, 800.0, 320.0, 240.0, 640, 480), "do not make a stereo pair"),
        (PinholeRadtan(400.0, 400.0, 1500.0, 240.0, 640, 480), "principal point"),
        (PinholeRadtan(-400.0, 400.0, 320.0, 240.0, 640, 480), "focal lengths"),
        (PinholeRadtan(400.0, 400.0, 320.0, float("nan"), 640, 480), "finite"),
        (PinholeRadtan(400.0, 400.0, 320.0, 240.0, 0, 480), "resolution"),
    ],
)
def test_impossible_lens(lens, reason):
    with pytest.raises(CalibrationError, match=reason):
        StereoRig(LENS, lens, _T(-0.1))


def test_lenses_are_compared_by_what_they_see():
    """Sensors of one view may differ in resolution."""
    fine = PinholeRadtan(800.0, 800.0, 640.0, 480.0, 1280, 960)
    assert StereoRig(LENS, fine, _T(-0.1)).baseline_m == pytest.approx(0.1)
    part = replace(LENS, width=LENS.width // 2, cx_px=LENS.cx_px / 2)
    assert StereoRig(LENS, part, _T(-0.1)).resolution == 1.0


def test_a_swapped_pair_set_back_is_refused():
    with pytest.raises(CalibrationError, match="swapped"):
        StereoRig(LENS, LENS, _T(0.069, -0.02, -0.069))


def test_good_rigs_pass():
    assert StereoRig(LENS, LENS, _T(-0.1)).is_rectified
    toed_in = StereoRig(LENS, LENS, _T(-0.1, 0.005, -0.01, turn=(0.05, 0.2, 0.05)))
    assert not toed_in.is_rectified
    assert toed_in.baseline_m == pytest.approx(np.sqrt(0.1**2 + 0.005**2 + 0.01**2))


def test_mask_of_another_size():
    with pytest.raises(CalibrationError, match="mask is 10x20"):
        StereoRig(LENS, LENS, _T(-0.1)).with_masks(np.ones((20, 10), bool), None)

"""Interpolated truth: exact at its stamps, between them on the geodesic, nothing beyond."""

from __future__ import annotations

import numpy as np
from gpvo.dataset.errors import interpolate_truth
from gpvo.geometry import se3
from gpvo.types import TruthLog

START_NS = 1_403_636_579_763_555_584
XI = np.array([1.0, 0.2, -0.1, 0.0, 0.0, 0.4])


def _truth(times_s: np.ndarray) -> TruthLog:
    """Straight and evenly turning: interpolation makes no error."""
    T = se3.exp(np.zeros((len(times_s), 6)))
    T[:, :3, :3] = se3.so3_exp(times_s[:, None] * XI[3:])
    T[:, :3, 3] = times_s[:, None] * XI[:3]
    return TruthLog(START_NS + np.round(times_s * 1e9).astype(np.int64), T)


def test_even_motion_is_interpolated_exactly():
    truth = _truth(np.arange(0, 2, 0.1))
    t_s = np.array([0.0, 0.033, 0.1, 1.234, 1.9])
    T, known = interpolate_truth(truth, START_NS + np.round(t_s * 1e9).astype(np.int64))
    assert known.all()
    np.testing.assert_allclose(T, _truth(t_s).T_world_cam, atol=1e-9)


def test_outside_and_in_gaps_nothing_is_known():
    truth = _truth(np.array([0.0, 0.1, 0.2, 1.0, 1.1]))
    t_s = np.array([-0.001, 0.0, 0.15, 0.2, 0.6, 1.0, 1.1, 1.101])
    T, known = interpolate_truth(truth, START_NS + np.round(t_s * 1e9).astype(np.int64))
    np.testing.assert_array_equal(known, [False, True, True, True, False, True, True, False])
    assert np.isfinite(T).all()
    assert interpolate_truth(truth, np.array([START_NS + 600_000_000]), max_gap_s=1.0)[1].all()


def test_one_pose_is_known_at_its_stamp_alone_and_none_nowhere():
    one = _truth(np.array([0.0]))
    np.testing.assert_array_equal(interpolate_truth(one, START_NS + np.array([-1, 0, 1]))[1], [False, True, False])
    none = TruthLog(np.empty(0, np.int64), np.empty((0, 4, 4)))
    T, known = interpolate_truth(none, one.t_ns)
    assert T.shape == (1, 4, 4)
    assert not known.any()

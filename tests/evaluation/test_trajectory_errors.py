"""ATE, RPE and segments of trajectories whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest
from evaluation_runs import curved_path
from gpvo.evaluation.trajectory import (
    LONG_M,
    SHORT_M,
    Statistics,
    pairs_ahead,
    segments,
    trajectory_errors,
)
from gpvo.geometry import se3

T_NS = 1_403_636_579_763_555_584 + np.arange(1201) * 100_000_000


def _path(step_m: float = 0.1) -> np.ndarray:
    T = [se3.exp(np.array([5.0, 1, 2, 0.3, 0.2, 0.1]))]
    for motion in curved_path(1200, step_m):
        T.append(T[-1] @ motion)
    return np.array(T)


def _line(n: int, step_m: float = 1.0) -> np.ndarray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 2, 3] = step_m * np.arange(n)
    return T


def test_the_truth_itself_has_no_error():
    T = _path()
    # Another origin is no error: nothing but motion counts.
    e = trajectory_errors(T_NS, se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3])) @ T, T)
    assert e.path_length_m == pytest.approx(se3.path_length_m(T[:, :3, 3])[-1])
    for value in (e.ate_rmse_m, e.rmse_origin_m, e.final_error_m):
        assert value < 1e-9
    for r in (e.rpe_frame, e.rpe_second, e.rpe_10m):
        assert r.translation_m.max < 1e-9
        assert r.rotation_rad.max < 1e-9
    assert [s.length_m for s in e.segments] == list(SHORT_M)
    assert all(s.translation_percent < 1e-9 and s.rotation_deg_per_m < 1e-9 for s in e.segments)


def test_a_scale_error_of_one_percent_is_one_percent_on_a_straight_line():
    T = _line(201)
    scaled = T.copy()
    scaled[:, :3, 3] *= 1.01
    e = trajectory_errors(T_NS[:201], scaled, T)
    for s in e.segments:
        assert s.translation_percent == pytest.approx(1.0, rel=1e-9)
        assert s.rotation_deg_per_m == 0
    assert e.final_error_m == pytest.approx(2.0)
    assert e.rpe_frame.translation_m.mean == pytest.approx(0.01)
    assert e.rpe_second.translation_m.mean == pytest.approx(0.1)
    assert e.rpe_10m.translation_m.mean == pytest.approx(0.1)


def test_a_yaw_drift_is_so_many_degrees_per_metre():
    T = _line(121)
    turned = T.copy()
    turned[:, :3, :3] = se3.so3_exp(np.outer(np.arange(121), [0, np.radians(0.02), 0]))
    e = trajectory_errors(T_NS[:121], turned, T)
    for s in e.segments:
        assert s.rotation_deg_per_m == pytest.approx(0.02, rel=1e-6)


def test_kitti_segments_by_hand():
    """Starts at frames 0, 10, 20; 10 m at 1 m a frame end ten frames on; frame 15 of the estimate jumps by 0.5 m."""
    T = _line(31)
    estimate = T.copy()
    estimate[15:, 0, 3] += 0.5
    (found,) = segments(estimate, T, (10.0,))
    # 0-10 misses nothing, 10-20 misses 0.5 m of 10, 20-30 misses nothing.
    assert found.count == 3
    assert found.translation_percent == pytest.approx(5.0 / 3)
    (longer,) = segments(estimate, T, (100.0,))
    assert longer.count == 0
    assert np.isnan(longer.translation_percent)


def test_long_paths_have_kittis_lengths_and_given_ones_win():
    T = _line(1201)
    assert [s.length_m for s in trajectory_errors(T_NS, T, T).segments] == list(LONG_M)
    assert [s.length_m for s in trajectory_errors(T_NS, T, T, (5.0, 50.0)).segments] == [5.0, 50.0]


def test_pairs_ahead_are_the_first_at_least_that_far():
    start, end = pairs_ahead(np.array([0.0, 0.4, 1.0, 1.1, 2.5, 2.6]), 1.0)
    np.testing.assert_array_equal(start, [0, 1, 2, 3])
    np.testing.assert_array_equal(end, [2, 4, 4, 4])
    start, end = pairs_ahead(np.arange(100) * 0.1, 1.0, every=10)
    np.testing.assert_array_equal(end - start, 10)
    start, end = pairs_ahead(np.zeros(5), 1.0)
    assert len(start) == len(end) == 0


def test_over_a_gap_of_the_truth_no_segment_is_measured():
    """It would be longer than it says, and its error with it."""
    T = se3.exp(np.outer(np.arange(400), [0, 0, 0.1, 0, 0, 0]))
    estimate = se3.exp(np.outer(np.arange(400), [0, 0, 0.101, 0, 0, 0]))
    kept = np.r_[:150, 250:400]
    e = trajectory_errors(np.arange(400)[kept] * 50_000_000, estimate[kept], T[kept], (10.0,), kept)
    assert e.rpe_10m.translation_m.max == pytest.approx(0.1, rel=1e-6)
    assert e.segments[0].translation_percent == pytest.approx(1.0, rel=1e-6)
    assert e.segments[0].count == 10


def test_an_error_at_the_end_is_the_final_error():
    T = _path()
    estimate = T.copy()
    estimate[-1, :3, 3] += [0.3, 0, 0.4]
    e = trajectory_errors(T_NS, estimate, T)
    assert e.final_error_m == pytest.approx(0.5)
    assert e.rmse_origin_m == pytest.approx(0.5 / np.sqrt(len(T)))
    assert e.ate_rmse_m <= e.rmse_origin_m


def test_statistics():
    s = Statistics.of(np.array([3.0, 4.0]))
    assert (s.mean, s.median, s.std, s.min, s.max, s.count) == (3.5, 3.5, 0.5, 3.0, 4.0, 2)
    assert s.rmse == pytest.approx(np.sqrt(12.5))
    assert np.isnan(Statistics.of(np.empty(0)).rmse)


def test_over_a_gap_of_the_frames_nothing_is_called_a_second_or_ten_metres():
    """Nor where all frames are sparser: the errors of what lies between would be those of something longer."""
    T, t_ns = se3.exp(np.outer(np.arange(400), [0, 0, 0.3, 0, 0, 0])), np.arange(400) * 100_000_000
    estimate = se3.exp(np.outer(np.arange(400), [0, 0, 0.303, 0, 0, 0]))
    kept = np.r_[:150, 250:400]
    found = trajectory_errors(t_ns[kept], estimate[kept], T[kept], (10.0,))
    assert found.rpe_second.translation_m.max == pytest.approx(0.03)
    assert found.rpe_10m.translation_m.max == pytest.approx(0.102)
    assert found.segments[0].translation_percent == pytest.approx(1.02)
    sparse = trajectory_errors(t_ns[::100], estimate[::100], T[::100], (10.0, 30.0))
    assert sparse.rpe_second.translation_m.count == sparse.rpe_10m.translation_m.count == 0
    assert [s.count for s in sparse.segments] == [0, 1]

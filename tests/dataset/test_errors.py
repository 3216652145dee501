"""The error of a motion: its side, its axes, and for which motions it is formed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from gpvo.dataset.errors import motion_errors
from gpvo.geometry import se3
from gpvo.types import Status, TruthLog, VoLog, VoRecord

N, DT_NS = 12, 50_000_000
RNG = np.random.default_rng(0)
T_TRUE = se3.exp(0.3 * RNG.normal(size=(N, 6)))
XI = 1e-2 * RNG.normal(size=(N, 6))


def _case() -> tuple[VoLog, TruthLog]:
    """Motion k + 1 goes from frame k to k + 1, its error is XI[k]."""
    t = np.arange(N + 1) * DT_NS
    poses = [se3.exp(np.full(6, 0.7))]
    records = [VoRecord(0, 0, Status.START, np.eye(4))]
    for k in range(N):
        poses.append(poses[-1] @ T_TRUE[k])
        records.append(VoRecord(int(t[k + 1]), int(t[k]), Status.OK, T_TRUE[k] @ se3.exp(XI[k])))
    return VoLog(records), TruthLog(t, np.array(poses))


def test_errors_are_on_the_right_of_the_true_motion():
    log, truth = _case()
    found = motion_errors(log, truth)
    np.testing.assert_array_equal(found.index, np.arange(1, N + 1))
    np.testing.assert_allclose(found.xi, XI, atol=1e-12)
    np.testing.assert_allclose(found.T_true, T_TRUE, atol=1e-12)
    np.testing.assert_allclose(found.dt_s, 0.05)


def test_lost_frames_have_no_error_and_degraded_ones_do():
    log, truth = _case()
    records = list(log)
    records[3] = replace(records[3], status=Status.LOST)
    records[4] = replace(records[4], status=Status.DEGRADED)
    found = motion_errors(VoLog(records), truth)
    assert 3 not in found.index
    assert 4 in found.index
    assert 0 not in found.index


def test_a_motion_from_an_older_reference_is_compared_over_its_own_span():
    log, truth = _case()
    records = list(log)
    two = se3.inverse(truth.T_world_cam[2]) @ truth.T_world_cam[4]
    records[3] = replace(records[3], status=Status.LOST)
    records[4] = replace(records[4], t_prev_ns=2 * DT_NS, T_prev_cur=two @ se3.exp(XI[0]))
    found = motion_errors(VoLog(records), truth)
    row = list(found.index).index(4)
    np.testing.assert_allclose(found.xi[row], XI[0], atol=1e-12)
    assert found.dt_s[row] == 0.1


def test_motions_beyond_the_truth_are_left_out():
    log, truth = _case()
    short = TruthLog(truth.t_ns[2:7], truth.T_world_cam[2:7])
    np.testing.assert_array_equal(motion_errors(log, short).index, [3, 4, 5, 6])

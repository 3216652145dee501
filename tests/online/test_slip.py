"""Slips: caught at any speed, manoeuvres believed, flagging twice changes nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.online.slip import SlipDetector, flag_slips, tail_quantile
from gpvo.types import VEHICLES, Status, VoLog, VoRecord
from synthetic_runs import make_run


def _with_jump(log: VoLog, k: int, metres: float) -> VoLog:
    jump = se3.exp(np.array([0, 0, metres, 0, 0, 0]))
    return replace(
        log, records=[replace(r, T_prev_cur=r.T_prev_cur @ jump) if i == k else r for i, r in enumerate(log)]
    )


def _lost(log: VoLog) -> list[int]:
    return [k for k, r in enumerate(log) if r.status is Status.LOST]


@pytest.mark.parametrize("speed, rate_hz", [(0.3, 30.0), (1.0, 20.0), (20.0, 10.0)])
def test_good_motions_pass_and_jumps_are_caught_at_any_speed(speed, rate_hz):
    log, _ = make_run(5, n=600, speed=speed, rate_hz=rate_hz)
    assert _lost(flag_slips(log)) == []
    found = flag_slips(_with_jump(log, 300, metres=2.0 * speed + 0.1))
    assert _lost(found) == [300]
    assert "implausible" in found.records[300].reason


def test_a_second_bad_motion_is_not_believed_because_the_first_was():
    log, _ = make_run(1, n=200, speed=20.0, rate_hz=10.0)
    faster = [
        replace(r, T_prev_cur=r.T_prev_cur @ se3.exp(np.array([0, 0, 500.0, 0, 0, 0]))) if 120 <= k < 125 else r
        for k, r in enumerate(log)
    ]
    flagged = flag_slips(VoLog(faster))
    assert _lost(flagged) == [120, 121, 122, 123, 124]
    assert [r.status for r in flag_slips(flagged)] == [r.status for r in flagged]


def test_what_was_accepted_cannot_raise_the_bound_without_limit():
    """A jerky log, and then a jump of 220 m/s^2."""
    log, _ = make_run(4, n=600, speed=20.0, rate_hz=10.0)
    rng = np.random.default_rng(0)
    jerky = VoLog(
        [replace(r, T_prev_cur=r.T_prev_cur @ se3.exp(0.1 * rng.standard_normal(6) * [1, 1, 1, 0, 0, 0])) for r in log]
    )
    assert 500 in _lost(flag_slips(_with_jump(jerky, 500, metres=2.2)))


def test_a_car_cannot_do_what_any_vehicle_can():
    """A noisy log, whose noise raises the bounds, and then jumps of 80 m/s^2."""
    log, _ = make_run(4, n=600, speed=3.0, rate_hz=10.0)
    rng = np.random.default_rng(0)
    noisy = [r.T_prev_cur @ se3.exp(0.05 * rng.standard_normal(6) * [1, 1, 1, 0, 0, 0]) for r in log]
    log = replace(log, records=[replace(r, T_prev_cur=T) for r, T in zip(log, noisy)])
    jumps = [300, 400, 500]
    for k in jumps:
        log = _with_jump(log, k, metres=0.8)
    assert _lost(flag_slips(log)) == []
    of_a_car = flag_slips(replace(log, vehicle=VEHICLES["car"]))
    assert _lost(of_a_car) == jumps
    # Who judges anew does so from what was measured, not from an earlier verdict.
    again = flag_slips(replace(of_a_car, vehicle=log.vehicle))
    assert [(r.status, r.reason) for r in again] == [(r.status, r.reason) for r in log]


def test_the_gyro_catches_a_turn_that_never_was():
    log, _ = make_run(2, n=200)
    records = []
    for k, r in enumerate(log):
        rate = se3.log(r.T_prev_cur)[3:] / max(r.dt_s, 0.05)
        turned = r.T_prev_cur @ se3.exp(np.array([0, 0, 0, 0, 0.02, 0])) if k == 150 else r.T_prev_cur
        records.append(
            replace(r, T_prev_cur=turned, imu_gyro_mean_radps=rate, imu_acc_mean_mps2=np.array([0, -9.81, 0]))
        )
    assert _lost(flag_slips(VoLog(records))) == [150]


def test_tail_quantile_of_a_known_law():
    draws = (1.0 - np.random.default_rng(0).random(1000)) ** (
        -1 / 4.0
    )  # Pareto, index 4: exceeds x with probability x^-4.
    assert tail_quantile(draws, 1e-6) == pytest.approx(1e-6**-0.25, rel=0.5)
    assert tail_quantile(np.ones(3)) == np.inf


def test_a_motion_after_a_long_gap_starts_afresh():
    log, _ = make_run(3, n=60)
    late = [replace(r, t_ns=r.t_ns + 10**10, t_prev_ns=r.t_prev_ns + 10**10) for r in log.records[30:]]
    detector = SlipDetector()
    assert all(
        detector.step(r).status is not Status.LOST for r in [*log.records[:30], *_with_jump(VoLog(late), 0, 3.0)][:31]
    )


def test_jumps_of_metres_in_real_logs(real_data: Path):
    from gpvo.types import VoRecord

    rows = np.loadtxt(real_data / "kitti_stereo_vo" / "03_est.txt")
    T = se3.from_quaternion(rows[:, 1:4], rows[:, 4:])
    t = np.round(rows[:, 0] * 1e9).astype(int)
    motions = se3.inverse(T[:-1]) @ T[1:]
    start = VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4))
    log = VoLog([start] + [VoRecord(int(b), int(a), Status.OK, m) for a, b, m in zip(t[:-1], t[1:], motions)])
    assert _lost(flag_slips(log)) == [97, 315]
    assert _lost(flag_slips(replace(log, vehicle=VEHICLES["car"]))) == [97, 315]


def _at_200_hz(speed_mps: float, n: int = 1500) -> list[VoRecord]:
    """Ahead and in a gentle turn, without an error."""
    motion = se3.exp(np.array([0, 0, speed_mps, 0, 0.1, 0]) * 0.005)
    t = [5_000_000 * k for k in range(n)]
    start = VoRecord(0, 0, Status.START, np.eye(4))
    return [start, *(VoRecord(t[k], t[k - 1], Status.OK, motion) for k in range(1, n))]


@pytest.mark.parametrize("correction_m", [0.0, 5e-3])
def test_a_propagated_odometry_of_200_hz_makes_no_slips(correction_m):
    """Noise of a millimetre and 0.3 mrad, which is 100 m/s^2 and more at this rate; then corrections at 20 Hz, too."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((1500, 6)) * ([1e-3] * 3 + [3e-4] * 3)
    noise[::10, :3] += correction_m * rng.standard_normal((150, 3)) / np.sqrt(3)
    records = [replace(r, T_prev_cur=r.T_prev_cur @ se3.exp(e)) for r, e in zip(_at_200_hz(1.0), noise, strict=True)]
    noisy = VoLog([records[0], *records[1:]])
    assert _lost(flag_slips(noisy)) == []
    assert _lost(flag_slips(_with_jump(noisy, 700, metres=0.1))) == [700]


def test_a_speed_that_was_never_driven_is_caught_at_200_hz():
    records = _at_200_hz(10.0)
    halted = [replace(r, T_prev_cur=np.eye(4)) if 300 <= k < 340 else r for k, r in enumerate(records)]
    assert _lost(flag_slips(VoLog(halted)))[:10] == list(range(300, 310))

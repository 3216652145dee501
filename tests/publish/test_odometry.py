"""Body odometry from camera motions: frames, lever arm, accumulation, floors, lost frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.covariance import lost_covariance
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.publish.odometry import LEAST_VARIANCE, OdometryBuilder, lift, messages
from gpvo.types import IMPORTED_POSE, Prediction, Status, VoRecord
from synthetic_flights import ErrorLaw, Events, synthetic_flight

from motion_errors import prediction

MOUNT = se3.from_rt(R_FLU_OPTICAL @ se3.so3_exp(np.array([0.1, 0.2, 0.05])), np.array([0.4, 0.1, -0.2]))
TINY = 0.0


def _prediction(t_ns: int, jitter: np.ndarray, white: np.ndarray, bias: np.ndarray, tau: float = 5.0) -> Prediction:
    return prediction(t_ns, jitter, white, bias, tau)


def _spd(rng: np.random.Generator, scale: float) -> np.ndarray:
    A = rng.standard_normal((6, 6)) * scale
    return A @ A.T + 0.1 * scale**2 * np.eye(6)


def test_twist_of_a_spinning_body_has_the_lever_arm_taken_out() -> None:
    rate = np.array([0.0, 0.0, 0.7])
    T_body = se3.exp(np.concatenate([[1.0, 0.0, 0.0], rate]) * 0.1)
    T_cam = se3.inverse(MOUNT) @ T_body @ MOUNT
    record = VoRecord(10**8, 0, Status.OK, T_cam)
    C = _spd(np.random.default_rng(0), 1e-3)
    out = OdometryBuilder(MOUNT, floor=TINY).step(record, _prediction(10**8, 0 * C, C, 0 * C))
    assert out.twist_body is not None
    np.testing.assert_allclose(out.twist_body, [1, 0, 0, *rate], atol=1e-9)
    A = se3.adjoint(MOUNT) @ se3.right_jacobian_inverse(se3.log(T_cam))
    np.testing.assert_allclose(out.twist_covariance, A @ C @ A.T / 0.01, rtol=1e-9)
    np.testing.assert_allclose(out.T_odom_body, T_body, atol=1e-12)


@pytest.mark.parametrize("parts", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.7, 0.5, 0.3)])
def test_accumulated_pose_covariance_against_monte_carlo(parts: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(3)
    n, frames, tau, dt = 4000, 15, 0.5, 0.1
    J, W, B = (s**2 * _spd(rng, 2e-3) for s in parts)
    motions = [se3.exp(np.array([0.02, 0.05, 0.3, 0.02, 0.1, -0.03]) * rng.uniform(0.5, 1.5)) for _ in range(frames)]
    builder = OdometryBuilder(MOUNT, floor=TINY)
    truth = np.eye(4)

    def draw(C: np.ndarray) -> np.ndarray:
        values, vectors = np.linalg.eigh(C)
        return rng.standard_normal((n, 6)) @ (vectors * np.sqrt(np.maximum(values, 0))).T

    # The motion's other half, as if the first frame's pose were off.
    n_ref = draw(J / 2) @ se3.adjoint(motions[0]).T
    b = draw(B)
    estimate = np.tile(np.eye(4), (n, 1, 1))
    for k, T in enumerate(motions, start=1):
        if k > 1:
            phi = np.exp(-dt / tau)
            b = phi * b + np.sqrt(1 - phi**2) * draw(B)
        n_cur = draw(J / 2)
        estimate = estimate @ se3.exp(-n_ref) @ T @ se3.exp(n_cur) @ se3.exp(b + draw(W))
        n_ref, truth = n_cur, truth @ T
        t = round(k * dt * 1e9)
        stated = _prediction(t, J, W + 1e-14 * np.eye(6), B, tau)
        out = builder.step(VoRecord(t, round((k - 1) * dt * 1e9), Status.OK, T), stated)
    body = MOUNT @ estimate @ se3.inverse(MOUNT)
    T_true = MOUNT @ truth @ se3.inverse(MOUNT)
    R = T_true[:3, :3]
    error = se3.log(se3.inverse(T_true) @ body)
    error = np.concatenate([error[:, :3] @ R.T, error[:, 3:] @ R.T], axis=1)
    measured = error.T @ error / n
    np.testing.assert_allclose(np.diagonal(out.pose_covariance), np.diagonal(measured), rtol=0.12)


def test_lost_frames_hold_the_pose_and_widen_it() -> None:
    flight = synthetic_flight(0, duration_s=6, events=Events(dark=(2.0, 4.0)))
    out = list(messages(flight.records, lambda r: flight.predictions.get(r.t_ns), OdometryBuilder(floor=TINY)))
    lost = [o for o in out if o.status is Status.LOST]
    assert len(lost) == 40
    assert all(o.twist_body is None and not o.tracked for o in lost)
    assert np.trace(lost[-1].pose_covariance[:3, :3]) > 100 * np.trace(out[39].pose_covariance[:3, :3])
    after = out[out.index(lost[-1]) + 1]
    # The motion over the dark stretch starts from the last good frame: nothing jumps and nothing is reset.
    assert after.reset_counter == out[1].reset_counter
    assert np.trace(after.pose_covariance[:3, :3]) < np.trace(lost[-1].pose_covariance[:3, :3])


def test_a_lost_frame_before_any_motion_of_which_nothing_is_stated_is_no_exact_one() -> None:
    out = OdometryBuilder(floor=TINY).step(VoRecord(5 * 10**8, 0, Status.LOST, np.eye(4)))
    assert (np.sqrt(np.diagonal(out.pose_covariance)) > np.repeat([0.4, 0.2], 3)).all()


@pytest.mark.parametrize("speed_mps", [0.0, 2.0, 14.0, 30.0])
def test_before_any_motion_a_lost_frame_fits_vehicles_of_any_speed(speed_mps: float) -> None:
    out = OdometryBuilder(floor=TINY).step(VoRecord(10**8, 0, Status.LOST, np.eye(4)))
    moved = se3.exp(np.array([0, 0, 0.1 * speed_mps, 0, 0, 0]))[:3, 3]
    assert moved @ np.linalg.solve(out.pose_covariance[:3, :3], moved) < 9.0


def test_without_a_covariance_a_lost_frame_is_as_unsure_as_the_vehicle_was_fast() -> None:
    C, builder = 1e-8 * np.eye(6), OdometryBuilder(floor=TINY)
    builder.step(
        VoRecord(10**8, 0, Status.OK, se3.exp(np.array([0, 0, 3.0, 0, 0, 0]))), _prediction(10**8, 0 * C, C, C)
    )
    lost = VoRecord(2 * 10**8, 10**8, Status.LOST, np.eye(4), is_reference=False)
    before, now = (builder.step(replace(lost, t_ns=t)) for t in (2 * 10**8, 3 * 10**8))
    of_guess = lost_covariance(0.2, np.array([0, 0, 30.0, 0, 0, 0]))
    assert np.diagonal(now.pose_covariance).max() == pytest.approx(np.diagonal(of_guess).max(), rel=0.01)
    assert np.trace(before.pose_covariance) < 0.3 * np.trace(now.pose_covariance)


@pytest.mark.parametrize("resets, sent", [(254, 255), (255, 0)])
def test_where_a_source_starts_again_the_twist_is_that_of_its_own_motion(resets: int, sent: int) -> None:
    C, step, builder = 1e-6 * np.eye(6), se3.exp(np.array([0, 0, 0.1, 0, 0, 0])), OdometryBuilder(resets=resets)
    first = builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    assert first.tracked
    assert first.twist_body is None
    builder.step(VoRecord(10**8, 0, Status.OK, step), _prediction(10**8, 0 * C, C, 0 * C))
    t = 20 * 10**8  # of a reference that nobody has seen
    out = builder.step(VoRecord(t + 10**8, t, Status.DEGRADED, step), _prediction(t + 10**8, 0 * C, C, 0 * C))
    np.testing.assert_allclose(out.twist_body, [1, 0, 0, 0, 0, 0], atol=1e-9)
    assert (out.reset_counter, out.status) == (sent, Status.DEGRADED)


def test_after_a_break_the_twist_is_that_of_the_motion_alone() -> None:
    C, step = 1e-6 * np.eye(6), se3.exp(np.array([0, 0, 0.1, 0, 0, 0]))
    guess = se3.exp(np.array([0.3, 0, 1.5, 0, 0, 0]))
    builder = OdometryBuilder(floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    builder.step(VoRecord(10**8, 0, Status.OK, step), _prediction(10**8, 0 * C, C, 0 * C))
    # Lost for a second; the new beginning is placed by a guess that is half a metre off.
    t = 11 * 10**8
    wide = replace(_prediction(t, 0 * C, np.eye(6), 0 * C), status=Status.LOST)
    builder.step(VoRecord(t, 10**8, Status.LOST, guess), wide)
    after = builder.step(VoRecord(t + 10**8, t, Status.OK, step), _prediction(t + 10**8, 0 * C, C, 0 * C))
    np.testing.assert_allclose(after.twist_body, [1, 0, 0, 0, 0, 0], atol=1e-9)
    J = se3.right_jacobian_inverse(se3.log(step))
    np.testing.assert_allclose(
        np.diagonal(after.twist_covariance), 1e-4 * np.diagonal(J @ J.T)[[2, 0, 1, 5, 3, 4]], rtol=1e-6
    )
    assert after.pose_covariance[0, 0] > 0.9
    assert after.reset_counter == 1


def test_the_twist_between_two_motions_from_one_reference_is_as_wrong_as_drawn_ones() -> None:
    """The reference's noise is in both and cancels; what remains is that of either end, and of either motion alone."""
    rng, n, dt = np.random.default_rng(6), 20_000, 0.1
    J, W = _spd(rng, 1e-3), _spd(rng, 5e-4)
    motions = [se3.exp(k * np.array([0.3, 0.02, 0.1, 0.05, -0.1, 0.2])) for k in (1, 2)]

    def draw(C: np.ndarray) -> np.ndarray:
        return se3.exp(rng.standard_normal((n, 6)) @ np.linalg.cholesky(C).T)

    start = se3.inverse(draw(0.5 * J))
    one, two = (start @ T @ draw(0.5 * J) @ draw(W) for T in motions)
    drawn = se3.log(se3.inverse(one) @ two) @ se3.adjoint(MOUNT).T / dt
    builder = OdometryBuilder(MOUNT, floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    for k, T in enumerate(motions, 1):
        record = VoRecord(k * 10**8, 0, Status.OK, T, is_reference=False)
        out = builder.step(record, _prediction(k * 10**8, J, W, 0 * W))
    sample, sigma = np.cov(drawn.T), drawn.std(axis=0)
    # An entry of a sample covariance scatters by 1 % of its variances; 5 of that.
    np.testing.assert_allclose(
        out.twist_covariance / np.outer(sigma, sigma), sample / np.outer(sigma, sigma), atol=0.05
    )


def test_a_restart_of_the_source_is_one_reset() -> None:
    C, builder = 1e-6 * np.eye(6), OdometryBuilder(floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    # Nothing is known of what led from the last frame to a reference that follows none.
    unknown = VoRecord(10**9, 9 * 10**8, Status.LOST, np.eye(4), covariances={"triangulation": C})
    assert builder.step(replace(unknown, is_reference=True)).reset_counter == 1


def test_a_record_that_is_sent_twice_or_is_no_number_moves_nothing() -> None:
    flight = synthetic_flight(0, duration_s=2)
    plain = list(messages(flight.records, lambda r: flight.predictions.get(r.t_ns), OdometryBuilder()))
    bad = replace(flight.records[20], T_prev_cur=np.full((4, 4), np.nan), is_reference=False)
    for extra in (flight.records[19:20] * 3, [bad]):
        records = [*flight.records[:20], *extra, *flight.records[20:]]
        out = list(messages(records, lambda r: flight.predictions.get(r.t_ns), OdometryBuilder()))
        assert all(o.twist_body is None for o in out[20 : 20 + len(extra)])
        for o in out:
            np.linalg.cholesky(o.pose_covariance)
        np.testing.assert_array_equal(out[-1].T_odom_body, plain[-1].T_odom_body)
        np.testing.assert_array_equal(out[-1].pose_covariance, plain[-1].pose_covariance)
        assert out[-1].reset_counter == 0


@pytest.mark.parametrize("missed", [1, 4])
def test_records_that_were_missed_are_part_of_what_is_unknown(missed: int) -> None:
    wide = []
    for seed in range(4):
        flight = synthetic_flight(seed, duration_s=2)
        plain = list(messages(flight.records, lambda r, of=flight: of.predictions.get(r.t_ns), OdometryBuilder()))
        few = [*flight.records[:20], *flight.records[20 + missed :]]
        out = list(messages(few, lambda r, of=flight: of.predictions.get(r.t_ns), OdometryBuilder()))
        assert (plain[-1].reset_counter, out[-1].reset_counter) == (0, 1)
        off = se3.log(se3.inverse(plain[-1].T_odom_body) @ out[-1].T_odom_body)
        wide.append(np.abs(off[:3]).max() / np.sqrt(np.diagonal(out[-1].pose_covariance)[:3].max()))
    assert 0.2 < max(wide) < 2.0


def test_the_twist_of_a_large_turn_is_as_wrong_as_it_says() -> None:
    rng, T = np.random.default_rng(5), se3.exp(np.array([0.5, 0.1, 1.0, 0.3, 0.8, -0.2]))
    C, squares = np.diag([1e-4, 1e-4, 25e-4, 1e-6, 25e-6, 1e-6]), []
    for _ in range(400):
        record = VoRecord(10**9, 0, Status.OK, T @ se3.exp(np.linalg.cholesky(C) @ rng.standard_normal(6)))
        out = OdometryBuilder(MOUNT, floor=TINY).step(record, _prediction(10**9, 0 * C, C, 0 * C))
        error = out.twist_body - se3.adjoint(MOUNT) @ se3.log(T)
        squares.append(error @ np.linalg.solve(out.twist_covariance, error) / 6)
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 6 / 400))


def test_a_slip_that_only_the_model_sees_is_a_lost_frame() -> None:
    C, step = 1e-6 * np.eye(6), se3.exp(np.array([0, 0, 0.1, 0, 0, 0]))
    builder = OdometryBuilder(floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    slip = replace(_prediction(10**8, 0 * C, np.eye(6), 0 * C), status=Status.LOST)
    out = builder.step(VoRecord(10**8, 0, Status.OK, se3.exp(np.array([0, 0, 2.0, 0, 0, 0]))), slip)
    assert out.status is Status.LOST
    assert not out.tracked
    assert out.twist_body is None
    after = builder.step(VoRecord(2 * 10**8, 10**8, Status.OK, step), _prediction(2 * 10**8, 0 * C, C, 0 * C))
    np.testing.assert_allclose(after.twist_body, [1, 0, 0, 0, 0, 0], atol=1e-9)
    assert after.reset_counter == out.reset_counter == 1


def test_a_vehicle_at_rest_against_one_reference_does_not_drift() -> None:
    C = 1e-6 * np.eye(6)
    builder = OdometryBuilder(floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    first = last = None
    for k in range(1, 200):
        T = se3.exp(1e-4 * np.random.default_rng(k).standard_normal(6))
        record = VoRecord(k * 10**8, 0, Status.OK, T, is_reference=False)
        last = builder.step(record, _prediction(record.t_ns, 0 * C, C, 0 * C))
        first = first or last
    assert last is not None
    np.testing.assert_allclose(last.pose_covariance, first.pose_covariance, rtol=1e-2, atol=1e-12)
    assert np.abs(last.twist_body).max() < 1e-2
    # Twice the noise over the frame's own interval, not over the time since the reference.
    assert 0.5 * 2e-6 / 0.01 < last.twist_covariance[0, 0] < 1.5 * 2e-6 / 0.01


def test_a_mean_is_part_of_the_error_and_moves_nothing() -> None:
    C, mean = 1e-6 * np.eye(6), np.array([0, 0, 0.01, 0, 0, 0])
    record = VoRecord(10**8, 0, Status.OK, se3.exp(np.array([0, 0, 0.1, 0, 0, 0])))
    said = _prediction(record.t_ns, 0 * C, C, 0 * C)
    plain, leaning = (OdometryBuilder(floor=TINY).step(record, p) for p in (said, replace(said, mean=mean)))
    np.testing.assert_array_equal(leaning.twist_body, plain.twist_body)
    assert plain.twist_covariance is not None
    assert leaning.twist_covariance is not None
    added = leaning.twist_covariance - plain.twist_covariance
    assert added[0, 0] == pytest.approx((0.01 / 0.1) ** 2)


def test_a_mean_adds_up_along_the_path() -> None:
    """The error of the pose over that of one motion is the mean's number of motions, as the mean is the same in all."""
    zero, step, mean = np.zeros((6, 6)), se3.exp(np.array([0, 0, 0.1, 0, 0.02, 0])), np.array([0, 0, 1e-3, 0, 2e-5, 0])
    C, builder, estimate = 1e-12 * np.eye(6), OdometryBuilder(np.eye(4), floor=TINY), np.eye(4)
    for k in range(1, 101):
        estimate = estimate @ step @ se3.exp(mean)
        stated = replace(_prediction(k * 10**8, zero, C, zero), mean=mean)
        out = builder.step(VoRecord(k * 10**8, (k - 1) * 10**8, Status.OK, step), stated)
    error = se3.log(se3.inverse(out.T_odom_body) @ estimate)
    R = np.kron(np.eye(2), out.T_odom_body[:3, :3])
    np.testing.assert_allclose(out.pose_covariance, np.outer(R @ error, R @ error), atol=2e-5)
    assert np.abs(R @ error)[:3].max() > 0.05
    np.testing.assert_allclose(np.diagonal(out.twist_covariance), (mean / 0.1) ** 2, atol=1e-6)


def test_at_rest_against_one_reference_a_mean_cancels() -> None:
    zero, C, mean = np.zeros((6, 6)), 1e-6 * np.eye(6), np.array([0.01, 0, 0, 0, 0, 0])
    builder = OdometryBuilder(np.eye(4), floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    for k in range(1, 4):
        stated = replace(_prediction(k * 10**8, zero, C, zero), mean=mean)
        out = builder.step(VoRecord(k * 10**8, 0, Status.OK, np.eye(4), is_reference=False), stated)
    assert out.twist_covariance is not None
    np.testing.assert_allclose(np.diagonal(out.twist_covariance), 2e-6 / 0.01, rtol=1e-6)


@pytest.mark.parametrize("tau_s", [np.inf, 2.0])
def test_what_persists_makes_twists_from_one_reference_as_wrong_as_from_frame_to_frame(tau_s: float) -> None:
    """A scale that is wrong by 3 % makes every twist wrong by 3 %; one that wanders differs more between far frames."""
    C, zero, dt_s, scale, step = 1e-12 * np.eye(6), np.zeros((6, 6)), 0.1, 0.03, np.array([0, 0, 0.1, 0, 0, 0])
    builder = OdometryBuilder(np.eye(4), floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    for k in range(1, 9):
        root = np.zeros((6, 6))
        root[:, 0] = scale * k * step
        stated = prediction(k * 10**8, zero, C, zero, 1.0, root, tau_s, dt_s=k * dt_s)
        out = builder.step(VoRecord(k * 10**8, 0, Status.OK, se3.exp(k * step), is_reference=False), stated)
        kept = np.exp(-dt_s / tau_s)
        # s_k k - s_(k-1) (k - 1), with s first-order Gauss-Markov
        expected = (scale * step[2] / dt_s) ** 2 * (k**2 + (k - 1) ** 2 - 2 * kept * k * (k - 1))
        assert out.twist_covariance is not None
        assert out.twist_covariance[2, 2] == pytest.approx(expected, rel=1e-6)


def test_motions_from_one_reference_may_be_stated_with_and_without_what_persists() -> None:
    C, zero, root = 1e-6 * np.eye(6), np.zeros((6, 6)), 1e-3 * np.eye(6)
    builder = OdometryBuilder(np.eye(4), method="triangulation", floor=TINY)
    builder.step(VoRecord(0, 0, Status.START, np.eye(4)))
    record = VoRecord(10**8, 0, Status.OK, np.eye(4), is_reference=False, covariances={"triangulation": C})
    builder.step(record)
    out = builder.step(replace(record, t_ns=2 * 10**8), prediction(2 * 10**8, zero, C, zero, 1.0, root))
    np.testing.assert_allclose(out.twist_covariance, (2e-6 + 1e-6) / 0.01 * np.eye(6), rtol=1e-6)


def test_floors_lift_variances_and_keep_it_positive_definite() -> None:
    C = _spd(np.random.default_rng(1), 1e-6)
    out = lift(C, np.repeat([1e-6, 1e-4], 3))
    assert (np.diagonal(out) >= [1e-6] * 3 + [1e-4] * 3).all()
    np.linalg.cholesky(out)
    np.testing.assert_allclose(lift(np.eye(6), 1e-6), np.eye(6))
    np.testing.assert_array_equal(lift(np.zeros((6, 6)), 1e-9), 1e-9 * np.eye(6))


def test_floors_hide_no_prediction_of_a_slow_or_tiny_rig() -> None:
    """A frame a second turns by 6e-5 rad/s of error, a baseline of a millimetre errs by micrometres."""
    C, record = np.diag([6e-5**2] * 6), VoRecord(10**9, 0, Status.OK, np.eye(4))
    plain, floored = (
        OdometryBuilder(floor=f).step(record, _prediction(10**9, 0 * C, C, 0 * C)) for f in (TINY, LEAST_VARIANCE)
    )
    np.testing.assert_allclose(floored.twist_covariance, plain.twist_covariance)
    np.testing.assert_allclose(floored.pose_covariance, plain.pose_covariance)


def test_no_covariance_is_one_clear_line() -> None:
    with pytest.raises(GpvoError, match="neither a prediction nor a covariance of its motion 'triangulation'"):
        OdometryBuilder(method="triangulation").step(VoRecord(10**8, 0, Status.OK, np.eye(4)))
    bad = _prediction(10**8, np.eye(6), -3.0 * np.eye(6), np.eye(6))
    with pytest.raises(GpvoError, match="not symmetric positive definite"):
        OdometryBuilder().step(VoRecord(10**8, 0, Status.OK, np.eye(4)), bad)


def test_the_covariance_of_a_pose_is_not_published_as_that_of_a_motion() -> None:
    record = VoRecord(10**8, 0, Status.OK, np.eye(4), covariances={IMPORTED_POSE: np.eye(6), "spherical": np.eye(6)})
    with pytest.raises(GpvoError, match=r"'imported_pose' \(give --model or --method spherical\)"):
        OdometryBuilder(method=IMPORTED_POSE).step(record)


def test_every_covariance_of_a_bursty_flight_is_positive_definite() -> None:
    flight = synthetic_flight(1, duration_s=10, law=ErrorLaw(burst_factor=10.0))
    for out in messages(flight.records, lambda r: flight.predictions.get(r.t_ns), OdometryBuilder(MOUNT)):
        np.linalg.cholesky(out.pose_covariance)
        if out.twist_covariance is not None:
            np.linalg.cholesky(out.twist_covariance)


def test_the_pose_of_a_wrong_calibration_is_right_again_at_home() -> None:
    rng = np.random.default_rng(4)
    L, C, zero = rng.standard_normal((6, 6)) * 1e-2, _spd(rng, 1e-3), np.zeros((6, 6))
    builder = OdometryBuilder(np.eye(4), floor=TINY)
    for k in range(1, 9):
        stated = prediction(k * 10**8, zero, C, zero, 5.0, L if k % 2 else -L, np.inf)
        out = builder.step(VoRecord(k * 10**8, (k - 1) * 10**8, Status.OK, np.eye(4)), stated)
    np.testing.assert_allclose(out.pose_covariance, 8 * C, atol=1e-9)
    np.testing.assert_allclose(out.twist_covariance, (C + L @ L.T) / 0.01, atol=1e-9)

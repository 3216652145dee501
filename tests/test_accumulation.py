"""Accumulated covariance against drawn trajectories with jitter, white noise and bias."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from evaluation_runs import curved_path, stated_covariance
from gpvo.accumulation import (
    PoseError,
    along,
    between_ends,
    carry,
    first_jitter,
    from_end,
    from_start,
    independent_part,
    over_windows,
    with_shared,
)
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite, scaled_root
from gpvo.types import Array, MotionError, Status

from motion_errors import motion_error

N, DRAWS, DT_S, TAU_S = 60, 3000, 0.05, 0.8
C = stated_covariance()
PATH = curved_path(N, step_m=0.1)
CHAIN = np.arange(N) - 1


def _errors(jitter: float, white: float, bias: float, growth: float = 0.0) -> list[MotionError]:
    """Shares of the covariance, which grows linearly along the path by ``growth`` in all."""
    sizes = 1 + growth * np.arange(N) / N
    return [motion_error(s * jitter * C, s * white * C, s * bias * C, TAU_S, dt_s=DT_S) for s in sizes]


def _drawn(path: np.ndarray, errors: list[MotionError], seed: int = 0) -> np.ndarray:
    """(DRAWS, 6) errors of the last pose. The first step is the origin and has no motion."""
    rng = np.random.default_rng(seed)

    def draw(S: np.ndarray) -> np.ndarray:
        return rng.standard_normal((DRAWS, 6)) @ scaled_root(S).T

    phi = np.exp(-DT_S / TAU_S)
    unit = rng.standard_normal((DRAWS, 12))
    # A frame's jitter is as if its own pose were off, so it is carried over the motion that it begins.
    last = draw(0.5 * errors[1].jitter) @ se3.adjoint(path[1]).T
    T_true, T_est = np.eye(4), np.broadcast_to(np.eye(4), (DRAWS, 4, 4))
    for T, error in zip(path[1:], errors[1:]):
        unit = phi * unit + np.sqrt(1 - phi**2) * rng.standard_normal((DRAWS, 12))
        now = draw(0.5 * error.jitter)
        T_true = T_true @ T
        T_est = T_est @ se3.exp(-last) @ T @ se3.exp(draw(error.white) + unit @ error.persistent_root.T + now)
        last = now
    return se3.log(se3.inverse(T_true) @ T_est)


@pytest.mark.parametrize(
    "parts",
    [(0, 1, 0), (1, 0, 0), (0, 0, 1), (0.5, 0.3, 0.2), (0.3, 0.1, 0.6, 3.0)],
    ids=str,
)
def test_final_covariance_is_that_of_drawn_trajectories(parts):
    """3,000 draws: a variance scatters by 2.6 %; within 10 % on every axis, correlations within 0.1."""
    errors = _errors(*parts)
    predicted, drawn = along(PATH, errors, CHAIN)[1][-1], _drawn(PATH, errors)
    sample = np.cov(drawn.T)
    np.testing.assert_allclose(np.diagonal(predicted) / np.diagonal(sample), 1.0, atol=0.1)
    sigma = np.sqrt(np.diagonal(predicted))
    np.testing.assert_allclose(sample / np.outer(sigma, sigma), predicted / np.outer(sigma, sigma), atol=0.1)


@pytest.mark.parametrize("parts", [(1, 0, 0), (0.5, 0.3, 0.2)], ids=str)
def test_long_steps_turn_jitter_into_position_only_as_far_as_it_does(parts):
    """Two metres a frame: the lever makes a frame's jitter of rotation as large as that of translation."""
    path, errors = curved_path(N, step_m=2.0), _errors(*parts)
    predicted, sample = along(path, errors, CHAIN)[1][-1], np.cov(_drawn(path, errors).T)
    np.testing.assert_allclose(np.diagonal(predicted) / np.diagonal(sample), 1.0, atol=0.1)


def test_jitter_alone_stays_bounded_on_a_straight_path():
    P = along(np.tile(np.eye(4), (200, 1, 1)), [motion_error(C, 0 * C, 0 * C)] * 200, np.arange(200) - 1)[1]
    # Jitter of the first and the last frame, half of it each, however far.
    np.testing.assert_allclose(P[1:], np.broadcast_to(C, (199, 6, 6)), rtol=1e-9, atol=1e-18)


def test_white_noise_grows_with_frames_and_lasting_bias_with_their_square():
    still = np.tile(np.eye(4), (101, 1, 1))
    white, bias = motion_error(0 * C, C, 0 * C), motion_error(0 * C, 0 * C, C, 1e9)
    np.testing.assert_allclose(along(still, [white] * 101, np.arange(101) - 1)[1][-1], 100 * C, rtol=1e-9)
    P = along(still, [bias] * 101, np.arange(101) - 1)[1][-1]
    np.testing.assert_allclose(P, 1e4 * C, rtol=1e-6, atol=1e-15)


def test_covariance_of_one_motion_is_the_sum_of_its_parts():
    P = PoseError().after(PATH[1], _errors(0.5, 0.3, 0.2)[1]).covariance
    np.testing.assert_allclose(P, C, atol=1e-18)


@pytest.mark.parametrize("status", [Status.OK, Status.LOST])
def test_what_a_motion_shares_with_others_and_what_not_is_all_of_its_noise(status):
    """A lost one was extrapolated: it has seen no frame whose noise another could share."""
    error, T = replace(_errors(0.5, 0.3, 0.2)[1], status=status), PATH[1]
    start, lost = from_start(error, carry(T)), status is Status.LOST
    ends = np.zeros((6, 6)) + from_end(error)
    assert (not np.any(start), not ends.any()) == (lost, lost)
    before = start * np.eye(6) if lost else start
    shared = before @ first_jitter(T, error.jitter) @ np.transpose(before) + ends
    np.testing.assert_allclose(shared + independent_part(error), error.jitter + error.white, rtol=1e-9, atol=1e-18)


def test_between_two_ends_remains_the_difference_of_what_persists():
    """Of ``now u - Ad^-1 before u'``, u and u' correlated by ``exp(-dt / tau)``, whatever the two roots."""
    rng, T, none = np.random.default_rng(4), se3.exp(np.array([0.3, -0.1, 0.8, 0.2, -0.4, 0.3])), np.zeros((6, 6))
    before, now = rng.standard_normal((2, 6, 12))
    tau_s, A = rng.uniform(0.1, 2.0, 12), carry(T)
    last, error = (
        MotionError(mean=np.zeros(6), jitter=none, white=none, persistent_root=root, persistent_tau_s=tau_s, dt_s=DT_S)
        for root in (before, now)
    )
    across = now @ np.diag(np.exp(-0.4 / tau_s)) @ before.T @ A.T
    expected = now @ now.T + A @ before @ before.T @ A.T - across - across.T
    np.testing.assert_allclose(between_ends(T, last, error, 0.4), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("parts", [(0, 1, 0), (0.5, 0.3, 0.2)])
def test_a_frame_that_is_skipped_leaves_no_trace(parts):
    """Frame 3 is lost and frame 4 starts from frame 2: as if frame 3 had never been."""
    errors = _errors(*parts)[:8]
    parent = np.array([-1, 0, 1, 2, 2, 4, 5, 6])
    kept = [0, 1, 2, 4, 5, 6, 7]
    _, branched = along(PATH[:8], errors, parent)
    _, straight = along(PATH[kept], [errors[k] for k in kept], np.arange(7) - 1)
    np.testing.assert_allclose(branched[kept], straight, atol=1e-18)


def test_hours_at_rest_keep_one_state():
    """While a vehicle stands, all motions start from one frame: their ends are not kept, and not searched each time."""
    n, error = 2000, motion_error(0.5 * C, 0.5 * C, 0 * C)
    tracemalloc.start()
    _, P = along(np.tile(np.eye(4), (n, 1, 1)), [error] * n, [-1] + [0] * (n - 1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(P[1:], np.broadcast_to(P[1], (n - 1, 6, 6)))
    assert peak < 2 * n * (6 + 36 + 16) * 8


def test_an_error_without_persistent_part_lets_time_pass():
    """A bias over a motion that was not measured goes on changing, however that motion is stated."""
    bias, zero = motion_error(0 * C, 0 * C, C, TAU_S, dt_s=DT_S), motion_error(0 * C, C, 0 * C, TAU_S, dt_s=3 * DT_S)
    alone = MotionError.independent(C, dt_s=3 * DT_S)
    ends = [PoseError().after(np.eye(4), bias).after(np.eye(4), e).after(np.eye(4), bias) for e in (zero, alone)]
    expected = C * (3 + 2 * np.exp(-4 * DT_S / TAU_S))
    for end in ends:
        np.testing.assert_allclose(end.covariance, expected, rtol=1e-9)


@pytest.mark.parametrize("without", [set(), {0, 1, 5, 17}, set(range(N))], ids=["all", "some", "none"])
def test_many_windows_together_add_up_as_each_of_them(without):
    """Of unequal length, overlapping, with motions of other durations, and some without a persistent part."""
    errors = [replace(e, dt_s=DT_S * (1 + k % 3)) for k, e in enumerate(_errors(0.5, 0.3, 0.2, 2.0))]
    errors = [MotionError.independent(e.covariance, dt_s=e.dt_s) if k in without else e for k, e in enumerate(errors)]
    windows = [[5], range(3, 20), [0, 1, 3, 6], range(N), range(10, 12), range(3, 20)]
    for window, together in zip(windows, over_windows(PATH, errors, windows), strict=True):
        pose = PoseError()
        for k in window:
            pose = pose.after(PATH[k], errors[k])
        np.testing.assert_allclose(together, pose.covariance, rtol=1e-10, atol=1e-18)


@pytest.mark.parametrize("frames", [1, 2, 7, 8])
def test_what_calibration_adds_on_the_way_out_it_takes_back_on_the_way_home(frames):
    """There and back, always turned by the same: of a lasting error nothing is left after an even number of motions."""
    rng = np.random.default_rng(0)
    L, white, zero = rng.standard_normal((6, 6)), 0.1 * np.eye(6), np.zeros((6, 6))
    pose = PoseError()
    for k in range(frames):
        pose = pose.after(np.eye(4), motion_error(zero, white, zero, 1.0, L if k % 2 == 0 else -L, np.inf))
    np.testing.assert_allclose(pose.covariance, frames * white + frames % 2 * L @ L.T, atol=1e-9)


def _covariance(rng: np.random.Generator) -> Array:
    root = rng.normal(size=(6, 8)) * np.repeat([0.02, 0.004], 3)[:, None]
    return root @ root.T


@pytest.mark.parametrize("seed", range(5))
def test_what_motions_share_is_part_of_each_and_adds_up_and_is_taken_back_on_the_way_home(seed):
    rng = np.random.default_rng(seed)
    shared, own = _covariance(rng), 1e-8 * np.eye(6)
    shared[3:, 3:] = shared[3:, :3] @ np.linalg.solve(shared[:3, :3], shared[:3, 3:])  # a turn that goes with the way
    T = np.eye(4)
    T[:3, 3] = rng.normal(size=3)
    out, home = (with_shared(shared + own, shared, X) for X in (T, se3.inverse(T)))
    np.testing.assert_allclose(out.covariance, shared + own, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(out.white, own, atol=1e-12)
    np.testing.assert_allclose(out.persistent_root, -home.persistent_root, atol=1e-12)
    moved = carry(T)
    two = PoseError().after(T, out).after(T, out).covariance
    np.testing.assert_allclose(two, (moved + np.eye(6)) @ shared @ (moved + np.eye(6)).T, atol=1e-6)


def test_what_is_shared_by_a_camera_at_rest_has_no_direction():
    C = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
    error = with_shared(C, 0.5 * C, np.eye(4))
    assert not error.persistent.any()
    np.testing.assert_array_equal(error.covariance, C)


def test_white_stays_a_covariance_where_the_shared_part_is_as_good_as_flat():
    """Correlations to rounding pass as semidefinite; dividing by what they leave would not."""
    shared = np.zeros((6, 6))
    shared[:3, :3] = 1e-4 + np.diag([0.0, 1e-18, 0.0])
    shared[3, 3], shared[1, 3] = 1e-6, 3e-5 * np.sqrt(1e-4 * 1e-6)
    shared[3, 1] = shared[1, 3]
    C = shared + np.diag(np.repeat([1e-7, 1e-9], 3))
    T = np.eye(4)
    T[:3, 3] = 0.1, 0.2, 0.3
    error = with_shared(C, shared, T)
    np.testing.assert_allclose(error.covariance, C, rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(error.white)[0] > 0.0


@pytest.mark.parametrize("first", [9, 12])
def test_statements_of_two_models_add_up_in_either_order(first):
    """A prediction has another persistent vector than a geometric covariance, which stands in where it lacks."""
    C, rng = _covariance(np.random.default_rng(1)), np.random.default_rng(2)
    motions = [
        replace(
            MotionError.independent(C, dt_s=DT_S),
            persistent_root=1e-3 * rng.normal(size=(6, P)),
            persistent_tau_s=np.full(P, np.inf),
        )
        for P in (first, 21 - first)
    ]
    poses = [pose := PoseError()]
    for error in (*motions, *motions):
        poses.append(pose := pose.after(np.eye(4), error))
    grown = [np.linalg.eigvalsh(b.covariance - a.covariance)[0] for a, b in pairwise(poses)]
    assert min(grown) > 0.0
    assert is_positive_definite(between_ends(np.eye(4), *motions, DT_S))

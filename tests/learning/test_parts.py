"""How errors add up: which motions lead on, and what few sequences can say of long spans."""

from __future__ import annotations

import numpy as np
from gpvo.accumulation import PoseError
from gpvo.learning.parts import Parts, curves, fit_parts, part_correlations
from gpvo.learning.spans import SpanVariances, chains, span_variances
from gpvo.stats.consistency import nees
from scipy.signal import lfilter

from motion_errors import motion_error


def _times(parents: list[int], step_ns: int = 50_000_000) -> tuple[np.ndarray, np.ndarray]:
    """Of motions that end at frames 1, 2, ... and start at ``parents``."""
    ends = np.arange(1, len(parents) + 1)
    return ends * step_ns, (ends - np.array(parents)) * step_ns * 1e-9


def test_motions_from_one_reference_count_once():
    # Frames 2, 3 and 4 were all measured from frame 1; the path goes 0, 1, 4, 5.
    assert [c.tolist() for c in chains(*_times([0, 1, 1, 1, 4]))] == [[0, 3, 4]]


def test_a_chain_breaks_where_a_motion_is_missing():
    t_ns, dt_s = _times([0, 1, 2, 3, 4, 5])
    keep = np.array([True, True, False, True, True, True])
    assert [c.tolist() for c in chains(t_ns[keep], dt_s[keep])] == [[0, 1], [2, 3, 4]]
    assert chains(t_ns[:0], dt_s[:0]) == []


def _like(z: list, value: float, axes: int | None = None) -> list:
    return [[np.full((len(c), axes or c.shape[1]), value) for c in cs] for cs in z]


def _same_speed(z: list) -> list:
    return _like(z, 0.0, 1)


def test_a_held_reference_does_not_hide_long_spans():
    """A bias that lasts the whole flight is seen although the reference is held every few frames."""
    rng = np.random.default_rng(0)
    parents = [k - 1 if k % 5 else k - 2 for k in range(1, 1501)]
    z = []
    for _ in range(8):
        rows = chains(*_times(parents))
        noise = 0.8 * rng.standard_normal((1500, 3)) + 0.6 * rng.standard_normal(3)
        z.append([noise[c] for c in rows])
    assert span_variances(z).spans.max() >= 1000
    parts = fit_parts(z, _like(z, 1.0), _same_speed(z), 0.05)
    assert parts.tau_s.min() > 20.0
    fitted = curves(np.array([1000]), parts.tau_s[0] / 0.05) @ parts.share
    np.testing.assert_allclose(fitted, 0.64 * 1e3 + 0.36 * 1e6, rtol=0.75)


def _noisy_stretches(rng: np.random.Generator, growth: float) -> tuple[list, list]:
    """Flights whose noise is nine times as large in a fifth of the time; white, and a bias of a growing share."""
    error, sigma = [], []
    for _ in range(12):
        ln_var = np.where(np.arange(2000) // 100 % 5 == 0, 4.4, 0.0)[:, None] * np.ones(3)
        white, bias = np.exp(0.5 * ln_var), 0.05 * np.exp(0.5 * (1 + growth) * ln_var)
        slow = np.zeros((2000, 3))
        for k in range(1, 2000):
            slow[k] = np.exp(-1 / 40) * slow[k - 1] + np.sqrt(1 - np.exp(-1 / 20)) * rng.standard_normal(3)
        error.append([white * rng.standard_normal((2000, 3)) + bias * slow])
        sigma.append([np.sqrt(white**2 + bias**2)])
    return error, sigma


def test_a_bias_that_grows_faster_than_the_noise_is_told_from_one_that_does_not():
    for growth in (0.0, 1.0):
        error, sigma = _noisy_stretches(np.random.default_rng(2), growth)
        parts = fit_parts(error, sigma, _same_speed(error), 0.05)
        assert parts.growth.tolist() == [[0.0] * 3, [growth] * 3]
        assert (np.abs(np.log(parts.ratio[parts.spans <= 100])) < 0.35).all()


def test_what_adds_up_by_the_metre_is_told_from_what_adds_up_by_the_second():
    """Jitter at any speed; white of a variance that goes with the speed, or not."""
    rng = np.random.default_rng(4)
    for growth in (0.0, 1.0):
        error, sigma, faster = [], [], []
        for _ in range(12):
            ln_u = np.repeat(rng.uniform(-1.2, 1.2, (20, 1)), 100, axis=0)
            n = rng.standard_normal((2001, 3))
            white = 0.3 * np.exp(growth * ln_u)
            error.append([np.diff(n, axis=0) * np.sqrt(0.5) + np.sqrt(white) * rng.standard_normal((2000, 3))])
            sigma.append([np.sqrt(1.0 + white) * np.ones(3)])
            faster.append([ln_u])
        parts = fit_parts(error, sigma, faster, 0.05)
        assert parts.growth[0].tolist() == [growth] * 3
        np.testing.assert_allclose(parts.share[1], 0.3 / 1.3, atol=0.06)


def test_each_part_has_its_own_correlation():
    """A bias that ties two axes together which single motions show as independent."""
    rng = np.random.default_rng(3)
    z = []
    for _ in range(10):
        bias = np.repeat(rng.standard_normal((20, 1)), 100, axis=0) * np.array([0.2, 0.2, 0, 0, 0, 0])
        z.append([bias + rng.standard_normal((2000, 6))])
    parts = fit_parts(z, _like(z, 1.0), _same_speed(z), 0.05)
    R = part_correlations(z, _like(z, 1.0), parts)[0]
    assert R[2, 0, 1] > 0.6
    assert np.abs(R[:2, 0, 1]).max() < 0.15
    assert np.linalg.eigvalsh(R).min() > 0.0


def _of_sums(parts: Parts, R: np.ndarray, m: int, step_s: float) -> np.ndarray:
    """(6, 6) covariance stated of the sum over m motions of unit variance."""
    each = np.array([curves(np.array([m]), tau / step_s)[0] for tau in parts.tau_s]) * parts.share.T
    return np.einsum("ip,pij,jp->ij", np.sqrt(each), R, np.sqrt(each))


def test_of_errors_that_outlast_a_flight_few_flights_show_little():
    """Ten trials of eight flights, each with a bias of its own in all six axes. Mean NEES of the sums over 100 motions
    of 200 others: by the true covariance 1, by the covariance of eight draws 8 / (8 - 6 - 1) = 8."""
    rng, mean = np.random.default_rng(10), []
    for _ in range(10):
        z = [[0.8 * rng.standard_normal((1000, 6)) + 0.6 * rng.standard_normal(6)] for _ in range(8)]
        parts = fit_parts(z, _like(z, 1.0), _same_speed(z), 0.05)
        C = _of_sums(parts, part_correlations(z, _like(z, 1.0), parts)[0], 100, 0.05)
        unseen = 8.0 * rng.standard_normal((200, 6)) + 60.0 * rng.standard_normal((200, 6))
        mean.append(nees(unseen, C).mean() / 6.0)
    assert 0.8 <= np.mean(mean) <= 1.4, np.mean(mean)


def test_axes_that_go_together_nearly_perfectly_are_stated_so():
    """Ten thousand motions whose sixth axis is the first up to a hundredth: NEES of as many others."""
    rng = np.random.default_rng(11)
    L = np.eye(6)
    L[5, 0], L[5, 5] = 1.0, 1e-2
    seen, unseen = rng.standard_normal((2, 10, 1000, 6)) @ L.T
    z = [[chain] for chain in seen]
    parts = fit_parts(z, _like(z, 1.0), _same_speed(z), 0.05)
    R = part_correlations(z, _like(z, 1.0), parts)[0]
    for m in (1, 10, 100):
        mean = nees(unseen.reshape(-1, m, 6).sum(axis=1), _of_sums(parts, R, m, 0.05)).mean() / 6.0
        assert 0.92 <= mean <= 1.1, (m, mean)


def test_what_is_known_to_add_up_besides_is_no_share():
    """Errors of a constant that turns around with the motion: taken for known, white is all that is left."""
    rng = np.random.default_rng(6)
    error, root = [], []
    for _ in range(20):
        turns = 0.4 * np.repeat(rng.choice([-1.0, 1.0], (20, 3)), 100, axis=0)
        error.append([rng.standard_normal((2000, 3)) + turns * rng.choice([-1.0, 1.0], 3)])
        root.append([turns[:, :, None] * np.eye(3)])
    one = _like(error, 1.0)
    found = fit_parts(error, one, _same_speed(error), 0.05, root)
    taken_for_bias = fit_parts(error, one, _same_speed(error), 0.05)
    assert (found.share[2] < 0.02).all()
    assert (taken_for_bias.share[2] > 0.08).all()
    assert (np.abs(np.log(found.ratio)) < 0.6).all()


def test_what_is_stated_of_a_new_flight_is_right_on_average():
    """Biases of few flights: squared sum over stated variance has mean one for a flight not seen."""
    rng = np.random.default_rng(1)
    ratio = []
    for _ in range(150):
        bias = rng.standard_normal((9, 3))
        z = [[np.tile(b, (400, 1)) + rng.standard_normal((400, 3))] for b in bias]
        found = span_variances(z[:8])
        stated = (found.mean_square * (1.0 + found.doubt))[found.spans == 200][0]
        ratio.append((z[8][0][:200].sum(axis=0) ** 2 / stated).mean())
    assert 0.8 < np.mean(ratio) < 1.25


def test_what_is_stated_along_a_path_is_what_was_fitted():
    """Two axes of unlike units that nearly cancel, biases of unlike persistence: each sum has the fitted variance."""
    rng = np.random.default_rng(3)
    sigma, z = np.repeat([0.01, 0.001], 3), []
    for _ in range(10):
        rho = np.exp(-1.0 / np.repeat([8.0, 100.0], 3))
        steps = rng.standard_normal((4000, 6))
        steps[:, 4] = 0.1 * steps[:, 4] - 0.99 * steps[:, 0]
        bias = np.array([lfilter([np.sqrt(1.0 - r**2)], [1.0, -r], column) for r, column in zip(rho, steps.T)]).T
        z.append([0.5 * bias + rng.standard_normal((4000, 6))])
    parts = fit_parts(z, _like(z, 1.0), _same_speed(z), 0.05)
    R = part_correlations(z, _like(z, 1.0), parts)[0]
    of_parts = np.sqrt(parts.share) * sigma
    jitter, white, bias = R[:3] * of_parts[:, :, None] * of_parts[:, None, :]
    error = PoseError()
    for _ in range(200):
        error = error.after(np.eye(4), motion_error(jitter, white, bias, parts.tau_s))
    fitted = [curves(np.array([200]), tau / 0.05)[0] @ s for tau, s in zip(parts.tau_s, parts.share.T)]
    np.testing.assert_allclose(np.diagonal(error.covariance), sigma**2 * fitted, rtol=1e-6)


def test_the_worst_motions_decide_how_the_axes_of_a_sum_go_together():
    """One motion in five is five times as uncertain, and only there two axes go together."""
    rng = np.random.default_rng(5)
    error, sigma = [], []
    for _ in range(10):
        e, s = rng.standard_normal((2000, 6)), np.ones((2000, 6))
        e[::5, 1] = 0.9 * e[::5, 0] + np.sqrt(1.0 - 0.9**2) * e[::5, 1]
        s[::5] = 5.0
        error.append([e * s])
        sigma.append([s])
    parts = fit_parts(error, sigma, _same_speed(error), 0.05)
    white = part_correlations(error, sigma, parts)[0, 1]
    np.testing.assert_allclose(white[0, 1], 0.9 * 25.0 / (25.0 + 4.0), atol=0.1)


def test_sums_over_more_than_two_time_constants_share_the_doubt_of_shorter_ones():
    spans = np.array([1, 10, 100, 1000])
    doubt = np.array([0.01, 0.1, 0.3, 1.0])[:, None] * np.ones(3)
    found = SpanVariances(spans, np.ones((4, 3)), doubt)
    np.testing.assert_array_equal(found.widening(64.0)[:, 0], [1.01, 1.1, 1.3, 1.3])
    np.testing.assert_array_equal(found.widening(1024.0)[:, 0], [1.01, 1.1, 1.3, 2.0])
    np.testing.assert_array_equal(found.widening(0.1)[:, 0], np.full(4, 1.01))


def test_motions_that_are_all_but_exact_beside_others_leave_correlations_finite():
    """As of a simulator, or of an IMU between corrections; sums of variances lost the digits of the least, and training
    ended in a traceback."""
    rng = np.random.default_rng(0)
    exact = np.tile(np.arange(1000) % 10 > 0, (2, 1)) & (np.arange(1000) < 800)
    sigma = [[np.where(of[:, None], 1e-11, 3e-3) * np.ones(6)] for of in exact]
    error = [[s[0] * rng.standard_normal((1000, 6))] for s in sigma]
    parts = fit_parts(error, sigma, _same_speed(error), 0.02)
    assert np.isfinite(part_correlations(error, sigma, parts)).all()

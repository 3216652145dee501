"""How errors add up: which motions lead on, and what few sequences can say of long spans."""

from __future__ import annotations

import numpy as np
from gpvo.learning.parts import chains, fit_parts, span_variances


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
    parts = fit_parts(z, 0.05)
    assert parts.tau_s.min() > 20.0
    np.testing.assert_allclose(parts.fitted[parts.spans == 1000], 0.64 * 1e3 + 0.36 * 1e6, rtol=0.75)


def test_what_is_stated_of_a_new_flight_is_right_on_average():
    """Biases of few flights: squared sum over stated variance has mean one for a flight not seen."""
    rng = np.random.default_rng(1)
    ratio = []
    for _ in range(150):
        bias = rng.standard_normal((9, 3))
        z = [[np.tile(b, (400, 1)) + rng.standard_normal((400, 3))] for b in bias]
        found = span_variances(z[:8])
        stated = found.predictive[found.spans == 200][0]
        ratio.append((z[8][0][:200].sum(axis=0) ** 2 / stated).mean())
    assert 0.8 < np.mean(ratio) < 1.25

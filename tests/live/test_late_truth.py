"""Late truth that comes more slowly than the odometry: what interpolation misses is no error of the odometry."""

from types import SimpleNamespace

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.live.late_truth import LateTruth
from gpvo.types import Prediction, Status, VoRecord

SIGMA = np.array([0.003] * 3 + [0.0008] * 3)


def path(t_s: np.ndarray) -> np.ndarray:
    """A flight in circles of 5 m that bobs and rolls, (N, 4, 4)."""
    angle = 0.4 * t_s
    R = se3.so3_exp(np.stack([0.05 * np.sin(2 * t_s), 0.05 * np.cos(1.7 * t_s), angle], axis=1))
    return se3.from_rt(R, np.stack([5 * np.cos(angle), 5 * np.sin(angle), 0.3 * np.sin(1.5 * t_s)], axis=1))


def message(t_ns: int, T: np.ndarray) -> SimpleNamespace:
    """A PoseStamped."""
    x, y, z, w = se3.rotation_to_quaternion_xyzw(T[:3, :3])
    stamp = SimpleNamespace(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="world"),
        pose=SimpleNamespace(
            position=SimpleNamespace(x=T[0, 3], y=T[1, 3], z=T[2, 3]), orientation=SimpleNamespace(x=x, y=y, z=z, w=w)
        ),
    )


@pytest.mark.parametrize("truth_hz", [100.0, 10.0, 4.0])
def test_what_is_judged_errs_as_it_is_stated(truth_hz: float) -> None:
    rng, late = np.random.default_rng(0), LateTruth("/truth")
    t_s, truth_s = np.arange(0, 60, 1 / 20), np.arange(0, 60, 1 / truth_hz)
    T, T_truth = path(t_s), path(truth_s)
    t_ns, truth_ns = (10**10 + np.rint(t * 1e9).astype(np.int64) for t in (t_s, truth_s))
    arrived, ratios = 0, []
    for k in range(1, len(t_s)):
        motion = se3.inverse(T[k - 1]) @ T[k] @ se3.exp(SIGMA * rng.standard_normal(6))
        stated = Prediction(
            mean=np.zeros(6), jitter=np.zeros((6, 6)), white=np.diag(SIGMA**2), persistent_root=np.zeros((6, 0)),
            persistent_tau_s=np.zeros(0), dt_s=0.05, status=Status.OK, t_ns=int(t_ns[k]), epistemic=np.zeros(6),
            confidence=1.0, in_domain=1.0,
        )  # fmt: skip
        late.predicted(VoRecord(int(t_ns[k]), int(t_ns[k - 1]), Status.OK, motion), stated)
        while arrived < len(truth_ns) and truth_ns[arrived] <= t_ns[k]:
            found = late.take(message(int(truth_ns[arrived]), T_truth[arrived]), np.eye(4))
            ratios += [xi / SIGMA for _, xi in found]
            arrived += 1
    z2 = np.square(ratios)
    # Sound are axes of which a quarter of the variance, at most, is the truth's; the first second has no history yet.
    settled = z2[len(z2) // 20 :]
    assert np.isfinite(settled).sum() > 500
    judged = np.isfinite(settled).any(axis=0)
    assert np.nanmean(settled) < 1.35
    assert np.nanmax(np.nanmean(settled[:, judged], axis=0)) < 1.6

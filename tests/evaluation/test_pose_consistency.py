"""NEES of poses is 1 where poses err as they are said to, by Monte Carlo, and is invariant to the world frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluation_runs import make_run, stated_covariance
from gpvo.evaluation.statements import statements
from gpvo.evaluation.trajectory import aligned, pose_consistency
from gpvo.filters.metrics import umeyama
from gpvo.geometry import se3
from gpvo.stats.consistency import nees
from gpvo.types import IMPORTED_POSE, Status, VoLog, VoRecord

N = 600


def filtered(seed: int, factor: float = 1.0) -> tuple[VoLog, np.ndarray, np.ndarray]:
    """A log of poses that err independently by the stated covariance, as those of a filter with a map; the estimate is
    in a world frame of its own."""
    log, truth = make_run(N, v_t=False)
    C = 100 * stated_covariance()
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((N + 1, 6)) @ np.linalg.cholesky(C).T
    other_world = se3.exp(np.array([5.0, -3.0, 2.0, 0.3, 1.2, -0.4]))
    T_est = other_world @ truth.T_world_cam @ se3.exp(noise)
    return VoLog([replace(r, covariances={IMPORTED_POSE: factor * C}) for r in log]), T_est, truth.T_world_cam


def test_it_is_one_where_the_statement_is_true() -> None:
    known = np.ones(N + 1, bool)
    found = [pose_consistency(*filtered(seed), known) for seed in range(10)]
    for block, dof in (("position", 3), ("orientation", 3), ("joint", 6)):
        mean = np.mean([f.nees_dof[block].mean for f in found])
        # 6,010 poses: four standard deviations of the mean, and the six numbers of each alignment.
        assert abs(mean - 1.0) < 4 * np.sqrt(2 / dof / (10 * (N + 1))) + 6 / N


def test_it_is_that_of_the_published_definitions_in_either_convention() -> None:
    """World axes, ``p_true - p_est`` and ``R_true = Exp(e) R_est``, as of ROS messages; and the right perturbation with
    the position's error in the world, as by OpenVINS and most filters on a manifold."""
    known = np.ones(N + 1, bool)
    for seed in range(3):
        log, T_est, T_true = filtered(seed)
        found = pose_consistency(log, T_est, T_true, known)
        assert found is not None
        T = aligned(T_est, T_true, log.covariance(IMPORTED_POSE))
        off_m = T[:, :3, 3] - T_true[:, :3, 3]
        left = se3.so3_log(T[:, :3, :3] @ np.swapaxes(T_true[:, :3, :3], -1, -2))
        right = se3.so3_log(np.swapaxes(T_true[:, :3, :3], -1, -2) @ T[:, :3, :3])
        into_world = np.zeros((N + 1, 6, 6))
        into_world[:, :3, :3] = into_world[:, 3:, 3:] = T[:, :3, :3]
        body = log.covariance(IMPORTED_POSE)
        world = into_world @ body @ np.swapaxes(into_world, -1, -2)
        published = {
            "position": nees(off_m, world[:, :3, :3]) / 3,
            "orientation": nees(left, world[:, 3:, 3:]) / 3,
            "joint": nees(np.concatenate([off_m, left], axis=1), world) / 6,
        }
        for block, values in published.items():
            assert found.nees_dof[block].mean == pytest.approx(values.mean(), rel=0.01)
        R, t = umeyama(T_est[:, :3, 3], T_true[:, :3, 3])
        by_positions = se3.log(se3.inverse(T_true) @ se3.from_rt(R, t) @ T_est)
        assert found.nees_dof["joint"].mean == pytest.approx((nees(by_positions, body) / 6).mean(), rel=12 / N)
        on_manifold = (nees(right, body[:, 3:, 3:]) / 3).mean()
        assert found.nees_dof["orientation"].mean == pytest.approx(on_manifold, rel=1e-6)


@pytest.mark.parametrize("path", ["straight", "at rest", "nearly straight", "drifting"])
def test_it_is_one_where_positions_do_not_tell_the_rotation_and_where_errors_grow(path: str) -> None:
    s, sigma = np.linspace(0.0, 50.0, 300), np.array([0.02] * 3 + [0.005] * 3)
    p = np.stack([s, 0.2 * np.sin(s / 5) if path == "nearly straight" else 0 * s, 0 * s], axis=1)
    T_true = se3.from_rt(np.tile(np.eye(3), (300, 1, 1)), np.zeros_like(p) if path == "at rest" else p)
    # Of odometry without a map: exact at its start, from where errors grow.
    size = np.linspace(0.01, 10.0, 300)[:, None] if path == "drifting" else np.ones((300, 1))
    C = (size * sigma)[:, :, None] ** 2 * np.eye(6)
    by_block = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        steps = np.diff(size[:, 0] ** 2, prepend=0.0) ** 0.5 if path == "drifting" else None
        drawn = rng.standard_normal((300, 6))
        xi = sigma * (size * drawn if steps is None else np.cumsum(steps[:, None] * drawn, axis=0))
        T_est = T_true @ se3.exp(xi)
        records = [
            VoRecord(k, max(k - 1, 0), Status.OK if k else Status.START, np.eye(4), covariances={IMPORTED_POSE: c})
            for k, c in enumerate(C)
        ]
        found = pose_consistency(VoLog(records), T_est, T_true, np.ones(300, bool))
        by_block.append([found.nees_dof[b].mean for b in ("position", "orientation", "joint")])
    # Of errors that grow as a random walk a flight holds about three, so 60 have a standard deviation of 0.06.
    bound = 0.2 if path == "drifting" else 0.06
    assert np.mean(by_block, axis=0) == pytest.approx(np.ones(3), abs=bound)


def test_it_is_the_same_wherever_the_truth_has_its_origin() -> None:
    """As in UTM coordinates, for odometry that is certain at its start."""
    rng, step = np.random.default_rng(0), np.diag([0.01] * 3 + [0.002] * 3) ** 2
    motion = se3.exp(np.array([0.0, 0.02, 0.5, 0.005, 0.02, 0.0]))
    T_true, T_est, C = [np.eye(4)], [np.eye(4)], [1e-2 * step]
    back = se3.adjoint(se3.inverse(motion))
    for _ in range(300):
        T_true.append(T_true[-1] @ motion)
        T_est.append(T_est[-1] @ motion @ se3.exp(rng.multivariate_normal(np.zeros(6), step)))
        C.append(back @ C[-1] @ back.T + step)
    log = VoLog(
        [VoRecord(k, max(k - 1, 0), Status.OK, np.eye(4), covariances={IMPORTED_POSE: c}) for k, c in enumerate(C)]
    )
    found = []
    for origin_m in (0.0, 5e6):
        world = se3.from_rt(np.eye(3), origin_m * np.array([0.1, 1.0, 0.0]))
        poses = pose_consistency(log, np.array(T_est), world @ np.array(T_true), np.ones(301, bool))
        found.append([poses.nees_dof[b].mean for b in ("position", "orientation", "joint")])
    assert found[1] == pytest.approx(found[0], rel=1e-6)


def test_it_shows_by_how_much_a_statement_is_wrong() -> None:
    known = np.ones(N + 1, bool)
    right, bold = (pose_consistency(*filtered(0, f), known) for f in (1.0, 0.25))
    for block in ("position", "orientation", "joint"):
        assert bold.nees_dof[block].mean == pytest.approx(4 * right.nees_dof[block].mean)


def test_covariances_of_poses_are_no_statement_of_motions() -> None:
    log, _, _ = filtered(0)
    assert not statements(log)
    plain, _ = make_run(20)
    assert pose_consistency(plain, np.empty((0, 4, 4)), np.empty((0, 4, 4)), np.ones(21, bool)) is None

"""NEES of poses is 1 where poses err as they are said to, by Monte Carlo, and is invariant to the world frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluation_runs import make_run, stated_covariance
from gpvo.evaluation.statements import statements
from gpvo.evaluation.trajectory import pose_consistency
from gpvo.filters.metrics import umeyama
from gpvo.geometry import se3
from gpvo.stats.consistency import nees
from gpvo.types import IMPORTED_POSE, VoLog

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
    """World axes, ``p_true - p_est`` and ``R_true = Exp(e) R_est``, as by OpenVINS' global orientation error; and the
    right perturbation with the position's error in the world, as by most filters on a manifold."""
    known = np.ones(N + 1, bool)
    for seed in range(3):
        log, T_est, T_true = filtered(seed)
        found = pose_consistency(log, T_est, T_true, known)
        assert found is not None
        R, t = umeyama(T_est[:, :3, 3], T_true[:, :3, 3])
        T = se3.from_rt(R, t) @ T_est
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
        on_manifold = (nees(right, body[:, 3:, 3:]) / 3).mean()
        assert found.nees_dof["orientation"].mean == pytest.approx(on_manifold, rel=1e-6)


def test_it_shows_by_how_much_a_statement_is_wrong() -> None:
    known = np.ones(N + 1, bool)
    right, bold = (pose_consistency(*filtered(0, f), known) for f in (1.0, 0.25))
    for block in ("position", "orientation", "joint"):
        assert bold.nees_dof[block].mean == pytest.approx(4 * right.nees_dof[block].mean)


def test_covariances_of_poses_are_no_statement_of_motions() -> None:
    log, _, _ = filtered(0)
    assert statements(log) == []
    plain, _ = make_run(20)
    assert pose_consistency(plain, np.empty((0, 4, 4)), np.empty((0, 4, 4)), np.ones(21, bool)) is None

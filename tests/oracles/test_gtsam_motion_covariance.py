"""GTSAM's marginal covariance of a stereo pose is ours, where the model is the same."""

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.types import StereoCamera
from gpvo.vo.covariance import motion_covariance
from gpvo.vo.motion import transfer
from gpvo.vo.points import triangulate, triangulation_pixel_covariance

gtsam = pytest.importorskip("gtsam", reason="the test oracle gtsam is not installed")

CAMERA = StereoCamera(380.0, 390.0, 319.5, 239.5, 0.12, 640, 480)
T_PREV_CUR = se3.exp(np.array([0.05, -0.02, 0.15, 0.01, -0.03, 0.02]))
# GTSAM measures (uL, uR, v): (u, v, d) with independent uL, uR and v has this covariance at unit noise.
S_UVD = np.array([[1.0, 0, 1], [0, 1, 0], [1, 0, 2]])
# GTSAM's tangent vectors have the rotation first.
SWAP = np.r_[3:6, 0:3]


def _marginal(points_known: bool) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    uvd = np.column_stack([rng.uniform(0, 640, 50), rng.uniform(0, 480, 50), rng.uniform(4, 40, 50)])
    cur = transfer(T_PREV_CUR, uvd, CAMERA).uvd.T
    K = gtsam.Cal3_S2Stereo(CAMERA.fx_px, CAMERA.fy_px, 0, CAMERA.cx_px, CAMERA.cy_px, CAMERA.baseline_m)
    unit = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    fixed = gtsam.noiseModel.Constrained.All(6)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses = (np.eye(4), T_PREV_CUR)
    for k, T in enumerate(poses):
        values.insert(k, gtsam.Pose3(T))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), fixed))
    for i, X in enumerate(triangulate(uvd, CAMERA)):
        values.insert(100 + i, X)
        if points_known:
            graph.add(gtsam.PriorFactorPoint3(100 + i, X, gtsam.noiseModel.Constrained.All(3)))
        for k, z in enumerate((uvd[i], cur[i])):
            stereo = gtsam.StereoPoint2(z[0], z[0] - z[2], z[1])
            graph.add(gtsam.GenericStereoFactor3D(stereo, unit, k, 100 + i, K))
    return gtsam.Marginals(graph, values).marginalCovariance(1)[np.ix_(SWAP, SWAP)], uvd


def test_unknown_points() -> None:
    """The two-frame problem with all points free: our (sum H^T W H)^-1 is its marginal."""
    theirs, uvd = _marginal(points_known=False)
    ours = motion_covariance(T_PREV_CUR, uvd, CAMERA, S_UVD).full
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6 * np.abs(theirs).max() * 1e-3)


def test_known_points() -> None:
    """Points taken as exact: the covariance that PnP states."""
    theirs, uvd = _marginal(points_known=True)
    ours = motion_covariance(T_PREV_CUR, uvd, CAMERA, S_UVD, exact_points=True).full
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6 * np.abs(theirs).max() * 1e-3)


def test_triangulation_covariance_follows_from_four_measurements() -> None:
    np.testing.assert_allclose(triangulation_pixel_covariance()[[0, 2]][:, [0, 2]], S_UVD[[0, 2]][:, [0, 2]])

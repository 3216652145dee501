"""Depth and radiance against Embree and across the pair, for pinhole and fisheye."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.sim.worlds import World, tunnel

pytest.importorskip("numba")
rtcore = pytest.importorskip("embreex.rtcore_scene")
from embreex.mesh_construction import TriangleMesh  # noqa: E402
from gpvo.sim.render import StereoRenderer  # noqa: E402

LENSES = {
    "pinhole": PinholeRadtan(380, 380, 319.5, 239.5, 640, 480),
    "distorted": PinholeRadtan(229, 228, 183, 124, 376, 240, (-0.28, 0.07, 2e-4, 2e-5)),
    "fisheye": KannalaBrandt(143, 143, 212, 200, 424, 400, (-0.005, 0.04, -0.038, 0.006)),
}
T_RIGHT_LEFT = np.eye(4)
T_RIGHT_LEFT[0, 3] = -0.1
OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


@pytest.fixture(scope="module")
def world() -> World:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gpvo.sim.worlds.tunnel._TEXTURE_PX", 1024)
        return tunnel.build(3, tunnel.Params(length=40.0))


def embree_depth(world: World, model: CameraModel, T_world_cam: np.ndarray) -> np.ndarray:
    scene = rtcore.EmbreeScene()
    TriangleMesh(
        scene, np.ascontiguousarray((world.mesh.vertices - T_world_cam[:3, 3].astype(np.float32))[world.mesh.faces])
    )
    v, u = np.mgrid[: model.height, : model.width]
    rays = model.unproject(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    directions = np.nan_to_num(rays @ T_world_cam[:3, :3].T, nan=1.0).astype(np.float32)
    reach = scene.run(np.zeros_like(directions), np.ascontiguousarray(directions), query="DISTANCE")
    return (np.where(reach < 1e6, reach, np.nan) * rays[:, 2]).reshape(model.height, model.width)


def pose(world: World, turn: float) -> np.ndarray:
    T = world.start_pose.copy()
    T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.array([0.05, -0.1, turn]))[0]
    # Rounded to float32, which is all that Embree knows.
    T[:3, 3] = T[:3, 3].astype(np.float32)
    return T @ OPTICAL


@pytest.mark.parametrize("lens", list(LENSES))
@pytest.mark.parametrize("turn", [0.2, 1.9])
def test_depth_is_embrees(world: World, lens: str, turn: float) -> None:
    model = LENSES[lens]
    renderer = StereoRenderer(world, model, model, T_RIGHT_LEFT, threads=1)
    T = pose(world, turn)
    _, _, depth = renderer.render(T)
    error = np.abs(depth - embree_depth(world, model, T))[renderer.mask_left]
    assert np.isfinite(error).mean() > 0.999
    assert np.nanmedian(error) < 1e-5
    # Silhouettes may fall to either side, the rest must agree.
    assert np.nanmean(error > 1e-3) < 2e-3


@pytest.mark.parametrize("turn", [0.2, 1.2])
def test_right_image_is_where_depth_says(world: World, turn: float) -> None:
    model = LENSES["pinhole"]
    renderer = StereoRenderer(world, model, model, T_RIGHT_LEFT)
    left, right, depth = renderer.render(pose(world, turn))
    gain = 0.3 / np.percentile(left, 70)
    left8, right8 = ((np.sqrt(np.clip(gain * image, 0, 1)) * 255).astype(np.uint8) for image in (left, right))
    corners = cv2.goodFeaturesToTrack(left8[20:-20, 60:-20], 500, 0.01, 8).reshape(-1, 2) + [60, 20]
    z = depth[corners[:, 1].astype(int), corners[:, 0].astype(int)].astype(float)
    expected = corners - np.stack([380 * 0.1 / z, 0 * z], axis=1)
    start = corners.astype(np.float32)[:, None]
    guess = expected.astype(np.float32)[:, None].copy()
    found, ok, _ = cv2.calcOpticalFlowPyrLK(
        left8, right8, start, guess, winSize=(21, 21), maxLevel=0,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW, criteria=(3, 50, 1e-4),
    )  # fmt: skip
    error = (found.reshape(-1, 2) - expected)[ok.ravel() == 1]
    # Windows over a step in depth have no single disparity: the middle nine tenths are judged.
    good = np.abs(error - np.median(error, axis=0)).max(axis=1)
    error = error[good <= np.quantile(good, 0.9)]
    assert np.abs(np.median(error, axis=0)).max() < 0.01
    assert error.std(axis=0).max() < 0.1

"""The renderer: same bytes in any number of threads, right image as its geometry says, effects."""

import numpy as np
import pytest

pytest.importorskip("numba")

from gpvo.sim.render import StereoRenderer
from small_world import FISHEYE, PINHOLE, RADTAN, pose, right_of, small_world


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_threads_do_not_change_a_bit(camera):
    world, T = small_world(), pose(0.1, yaw=0.2)
    pictures = [
        StereoRenderer(world, camera, camera, right_of(0.1), threads=threads).render(T) for threads in (1, 2, 5)
    ]
    for other in pictures[1:]:
        for a, b in zip(pictures[0], other):
            assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE], ids=["pinhole", "radtan", "fisheye"])
def test_no_holes_inside_a_closed_world(camera):
    renderer = StereoRenderer(small_world(), camera, camera, right_of(0.1), threads=1)
    for yaw in (0.0, 1.0, 2.5):
        _, _, depth = renderer.render(pose(-0.3, 0.2, yaw))
        assert np.isfinite(depth[renderer.mask_left]).all()
        assert np.isnan(depth[~renderer.mask_left]).all()


def test_left_depth_predicts_the_right_image():
    cv2 = pytest.importorskip("cv2")
    baseline = 0.05
    left, right, depth = StereoRenderer(small_world(), PINHOLE, PINHOLE, right_of(baseline), threads=1).render(pose())
    v, u = np.mgrid[:120, :160].astype(np.float32)
    seen = cv2.remap(right, (u - 120.0 * baseline / depth).astype(np.float32), v, cv2.INTER_CUBIC)
    inner = (slice(8, -8), slice(16, -8))
    difference = (seen - left)[inner]
    gradient = cv2.Sobel(left, cv2.CV_32F, 1, 0, scale=1 / 8)[inner]
    clear = np.abs(difference) < np.quantile(np.abs(difference), 0.9)  # off the plate's edge
    shift = (gradient * difference)[clear].sum() / (gradient**2)[clear].sum()
    assert abs(shift) < 0.02


def test_motion_blur_is_the_mean_of_its_poses_and_depth_that_of_the_frame():
    renderer = StereoRenderer(small_world(), PINHOLE, PINHOLE, right_of(0.1), threads=1)
    poses = [pose(yaw=a) for a in (-0.02, 0.0, 0.02)]
    single = [renderer.render(T) for T in poses]
    left, right, depth = renderer.render(poses[1], motion=poses)
    np.testing.assert_allclose(left, np.mean([s[0] for s in single], axis=0), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(right, np.mean([s[1] for s in single], axis=0), rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(depth, single[1][2])

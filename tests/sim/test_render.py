"""The renderer: exact on a plane, the same bytes in any number of threads, without holes, right image as its geometry
says, effects.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import small_world as small
from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.errors import GpvoError
from gpvo.sim.render import StereoRenderer
from gpvo.sim.worlds import Lighting, Mesh, World
from gpvo.sim.worlds.shapes import rectangle, vertex_normals

pytest.importorskip("numba")

PINHOLE = PinholeRadtan(150, 150, 79.5, 59.5, 160, 120)
FISHEYE = KannalaBrandt(60, 60, 79.5, 74.5, 160, 150, (0.01, 0.0, 0.0, 0.0))
T_RIGHT_LEFT = np.eye(4)
T_RIGHT_LEFT[0, 3] = -0.1


def wall(distance: float = 3.0, texture: np.ndarray | None = None) -> World:
    """A wall at z = ``distance`` seen along +z, which fills the view."""
    vertices, uv, faces = rectangle((-60, 60, distance), (120, 0, 0), (0, -120, 0), 1.0)
    n = len(vertices)
    ones = np.ones(n, np.float32)
    grey = np.full((64, 64), 255, np.uint8) if texture is None else texture
    mesh = Mesh(
        vertices.astype(np.float32), vertex_normals(vertices, faces).astype(np.float32), uv.astype(np.float32),
        ones, ones, faces, np.zeros(len(faces), np.uint8),
    )  # fmt: skip
    line = np.zeros((2, 3))
    return World(mesh, (grey,), Lighting(0.5, 0.0), line, np.eye(4), np.array([[-9.0] * 3, [9.0] * 3]))


def checks() -> np.ndarray:
    return np.kron(np.random.default_rng(0).integers(40, 250, (16, 16)), np.ones((8, 8))).astype(np.uint8)


@pytest.mark.parametrize("model", [PINHOLE, FISHEYE])
def test_a_plane_has_exact_depth_and_light(model: CameraModel) -> None:
    renderer = StereoRenderer(wall(), model, model, T_RIGHT_LEFT, threads=1, max_angle_rad=1.2)
    left, right, depth = renderer.render(np.eye(4))
    mask = renderer.mask_left
    np.testing.assert_allclose(depth[mask], 3.0, atol=2e-5)
    np.testing.assert_allclose(left[mask], 1.5, rtol=1e-4)
    np.testing.assert_allclose(right[mask], 1.5, rtol=1e-4)
    assert np.isnan(depth[~mask]).all()
    assert (left[~mask] == 0).all()


@pytest.mark.parametrize("model", [PINHOLE, FISHEYE])
def test_a_slanted_plane_leaves_no_pixel_out(model: CameraModel) -> None:
    renderer = StereoRenderer(wall(1.0, checks()), model, model, T_RIGHT_LEFT, threads=1, max_angle_rad=0.9)
    T = np.eye(4)
    c, s = np.cos(0.6), np.sin(0.6)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    _, _, depth = renderer.render(T)
    v, u = np.mgrid[: model.height, : model.width]
    rays = model.unproject(np.stack([u.ravel(), v.ravel()], axis=1).astype(float)).reshape(*depth.shape, 3)
    expected = rays[..., 2] / (rays @ T[:3, :3].T)[..., 2]
    mask = renderer.mask_left
    np.testing.assert_allclose(depth[mask], expected[mask], rtol=3e-5)


def test_same_bits_on_one_and_two_threads_and_again() -> None:
    world = wall(3.0, checks())
    one = StereoRenderer(world, PINHOLE, PINHOLE, T_RIGHT_LEFT, threads=1)
    two = StereoRenderer(world, PINHOLE, PINHOLE, T_RIGHT_LEFT, threads=2)
    T, other = np.eye(4), np.eye(4)
    other[:3, 3] = 0.3, 0.2, -0.4
    first = one.render(T)
    two.render(other)
    for a, b in zip(first, two.render(T), strict=True):
        np.testing.assert_array_equal(a, b)


def test_motion_is_the_mean_over_the_exposure() -> None:
    renderer = StereoRenderer(wall(3.0, checks()), PINHOLE, FISHEYE, T_RIGHT_LEFT)
    poses = np.repeat(np.eye(4)[None], 4, axis=0)
    poses[:, 0, 3] = np.linspace(-0.05, 0.05, 4)
    left, right, depth = renderer.render(np.eye(4), motion=poses)
    single = [renderer.render(T) for T in poses]
    np.testing.assert_allclose(left, np.mean([s[0] for s in single], axis=0), atol=1e-6)
    np.testing.assert_allclose(right, np.mean([s[1] for s in single], axis=0), atol=1e-6)
    np.testing.assert_array_equal(depth, renderer.render(np.eye(4))[2])
    sharp = renderer.render(np.eye(4))[0]
    assert np.abs(np.diff(left, axis=1)).mean() < np.abs(np.diff(sharp, axis=1)).mean()


def test_the_head_lamp_lights_what_is_ahead_and_near() -> None:
    def lamp_light(distance: float) -> np.ndarray:
        worlds = (replace(wall(distance), lighting=Lighting(0.5, power)) for power in (0.0, 3.0))
        dark, lit = (StereoRenderer(world, PINHOLE, PINHOLE, T_RIGHT_LEFT, threads=1) for world in worlds)
        return lit.render(np.eye(4))[0] - dark.render(np.eye(4))[0]

    near, far = lamp_light(4.0), lamp_light(8.0)
    assert near[60, 80] == pytest.approx(3.0 / 4**2, rel=0.05)
    assert near[60, 80] / far[60, 80] == pytest.approx(4.0, rel=0.05)
    assert near[0, 0] < near[60, 80]


def test_textures_of_several_sizes_are_refused() -> None:
    world = wall()
    odd = World(**{**world.__dict__, "textures": (world.textures[0], np.zeros((32, 32), np.uint8))})
    with pytest.raises(GpvoError, match="one size"):
        StereoRenderer(odd, PINHOLE, PINHOLE, T_RIGHT_LEFT)


def test_without_numba_one_is_told_what_to_install() -> None:
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "import numpy as np, gpvo.sim, gpvo.sim.render, gpvo.sim.worlds\n"
        "from gpvo.errors import MissingExtraError\n"
        "try:\n    gpvo.sim.render.StereoRenderer(None, None, None, np.eye(4))\n"
        "except MissingExtraError as error:\n    print(error)\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "gpvo[sim]" in out


@pytest.mark.parametrize("camera", [small.PINHOLE, small.FISHEYE], ids=["pinhole", "fisheye"])
def test_threads_do_not_change_a_bit(camera):
    world, T = small.small_world(), small.pose(0.1, yaw=0.2)
    pictures = [
        StereoRenderer(world, camera, camera, small.right_of(0.1), threads=threads).render(T) for threads in (1, 2, 5)
    ]
    for other in pictures[1:]:
        for a, b in zip(pictures[0], other):
            assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("camera", [small.PINHOLE, small.RADTAN, small.FISHEYE], ids=["pinhole", "radtan", "fisheye"])
def test_no_holes_inside_a_closed_world(camera):
    renderer = StereoRenderer(small.small_world(), camera, camera, small.right_of(0.1), threads=1)
    for yaw in (0.0, 1.0, 2.5):
        _, _, depth = renderer.render(small.pose(-0.3, 0.2, yaw))
        assert np.isfinite(depth[renderer.mask_left]).all()
        assert np.isnan(depth[~renderer.mask_left]).all()


def test_left_depth_predicts_the_right_image():
    cv2 = pytest.importorskip("cv2")
    baseline = 0.05
    left, right, depth = StereoRenderer(
        small.small_world(), small.PINHOLE, small.PINHOLE, small.right_of(baseline), threads=1
    ).render(small.pose())
    v, u = np.mgrid[:120, :160].astype(np.float32)
    seen = cv2.remap(right, (u - 120.0 * baseline / depth).astype(np.float32), v, cv2.INTER_CUBIC)
    inner = (slice(8, -8), slice(16, -8))
    difference = (seen - left)[inner]
    gradient = cv2.Sobel(left, cv2.CV_32F, 1, 0, scale=1 / 8)[inner]
    clear = np.abs(difference) < np.quantile(np.abs(difference), 0.9)  # off the plate's edge
    shift = (gradient * difference)[clear].sum() / (gradient**2)[clear].sum()
    assert abs(shift) < 0.02


def test_motion_blur_is_the_mean_of_its_poses_and_depth_that_of_the_frame():
    renderer = StereoRenderer(small.small_world(), small.PINHOLE, small.PINHOLE, small.right_of(0.1), threads=1)
    poses = [small.pose(yaw=a) for a in (-0.02, 0.0, 0.02)]
    single = [renderer.render(T) for T in poses]
    left, right, depth = renderer.render(poses[1], motion=poses)
    np.testing.assert_allclose(left, np.mean([s[0] for s in single], axis=0), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(right, np.mean([s[1] for s in single], axis=0), rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(depth, single[1][2])

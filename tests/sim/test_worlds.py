"""Worlds: closed where they should be, reproducible, cached, and refusing nonsense."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.sim.worlds import TriangleDistance, World, build_world, cache_folder, load_world, tunnel
from gpvo.sim.worlds.shapes import grid_faces, icosphere, rectangle, vertex_normals

SMALL = {
    "tunnel": {"length": 30.0, "step": 0.25, "curve": "curved", "smooth_stretches": 1},
    "lunar": {"length": 20.0, "boulders": 30, "craters": 40},
    "room": {"boxes": 4, "posters": 4},
}


@pytest.fixture(scope="module", autouse=True)
def _small_and_own_cache(tmp_path_factory: pytest.TempPathFactory):
    pytest.importorskip("embreex")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        for module in ("tunnel", "lunar", "room"):
            patch.setattr(f"gpvo.sim.worlds.{module}._TEXTURE_PX", 128)
        yield


def on_surfaces(world: World, n: int, seed: int) -> np.ndarray:
    """``n`` points (n, 3) spread evenly over the surfaces of a world."""
    rng = np.random.default_rng(seed)
    corners = world.mesh.vertices[world.mesh.faces].astype(np.float64)
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(edge1, edge2), axis=1)
    face = rng.choice(len(area), size=n, p=area / area.sum())
    a, b = np.sqrt(rng.random(n)), rng.random(n)
    return corners[face, 0] + (a * (1 - b))[:, None] * edge1[face] + (a * b)[:, None] * edge2[face]


@pytest.mark.parametrize("kind", list(SMALL))
def test_a_world_offers_what_paths_need(kind: str) -> None:
    world = build_world(kind, 4, **SMALL[kind])
    clearance = world.clearance(world.centreline)
    assert clearance.min() > 0.5
    assert world.clearance(world.start_pose[None, :3, 3])[0] > 0.5
    R = world.start_pose[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    assert (world.centreline >= world.bounds[0]).all()
    assert (world.centreline <= world.bounds[1]).all()
    marks = on_surfaces(world, 200, 1)
    within = ((marks >= world.bounds[0] - 0.5) & (marks <= world.bounds[1] + 0.5)).all(axis=1)
    assert np.abs(world.clearance(marks[within])).max(initial=0) < 2e-3
    mesh = world.mesh
    assert np.isfinite(mesh.vertices).all()
    assert mesh.light.min() >= 0
    assert mesh.light.max() > 0
    assert mesh.material.max() < len(world.textures)


@pytest.mark.parametrize("kind", list(SMALL))
def test_the_cache_gives_back_what_was_built(kind: str) -> None:
    world = build_world(kind, 5, **SMALL[kind])
    files = list(cache_folder().glob(f"{kind}-5-*.npz"))
    assert len(files) == 1
    again = load_world(files[0])
    for name in ("vertices", "normals", "uv", "light", "albedo", "faces", "material"):
        np.testing.assert_array_equal(getattr(world.mesh, name), getattr(again.mesh, name))
    np.testing.assert_array_equal(world.textures, again.textures)
    np.testing.assert_array_equal(world.centreline, again.centreline)
    assert again.lighting == world.lighting


def test_a_damaged_cache_file_is_built_anew() -> None:
    world = build_world("room", 6, **SMALL["room"])
    (path,) = cache_folder().glob("room-6-*.npz")
    path.write_bytes(path.read_bytes()[:1000])
    again = build_world("room", 6, **SMALL["room"])
    np.testing.assert_array_equal(world.mesh.vertices, again.mesh.vertices)


def test_a_cache_that_cannot_be_written_is_no_hindrance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    assert len(build_world("room", 7, **SMALL["room"]).mesh.faces) > 0


def test_a_user_without_a_home_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that runs under a number."""
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert len(build_world("room", 7, **SMALL["room"]).mesh.faces) > 0
    assert not cache_folder().exists()


def test_seeds_differ() -> None:
    a, b = (build_world("room", seed, **SMALL["room"]) for seed in (1, 2))
    assert a.mesh.vertices.shape != b.mesh.vertices.shape or not np.allclose(a.mesh.vertices, b.mesh.vertices)


def test_branches_open_into_the_main_tunnel() -> None:
    world = tunnel.build(2, tunnel.Params(length=40.0, curve="branching", step=0.25, lamps=0))
    whole = tunnel.build(2, tunnel.Params(length=40.0, curve="curved", step=0.25, lamps=0))
    assert len(world.mesh.faces) > len(whole.mesh.faces)
    assert world.clearance(world.centreline).min() > 0.8


def test_height_is_that_of_the_ground() -> None:
    world = build_world("lunar", 8, **SMALL["lunar"])
    grid = world.ground
    assert grid is not None
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 20, 300), rng.uniform(-1.2, 1.2, 300)
    on = np.stack([x, y, grid(x, y)], axis=1)
    assert np.abs(world.clearance(on)).max() < 1e-4
    assert (world.clearance(on + [0, 0, 0.2]) > 0.1).all()
    assert (world.clearance(on - [0, 0, 0.2]) < -0.1).all()
    assert grid.cell <= 0.25
    with pytest.raises(GpvoError, match="outside"):
        grid(np.array([1e4]), np.array([0.0]))
    assert build_world("room", 5, **SMALL["room"]).ground is None


@pytest.mark.parametrize(
    "kind, params, words",
    [
        ("sea", {}, "unknown world"),
        ("room", {"colour": 1}, "no parameter 'colour'"),
        ("tunnel", {"curve": "spiral"}, "unknown curve"),
        ("tunnel", {"length": -3.0}, "length"),
        ("lunar", {"boulders": -1}, "boulders"),
    ],
)
def test_nonsense_is_refused(kind: str, params: dict, words: str) -> None:
    with pytest.raises(GpvoError, match=words):
        build_world(kind, 0, **params)


def test_distance_to_a_sphere() -> None:
    ball, faces = icosphere(4)
    rng = np.random.default_rng(1)
    p = rng.standard_normal((300, 3))
    p *= (rng.uniform(0.7, 3, 300) / np.linalg.norm(p, axis=1))[:, None]
    distance = TriangleDistance(ball.astype(np.float32), faces).signed(p)
    np.testing.assert_allclose(distance, np.linalg.norm(p, axis=1) - 1, atol=3e-3)


def test_shapes_face_the_side_they_say() -> None:
    vertices, uv, faces = rectangle((0, 0, 0), (2, 0, 0), (0, 1, 0), 0.3)
    np.testing.assert_allclose(vertex_normals(vertices, faces), np.broadcast_to([0, 0, 1.0], vertices.shape))
    np.testing.assert_allclose(uv.max(axis=0), [2, 1])
    assert grid_faces(3, 4).shape == (12, 3)
    ball, faces = icosphere(1)
    assert (ball.shape, faces.shape) == ((42, 3), (80, 3))
    assert ((vertex_normals(ball, faces) * ball).sum(axis=1) > 0.99).all()

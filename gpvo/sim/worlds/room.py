"""A motion-capture hall: blank and masonry walls, wooden floor, boxes, posters, lamps under the ceiling."""

from __future__ import annotations

import numpy as np

from gpvo.sim.worlds import textures
from gpvo.sim.worlds.baking import Baker
from gpvo.sim.worlds.shapes import Parts, rectangle, vertex_normals
from gpvo.sim.worlds.world import Lighting, Mesh, World, check_ranges
from gpvo.types import Array

_TEXTURE_PX = 1024
_PLASTER, _BLOCKS, _PLANKS, _CARDBOARD, _POSTER = 0, 1, 2, 3, 4
_POSTERS = 5


def _panel(
    parts: Parts, material: int, tile_m: float, corner: Array, u: Array, v: Array, edge: float, turn: float = 0
) -> None:
    """A rectangle, its texture starting at (``turn``, ``turn``) tiles."""
    vertices, uv, faces = rectangle(corner, u, v, edge)
    parts.add(vertices, uv / tile_m + turn, faces, material)


def _box(parts: Parts, material: int, centre: Array, size: Array, heading: float, turn: float) -> None:
    """A closed box standing on z = ``centre[2]``, seen from outside."""
    c, s = np.cos(heading), np.sin(heading)
    axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) * np.asarray(size)[:, None]
    corner = np.asarray(centre) - 0.5 * axes[0] - 0.5 * axes[1]
    x, y, z = axes
    sides = ((corner, x, z, 0.0), (corner + x, y, z, 0.3), (corner + x + y, -x, z, 0.6), (corner + y, -y, z, 0.8))
    for at, u, v, further in (*sides, (corner + z, x, y, 0.5)):
        _panel(parts, material, 1.2, at, u, v, 0.2, turn + further)


def build(
    seed: int,
    *,
    width: float = 12.0,
    depth: float = 12.0,
    height: float = 5.0,
    boxes: int = 14,
    posters: int = 12,
    blank_walls: int = 2,
) -> World:
    """A hall of ``width`` (x) by ``depth`` (y) by ``height`` [m] about the origin, floor at z = 0.

    ``blank_walls`` of its four walls are plaster, the others masonry; ``boxes`` stand along them and ``posters``
    hang on them.

    Raises
    ------
    GpvoError
        For values out of range.
    """
    check_ranges(
        width=(width, 6, 60), depth=(depth, 6, 60), height=(height, 2.5, 15),
        boxes=(boxes, 0, 200), posters=(posters, 0, 100), blank_walls=(blank_walls, 0, 4),
    )  # fmt: skip
    rng = np.random.default_rng([seed, 3])
    size = np.array([width, depth, height])
    parts = Parts()
    _shell(parts, size, blank_walls, rng)
    _furnish(parts, size, boxes, posters, rng)
    angle = np.linspace(0, 2 * np.pi, 200)
    radius = 0.5 * min(width, depth) - 2.4
    line = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(200, 1.4)], axis=1)
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = line[0]
    inner = np.array([width / 2 - 0.6, depth / 2 - 0.6])
    images = [textures.plaster, textures.blocks, textures.planks, textures.cardboard, *[textures.poster] * _POSTERS]
    return World(
        kind="room",
        seed=seed,
        params={"width": width, "depth": depth, "height": height},
        mesh=_lit(parts, size, rng),
        textures=tuple(image(_TEXTURE_PX, rng) for image in images),
        lighting=Lighting(ambient=0.25, head_lamp=0.0),
        centreline=line,
        start_pose=pose,
        bounds=np.array([[*-inner, 0.4], [*inner, height - 0.6]]),
    )


def _walls(size: Array) -> list[tuple[Array, Array]]:
    """Lower left corner, as seen from inside, and direction of each wall."""
    x, y = 0.5 * size[:2]
    corners = np.array([[x, y, 0], [x, -y, 0], [-x, -y, 0], [-x, y, 0]])
    return [(corners[k], corners[(k + 1) % 4] - corners[k]) for k in range(4)]


def _shell(parts: Parts, size: Array, blank_walls: int, rng: np.random.Generator) -> None:
    x, y, z = size
    up = np.array([0, 0, z])
    _panel(parts, _PLANKS, 3.0, np.array([-x / 2, -y / 2, 0]), np.array([x, 0, 0]), np.array([0, y, 0]), 0.25)
    _panel(parts, _PLASTER, 3.0, np.array([-x / 2, y / 2, z]), np.array([x, 0, 0]), np.array([0, -y, 0]), 0.25)
    for k in range(int(x // 1.5)):  # beams under the ceiling
        middle, extent = np.array([-x / 2 + 0.75 + 1.5 * k, 0, z - 0.3]), np.array([0.12, y - 0.02, 0.2])
        _box(parts, _BLOCKS, middle, extent, 0.0, 0.1 * k)
    order = rng.permutation(4)
    for wall, (corner, along) in enumerate(_walls(size)):
        blank = order[wall] < blank_walls
        _panel(parts, _PLASTER if blank else _BLOCKS, 2.0, corner, along, up, 0.25)
        foot = corner + 0.01 * np.cross(along, up) / np.linalg.norm(np.cross(along, up))
        _panel(parts, _CARDBOARD, 4.0, foot, along, np.array([0, 0, 0.12]), 0.25)


def _furnish(parts: Parts, size: Array, boxes: int, posters: int, rng: np.random.Generator) -> None:
    walls = _walls(size)
    for k in range(boxes):
        corner, along = walls[k % 4]
        inward = np.cross(along, [0, 0, -1.0])
        inward /= -np.linalg.norm(inward)
        extent = rng.uniform([0.4, 0.35, 0.3], [1.1, 0.7, 1.3])
        at = corner + rng.uniform(0.12, 0.88) * along + rng.uniform(0.5, 1.0) * inward
        _box(parts, _CARDBOARD, at, extent, rng.uniform(0, np.pi), rng.uniform(0, 1))
        if rng.random() < 0.4:
            on_top, smaller = at + [0, 0, extent[2]], extent * [0.6, 0.6, 0.5]
            _box(parts, _CARDBOARD, on_top, smaller, rng.uniform(0, np.pi), rng.random())
    for k in range(posters):
        corner, along = walls[k % 4]
        direction = along / np.linalg.norm(along)
        wide = rng.uniform(0.7, 1.5)
        inward = np.cross(direction, [0, 0, 1.0])
        slots = -(-posters // 4)
        share = (k // 4 + rng.uniform(0.15, 0.6)) / slots
        at = corner + share * (np.linalg.norm(along) - wide) * direction + 0.015 * inward
        at = at + [0, 0, rng.uniform(0.9, max(1.0, size[2] - 2.6))]
        _panel(parts, _POSTER + k % _POSTERS, wide, at, wide * direction, np.array([0, 0, wide]), 0.2)


def _lit(parts: Parts, size: Array, rng: np.random.Generator) -> Mesh:
    V, F = np.concatenate(parts.vertices), np.concatenate(parts.faces)
    N = vertex_normals(V, F)
    baker = Baker(V, N, F)
    grid = np.stack(np.meshgrid([-0.3, 0.0, 0.3], [-0.3, 0.0, 0.3], [0.0]), axis=-1).reshape(-1, 3)
    lamps = grid * size + [0, 0, size[2] - 0.45]
    light = baker.lamps(lamps, np.full(len(lamps), 1.2), reach_m=30.0, size_m=1.2)
    openness = 0.3 + 0.7 * baker.openness(24, 1.0, rng)
    return Mesh.of(V, N, np.concatenate(parts.uv), light, openness, F, np.concatenate(parts.material))

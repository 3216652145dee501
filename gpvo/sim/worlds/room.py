"""A motion-capture hall: blank and masonry walls, wooden floor, boxes, posters, lamps under the ceiling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpvo.sim.worlds import Lighting, Mesh, World
from gpvo.sim.worlds.shapes import Baker, Parts, rectangle
from gpvo.sim.worlds.textures import F32, Texture, encode, spectral
from gpvo.types import Array, within

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


@dataclass(frozen=True)
class Params:
    """What the hall is like: ``width`` along x, ``depth`` along y, ``height`` [m]."""

    width: float = within(12.0, 6, 60)
    depth: float = within(12.0, 6, 60)
    height: float = within(5.0, 2.5, 15)
    boxes: int = within(14, 0, 200)  # along the walls
    posters: int = within(12, 0, 100)  # on the walls
    blank_walls: int = within(2, 0, 4)  # of plaster; the others of the four are masonry


def build(seed: int, params: Params) -> World:
    """A hall about the origin, floor at z = 0."""
    width, depth, height = params.width, params.depth, params.height
    rng = np.random.default_rng([seed, 3])
    size = np.array([width, depth, height])
    parts = Parts()
    _shell(parts, size, params.blank_walls, rng)
    _furnish(parts, size, params.boxes, params.posters, rng)
    angle = np.linspace(0, 2 * np.pi, 200)
    radius = 0.5 * min(width, depth) - 2.4
    line = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(200, 1.4)], axis=1)
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = line[0]
    inner = np.array([width / 2 - 0.6, depth / 2 - 0.6])
    images = [plaster, blocks, planks, cardboard, *[poster] * _POSTERS]
    return World(
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
    baker = Baker(parts)
    grid = np.stack(np.meshgrid([-0.3, 0.0, 0.3], [-0.3, 0.0, 0.3], [0.0]), axis=-1).reshape(-1, 3)
    lamps = grid * size + [0, 0, size[2] - 0.45]
    light = baker.lamps(lamps, np.full(len(lamps), 1.2), reach_m=30.0, size_m=1.2)
    return baker.mesh(light, 0.3 + 0.7 * baker.openness(24, 1.0, rng))


def plaster(n: int, rng: np.random.Generator) -> Texture:
    """A painted wall: blank but for faint stains."""
    return encode(0.78 + 0.008 * spectral(n, rng, 1.5, 1) + 0.004 * spectral(n, rng, 0.2, n / 32))


def blocks(n: int, rng: np.random.Generator) -> Texture:
    """Masonry of concrete blocks, 5 by 10 to a tile."""
    v, u = np.mgrid[:n, :n] / n
    row = np.floor(v * 10).astype(int)
    x = (u * 5 + 0.5 * (row % 2)) % 5
    column = np.floor(x).astype(int)
    joint = np.minimum(np.minimum(x % 1, 1 - x % 1) * 2, np.minimum((v * 10) % 1, 1 - (v * 10) % 1)) < 0.05
    shade = rng.normal(0, 0.045, (10, 5))[row, column]
    pits = spectral(n, rng, 0.4, n / 40)
    return encode(np.where(joint, 0.4, 0.58 + shade - 0.07 * (pits > 1.7)) + 0.02 * spectral(n, rng, 0.9, 3))


def planks(n: int, rng: np.random.Generator) -> Texture:
    """A worn wooden sports floor with scuffs."""
    v, u = np.mgrid[:n, :n] / n
    row = np.floor(v * 24).astype(int)
    x = (u * 2 + rng.random(24)[row]) % 2
    shade = rng.normal(0, 0.05, (24, 2))[row, np.floor(x).astype(int)]
    gap = (np.minimum((v * 24) % 1, 1 - (v * 24) % 1) < 0.02) | (np.minimum(x % 1, 1 - x % 1) < 0.003)
    grain = spectral(n, rng, 0.8, 4)[:, (np.arange(n) // 12) % n]
    scuffs = np.clip(spectral(n, rng, 1.1, 6) - 1.6, 0, 1)
    grey = 0.5 + shade + 0.03 * grain + 0.025 * spectral(n, rng, 0.5, 20) - 0.12 * scuffs
    return encode(np.where(gap, 0.28, grey))


def cardboard(n: int, rng: np.random.Generator) -> Texture:
    """Boxes: cardboard with tape, labels and print."""
    grey = 0.5 + 0.02 * spectral(n, rng, 0.8, 2)
    grey[int(0.47 * n) : int(0.53 * n)] += 0.12
    for _ in range(7):
        _label(grey, rng, 0.08, 0.22)
    return encode(grey)


def poster(n: int, rng: np.random.Generator) -> Texture:
    """Printed matter: pictures, lines of text, blocks of colour."""
    grey = np.full((n, n), 0.85, np.float32)
    picture = spectral(n, rng, 1.3, 2)
    y0, y1 = int(0.08 * n), int(rng.uniform(0.4, 0.6) * n)
    grey[y0:y1, int(0.06 * n) : int(0.94 * n)] = (0.45 + 0.18 * picture)[y0:y1, int(0.06 * n) : int(0.94 * n)]
    for _ in range(5):
        _label(grey, rng, 0.1, 0.35)
    line = n // 40
    for y in range(y1 + 2 * line, int(0.94 * n), 2 * line):
        x = 0.08 * n
        while x < 0.88 * n:
            width = rng.uniform(0.3, 2.2) * line
            grey[y : y + line, int(x) : int(x + width)] = rng.uniform(0.08, 0.35)
            x += width + 0.5 * line
    return encode(grey + 0.01 * spectral(n, rng, 0.3, n / 32))


def _label(grey: F32, rng: np.random.Generator, low: float, high: float) -> None:
    n = len(grey)
    height, width = (int(s * n) for s in rng.uniform(low, high, 2))
    row, column = (int(x * n) for x in rng.uniform(0.05, 0.95 - high, 2))
    grey[row : row + height, column : column + width] = rng.uniform(0.1, 0.95)
    cell = max(n // 90, 1)
    bits = rng.random((max(height // cell - 2, 1), max(width // cell - 2, 1))) < 0.5
    code = np.kron(bits, np.ones((cell, cell), bool))[: height // 2, :]
    part = grey[row + cell : row + cell + code.shape[0], column + cell : column + cell + code.shape[1]]
    part[code[: part.shape[0], : part.shape[1]]] = rng.uniform(0.05, 0.9)

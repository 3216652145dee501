"""A mine tunnel: rough rock, flattened floor, dim lamps; straight, curved or branching."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.sim.worlds import Lighting, Mesh, World
from gpvo.sim.worlds.shapes import Baker, Parts
from gpvo.sim.worlds.textures import duct, fractal, gravel, lattice, rock, shotcrete
from gpvo.sim.worlds.tubes import Line, Tube, bolts, lamp_fixtures, pipe, rough_tube, rubble
from gpvo.types import Array, within

_RADIUS_M = 2.6
_TILE_M = 3.0
_TEXTURE_PX = 2048
_CURVES = {"straight": 0.0, "curved": 0.28, "branching": 0.2}
_SMOOTH_M = 9.0  # length of one smooth stretch
_ROCK, _SHOTCRETE, _GRAVEL, _DUCT = range(4)


@dataclass(frozen=True)
class Params:
    """What a tunnel is like."""

    length: float = within(160.0, 20, 2000)  # [m]
    curve: str = "curved"  # straight, curved or branching
    roughness: float = within(0.3, 0, 0.6)  # height of the rock's relief [m]
    smooth_stretches: int = within(0, 0, 50)  # of bare concrete
    lamps: float = within(11.0, 0, 1000)  # distance between two [m]; 0: none
    step: float = within(0.14, 0.05, 0.25)  # edge of the triangles [m]


def build(seed: int, params: Params) -> World:
    """A tunnel. Raises GpvoError for an unknown curve."""
    length, curve, roughness, step = params.length, params.curve, params.roughness, params.step
    if curve not in _CURVES:
        raise GpvoError(f"unknown curve '{curve}' of a tunnel", cure=f"choose from {', '.join(_CURVES)}")
    rng = np.random.default_rng([seed, 1])
    values = lattice(rng)
    line = _line(length, step, _CURVES[curve], rng)
    stretches = _stretches(length, params.smooth_stretches, rng)
    tubes = [_tube(line, roughness, stretches, step, values, rng)]
    if curve == "branching":
        for at, side in ((0.35, 1), (0.68, -1)):
            tubes.append(_branch(line, _clear_of(at, line.s, stretches), side, roughness, step, values, rng))
    makers = (rock, shotcrete, gravel, duct)
    with ThreadPoolExecutor(2) as pool:
        streams = [np.random.default_rng([seed, 1, k]) for k in range(len(makers))]
        textures = pool.map(lambda make, stream: make(_TEXTURE_PX, stream), makers, streams)
        mesh = _mesh(tubes, stretches, params.lamps, values, rng)
    start = int(6.0 / step)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([line.tangent[start], line.left[start], line.up[start]], axis=1)
    pose[:3, 3] = line.points[start]
    return World(
        mesh=mesh,
        textures=tuple(textures),
        lighting=Lighting(ambient=0.015, head_lamp=1.6),
        centreline=line.points[start:-start],
        start_pose=pose,
        bounds=np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]).astype(float),
    )


def _waves(s: Array, amplitude: float, shortest: float, longest: float, rng: np.random.Generator) -> Array:
    """A smooth random function of the arc length, with standard deviation about ``amplitude`` / sqrt 2."""
    wavelength, phase = rng.uniform(shortest, longest, 5), rng.uniform(0, 2 * np.pi, 5)
    weight = rng.standard_normal(5) * amplitude / np.sqrt(5)
    return (weight[:, None] * np.sin(2 * np.pi * s / wavelength[:, None] + phase[:, None])).sum(axis=0)


def _line(length: float, step: float, curve: float, rng: np.random.Generator) -> Line:
    s = np.linspace(0, length, int(length / step) + 1)
    yaw = _waves(s, curve, 30, 90, rng)
    pitch = _waves(s, 0.05 if curve else 0.0, 40, 100, rng)
    return Line.through(s, yaw - yaw[0], pitch - pitch[0], np.zeros(3))


def _stretches(length: float, count: int, rng: np.random.Generator) -> Array:
    """Intervals of arc length (count, 2) in which walls are bare, one in each of ``count`` equal parts."""
    part = (length - 20.0) / max(count, 1)
    start = 12.0 + part * (np.arange(count) + rng.uniform(0.1, 0.6, count))
    return np.stack([start, start + min(_SMOOTH_M, 0.4 * part)], axis=1)


def _tube(line: Line, roughness: float, bare: Array, step: float, values: np.ndarray, rng: np.random.Generator) -> Tube:
    radius = _RADIUS_M * (1 + _waves(line.s, 0.09, 8, 25, rng))
    rough = np.full(len(line.s), roughness)
    for begin, end in bare:
        rough *= 1 - 0.85 * np.clip(np.minimum(line.s - begin, end - line.s) / 0.8 + 1, 0, 1)
    return rough_tube(line, radius, rough, int(2 * np.pi * _RADIUS_M / step), values, rng)


def _clear_of(at: float, s: Array, bare: Array) -> float:
    """The share of the length nearest to ``at`` that is away from the bare stretches."""
    shares = np.linspace(0.2, 0.8, 61)
    free = shares[~_within(shares * s[-1], bare + [-6.0, 6.0])]
    return float(free[np.abs(free - at).argmin()]) if len(free) else at


def _branch(
    main: Line, at: float, side: int, roughness: float, step: float, values: np.ndarray, rng: np.random.Generator
) -> Tube:
    """A side drift of 18 m that leaves the main line at a share ``at`` of its length."""
    k = int(at * (len(main.s) - 1))
    s = np.linspace(0, 18.0, int(18.0 / step) + 1)
    heading = np.arctan2(main.tangent[k, 1], main.tangent[k, 0]) + side * np.deg2rad(rng.uniform(50, 75))
    yaw = heading - side * 0.03 * s
    # It starts inside the main tunnel, so that the rounded end lies there and is cut away.
    start = main.points[k] - 3.2 * np.array([np.cos(heading), np.sin(heading), 0.0])
    line = Line.through(s + 0.0, yaw, np.zeros_like(s), start)
    return _tube(line, roughness, np.zeros((0, 2)), step, values, rng)


def _mesh(tubes: list[Tube], bare: Array, lamps: float, values: np.ndarray, rng: np.random.Generator) -> Mesh:
    parts = Parts()
    for k, tube in enumerate(tubes):
        points, f = tube.vertices.reshape(-1, 3), tube.faces
        inside = np.zeros(len(points), bool)
        for j, other in enumerate(tubes):
            if j != k:
                inside |= other.contains(points)
        f = f[~inside[f].all(axis=1)]
        material = np.where(tube.floor.ravel()[f].all(axis=1), _GRAVEL, _ROCK)
        if k == 0:
            material[_within(tube.line.s[f[:, 0] // tube.vertices.shape[1]], bare)] = _SHOTCRETE
        parts.add(points, tube.uv(_TILE_M).reshape(-1, 2), f, material.astype(np.uint8))
    positions, powers = _lamps(tubes[0].line, lamps, rng)
    _furnish(parts, tubes[0], bare, positions, values, rng)
    baker = Baker(parts, lambda normals: _seamless(normals, tubes))
    light = baker.lamps(positions, powers, reach_m=16.0) + baker.glow
    patches = fractal(baker.vertices * 0.35, values, 4)
    albedo = (0.35 + 0.65 * baker.openness(12, 1.2, rng)) * np.clip(1 + 0.3 * patches, 0.4, 1.8)
    return baker.mesh(light, albedo)


def _within(s: Array, intervals: Array) -> NDArray[np.bool_]:
    """Whether arc lengths (N,) lie in one of the intervals (M, 2)."""
    return np.any((s[:, None] >= intervals[:, 0]) & (s[:, None] <= intervals[:, 1]), axis=1)


def _furnish(parts: Parts, tube: Tube, bare: Array, lamps: Array, values: np.ndarray, rng: np.random.Generator) -> None:
    """Lamps, duct, cables, bolts and rubble, none of them where the walls are bare."""
    s = tube.line.s
    rows = np.flatnonzero((s > 2.0) & (s < s[-1] - 2.0))
    free = rows[~_within(s[rows], bare + [-0.5, 0.5])]
    lamp_fixtures(parts, lamps, tube, _SHOTCRETE)
    for run in np.split(free, np.flatnonzero(np.diff(free) > 1) + 1):
        third = run[:: max(round(0.25 / (s[1] - s[0])), 1)]
        pipe(parts, tube, third, np.deg2rad(52), 0.42, 0.27, 14, 0.02, _DUCT, 1.5)
        for angle in (148, 153, 160):
            pipe(parts, tube, third, np.deg2rad(angle), 0.12, 0.025, 6, 0.07, _DUCT, 1.5)
    bolts(parts, tube, free[:: max(round(1.5 / (s[1] - s[0])), 1)], _DUCT, rng)
    rubble(parts, tube, free, 0.5, 0.28, int(4 * s[-1]), values, _ROCK, _TILE_M, rng)
    for end in (rows[s[rows] < 3.5], rows[s[rows] > s[-1] - 3.5]):
        rubble(parts, tube, end, 1.0, 0.7, 60, values, _ROCK, _TILE_M, rng)


def _seamless(normals: Array, tubes: list[Tube]) -> Array:
    """Give the first and the last column of each tube, which are the same points, the same normal."""
    out, offset = normals.copy(), 0
    for tube in tubes:
        rows, columns = tube.vertices.shape[:2]
        part = out[offset : offset + rows * columns].reshape(rows, columns, 3)
        mean = part[:, 0] + part[:, -1]
        part[:, 0] = part[:, -1] = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        offset += rows * columns
    return out


def _lamps(line: Line, spacing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    if spacing <= 0:
        return np.zeros((0, 3)), np.zeros(0)
    k = np.searchsorted(line.s, np.arange(4.0, line.s[-1] - 4.0, spacing))
    side = rng.uniform(-0.8, 0.8, len(k))
    positions = line.points[k] + 1.35 * line.up[k] + side[:, None] * line.left[k]
    return positions, rng.uniform(0.6, 1.5, len(k))

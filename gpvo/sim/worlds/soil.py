"""The texture of lunar soil: most energy at wavelengths of 1 to 15 cm, in the light of a low sun."""

from __future__ import annotations

import numpy as np

from gpvo.sim.worlds.noise import F32, spectral
from gpvo.sim.worlds.stone import Cells, Texture, blurred, enlarged, finished
from gpvo.types import Array

_LEAST_SLOPE = 0.35  # a sun nearer to the horizon than 20 degrees would leave nothing but black


def regolith(n: int, rng: np.random.Generator, sun: Array, tile_m: float) -> Texture:
    """Dust, clods, pebbles and small craters on a tile of ``tile_m``; ``sun``: unit vector towards it, x along u."""
    height = 0.004 * spectral(n, rng, 1.7, 3, 60) + 0.0007 * spectral(n, rng, 1.0, 20, 260)
    for diameter_m, share in ((0.26, 0.3), (0.14, 0.5), (0.08, 0.5), (0.04, 0.45)):
        height += _pits(n, diameter_m / tile_m, share, rng) * tile_m
    stones, tone = np.zeros((n, n), np.float32), np.zeros((n, n), np.float32)
    for width_m, share in ((0.12, 0.12), (0.07, 0.3), (0.04, 0.5), (0.02, 0.5)):
        bump, shade = _pebbles(n, width_m / tile_m, share, rng)
        stones = np.maximum(stones, bump * tile_m)
        tone = np.where(bump > 0, shade, tone)
    height = blurred(height + stones, 0.6)
    grey = 0.5 + 0.06 * tone + 0.035 * spectral(n, rng, 1.0, 3) + 0.025 * spectral(n, rng, 0.3, n / 20)
    return finished(grey * _sunlit(height / tile_m, sun), 0.43, 0.135)


def _pits(n: int, width: float, share: float, rng: np.random.Generator) -> F32:
    """Small craters, some of them worn; heights in tiles."""
    cells = Cells(n // 2, round((1.6 / width) ** 2 / 4), rng)
    size = rng.uniform(0.15, 0.42, cells.number).astype(np.float32) * (rng.random(cells.number) < share)
    fresh = rng.uniform(0.2, 1.0, cells.number).astype(np.float32)
    radius = np.maximum(size[cells.owner], 1e-6)
    q = cells.nearest / radius
    bowl = np.where(q < 1, 0.22 * q**2 - 0.18, 0.04 * np.exp(-4 * (q - 1)))
    profile = np.where(size[cells.owner] > 0, bowl * radius * fresh[cells.owner], 0.0)
    return enlarged((profile / cells.per_side).astype(np.float32), n)


def _pebbles(n: int, width: float, share: float, rng: np.random.Generator) -> tuple[F32, F32]:
    """Half-buried pebbles: heights in tiles, and a shade for each."""
    cells = Cells(n // 2, round((1.0 / width) ** 2), rng)
    size = rng.uniform(0.10, 0.34, cells.number).astype(np.float32) * (rng.random(cells.number) < share)
    angle, flat = rng.uniform(0, np.pi, cells.number), rng.uniform(0.55, 1.0, cells.number)
    own = cells.owner
    c, s = np.cos(angle).astype(np.float32)[own], np.sin(angle).astype(np.float32)[own]
    along, across = cells.x * c + cells.y * s, (cells.y * c - cells.x * s) / flat.astype(np.float32)[own]
    radius = np.maximum(size[own], 1e-6)
    dome = np.sqrt(np.clip(1 - (along**2 + across**2) / radius**2, 0, 1)) * 0.8 * radius * (size[own] > 0)
    shade = rng.standard_normal(cells.number).astype(np.float32)[own]
    return enlarged((dome / cells.per_side).astype(np.float32), n), enlarged(shade, n)


def _sunlit(height: F32, sun: Array) -> F32:
    """Brightness of a relief [tiles], 1 where it is level, with the shadows that its bumps cast."""
    n = len(height)
    across = np.hypot(sun[0], sun[1])
    slope = max(float(sun[2] / max(across, 1e-9)), _LEAST_SLOPE)
    east, north = (float(sun[k]) / max(across, 1e-9) for k in (0, 1))
    gx = 0.5 * n * (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1))
    gy = 0.5 * n * (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0))
    facing = (slope - east * gx - north * gy) / (slope * np.sqrt(1 + gx * gx + gy * gy))
    light = np.clip(facing, 0.12, 1.9)
    shadow = np.zeros_like(height)
    for step in (2, 4, 6, 9, 13, 18, 24, 32):
        ahead = np.roll(height, (-round(step * north), -round(step * east)), axis=(0, 1))
        shadow = np.maximum(shadow, np.clip((ahead - height - step / n * slope) * n / 1.5, 0, 1))
    return light * (1 - 0.8 * blurred(shadow.astype(np.float32), 0.8))

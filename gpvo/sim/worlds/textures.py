"""Textures, tileable and grey (uint8). Their square is the albedo."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpvo.sim.worlds.noise import F32, cellular, spectral

Texture = NDArray[np.uint8]


def encode(grey: NDArray[np.floating]) -> Texture:
    """Grey values 0..1 to 8 bit, kept off the ends."""
    return (np.clip(grey, 0.04, 0.97) * 255 + 0.5).astype(np.uint8)


def _slope(height: F32, along_x: float, along_y: float) -> F32:
    gx = np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)
    gy = np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)
    return along_x * gx + along_y * gy


def _stretch(image: F32, factor: int) -> F32:
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)


def rock(n: int, rng: np.random.Generator) -> Texture:
    """Broken rock: facets in relief, fine cracks, grain and specks."""
    half = n // 2
    relief = np.zeros((n, n), np.float32)
    for cells, weight in ((160, 1.0), (900, 0.55), (6000, 0.25)):
        distance, owner = cellular(half, cells, rng, 2)
        tilt = rng.standard_normal((cells, 2)).astype(np.float32)
        facet = tilt[owner[..., 0], 0] * 0.5
        crack = np.exp(-(((distance[..., 1] - distance[..., 0]) * np.sqrt(cells) / 0.06) ** 2))
        relief += weight * _stretch(facet - 0.9 * crack, 2)
    wobble = [(spectral(n, rng, 1.3, 3) * n * 0.006).astype(np.int32) for _ in range(2)]
    rows, columns = np.arange(n)[:, None] + wobble[0], np.arange(n)[None] + wobble[1]
    relief = relief[rows % n, columns % n]
    rough = spectral(n, rng, 1.0, 4)
    lit = np.clip(_slope(rough, 0.8, 1.1), -2, 2)
    grey = 0.42 + 0.065 * relief + 0.05 * rough + 0.05 * lit + 0.05 * spectral(n, rng, 0.5, n / 48)
    grey += 0.04 * spectral(n, rng, 1.4, 2)
    specks = cellular(half, 4000, rng, 1)[0][..., 0] < 0.0035
    return encode(grey + _stretch(specks.astype(np.float32), 2) * 0.16 * np.sign(rough))


def shotcrete(n: int, rng: np.random.Generator) -> Texture:
    """Sprayed concrete, nearly without features."""
    return encode(0.5 + 0.012 * spectral(n, rng, 1.6, 1) + 0.004 * spectral(n, rng, 0.3, n / 32))


def regolith(n: int, rng: np.random.Generator) -> Texture:
    """Lunar soil for tiles of 2.5 m: most energy at wavelengths of 1 to 15 cm, pebbles lit from one side."""
    grey = 0.42 + 0.05 * spectral(n, rng, 0.9, 2) + 0.07 * spectral(n, rng, 0.6, 18, 160)
    grey += 0.03 * spectral(n, rng, 0.2, n / 16)
    height = np.zeros((n, n), np.float32)
    for radius, count in ((16.0, 90), (10.0, 350), (6.0, 1400), (3.5, 5000)):
        for _ in range(count):
            _pebble(height, grey, radius * n / 2048, rng)
    relief = np.clip(0.5 * _slope(height, 1.0, 0.0), -1.5, 1.5)
    return encode(grey * (1 + 0.45 * relief))


def _pebble(height: F32, grey: F32, radius: float, rng: np.random.Generator) -> None:
    n = len(height)
    radius *= rng.uniform(0.7, 1.4)
    reach = int(radius * 1.5) + 1
    row, column = rng.integers(0, n, 2)
    angle, flat = rng.uniform(0, np.pi), rng.uniform(0.6, 1.0)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float32)
    along, across = x * np.cos(angle) + y * np.sin(angle), (y * np.cos(angle) - x * np.sin(angle)) / flat
    bump = np.sqrt(np.clip(1 - (along**2 + across**2) / radius**2, 0, 1)) * np.float32(radius)
    where = np.ix_(np.arange(row - reach, row + reach + 1) % n, np.arange(column - reach, column + reach + 1) % n)
    height[where] = np.maximum(height[where], bump)
    grey[where] += (bump > 0) * np.float32(rng.normal(0, 0.06))


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

"""Textures, tileable and grey (uint8), whose square is the albedo. Made from noise (spectral on a torus, lattice noise
in space) and cells: concrete and sheet, broken rock, gravel, and lunar soil in the light of a low sun.
"""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array

F32 = NDArray[np.float32]
Texture = NDArray[np.uint8]
_LATTICE = 64
_PAD = 8
_LEAST_SLOPE = 0.35  # a sun nearer to the horizon than 20 degrees would leave nothing but black


def spectral(n: int, rng: np.random.Generator, beta: float, lowest: float = 1.0, highest: float | None = None) -> F32:
    """Tileable (n, n) noise with amplitude spectrum ``f^-beta`` from ``lowest`` to about ``highest`` cycles per tile.

    Mean 0, standard deviation 1.
    """
    wave = np.fft.rfft2(rng.standard_normal((n, n)).astype(np.float32))
    f = np.hypot(np.fft.fftfreq(n)[:, None] * n, np.fft.rfftfreq(n)[None] * n)
    gain = np.where(f >= lowest, np.maximum(f, 1.0) ** -beta, 0.0)
    if highest is not None:
        gain = gain * np.exp(-((f / highest) ** 2))
    x = np.fft.irfft2(wave * gain, s=(n, n))
    return ((x - x.mean()) / x.std()).astype(np.float32)


def lattice(rng: np.random.Generator) -> F32:
    """Random values for :func:`fractal`."""
    return rng.standard_normal((_LATTICE,) * 3).astype(np.float32)


def _value_noise(points: Array, values: F32) -> Array:
    """At ``points`` (3, N)."""
    cell = np.floor(points).astype(np.int64)
    f = points - cell
    f = f**3 * (f * (f * 6 - 15) + 10)
    shares = (1 - f, f)
    # Where along a flat lattice the near and the far neighbour of each axis lie.
    steps = np.array([[_LATTICE**2], [_LATTICE], [1]])
    places = (cell % _LATTICE * steps, (cell + 1) % _LATTICE * steps)
    flat, out = values.ravel(), np.zeros(points.shape[1])
    for a, b, c in np.ndindex(2, 2, 2):
        weight = shares[a][0] * shares[b][1] * shares[c][2]
        out += weight * flat.take(places[a][0] + places[b][1] + places[c][2])
    return out


def fractal(points: Array, values: F32, octaves: int = 4, gain: float = 0.5) -> Array:
    """Sum of octaves of smooth lattice noise at points (N, 3); the lowest has a wavelength of about 2 units."""
    out, amplitude, p = np.zeros(len(points)), 1.0, np.ascontiguousarray(points.T, dtype=np.float64)
    for octave in range(octaves):
        out += amplitude * _value_noise(p + 17.3 * octave, values)
        p, amplitude = p * 2.03, amplitude * gain
    return out


def encode(grey: NDArray[np.floating]) -> Texture:
    """Grey values 0..1 to 8 bit, kept off the ends."""
    return (np.clip(grey, 0.04, 0.97) * 255 + 0.5).astype(np.uint8)


def shotcrete(n: int, rng: np.random.Generator) -> Texture:
    """Sprayed concrete, nearly without features."""
    return encode(0.5 + 0.012 * spectral(n, rng, 1.6, 1) + 0.004 * spectral(n, rng, 0.3, n / 32))


def duct(n: int, rng: np.random.Generator) -> Texture:
    """Dusty sheet and painted steel: rings, stains and scratches."""
    v = np.arange(n) / n
    rings = 0.05 * np.sin(2 * np.pi * 10 * v) - 0.18 * (np.abs((v * 5) % 1 - 0.5) > 0.485)
    stains = 0.07 * spectral(n, rng, 1.2, 2) + 0.02 * spectral(n, rng, 0.4, 20)
    scratches = np.clip(spectral(n, rng, 0.9, 8) - 2.2, 0, 1)
    return encode(0.52 + rings[:, None] + stains + 0.25 * scratches)


def enlarged(image: F32, n: int, shift_x: F32 | float = 0.0, shift_y: F32 | float = 0.0) -> F32:
    """A tileable image (m, m) at (n, n) points, each moved by a shift in units of the tile."""
    m = len(image)
    grid = ((np.arange(n, dtype=np.float32) + np.float32(0.5)) / np.float32(n))[None]
    x, y = (grid + shift_x) % 1.0 * m - 0.5, (grid.T + shift_y) % 1.0 * m - 0.5
    x, y = np.broadcast_to(x, (n, n)), np.broadcast_to(y, (n, n))
    padded = np.pad(image, _PAD, mode="wrap")
    return cv2.remap(padded, (x + _PAD).astype(np.float32), (y + _PAD).astype(np.float32), cv2.INTER_LINEAR)


def blurred(image: F32, sigma_px: float) -> F32:
    """A tileable image smoothed by a Gaussian."""
    pad = int(4 * sigma_px) + 1
    padded = np.pad(image, pad, mode="wrap")
    return cv2.GaussianBlur(padded, (0, 0), sigma_px)[pad:-pad, pad:-pad]


class Cells:
    """Cells about jittered points, ``count`` to a tile (S. Worley, "A cellular texture basis function", 1996).

    For each of n x n pixels: ``owner`` (0 .. ``number`` - 1), its offset ``x, y`` from the owner's point, the distances
    ``nearest`` and ``second``, all in widths of a cell, of which there are ``per_side`` along a tile.
    """

    def __init__(self, n: int, count: int, rng: np.random.Generator) -> None:
        self.per_side = k = max(int(np.sqrt(count)), 3)
        self.number = k * k
        points = rng.random((k, k, 2)).astype(np.float32)
        place = (np.arange(n, dtype=np.float32) + np.float32(0.5)) / n * k
        cell = np.floor(place).astype(np.int64)
        self.nearest, self.second = (np.full((n, n), 9, np.float32) for _ in range(2))
        self.owner = np.zeros((n, n), np.int64)
        self.x, self.y = np.zeros((n, n), np.float32), np.zeros((n, n), np.float32)
        for j, i in product((-1, 0, 1), repeat=2):
            row, column = (cell + j) % k, (cell + i) % k
            point = points[row[:, None], column[None]]
            x = (place - cell - i)[None].astype(np.float32) - point[..., 0]
            y = (place - cell - j)[:, None].astype(np.float32) - point[..., 1]
            square = x * x + y * y
            closer = square < self.nearest
            self.second = np.where(closer, self.nearest, np.minimum(self.second, square))
            owner = row[:, None] * k + column[None]
            for kept, value in ((self.nearest, square), (self.x, x), (self.y, y), (self.owner, owner)):
                np.copyto(kept, value, where=closer)
        self.nearest, self.second = np.sqrt(self.nearest), np.sqrt(self.second)


def rock(n: int, rng: np.random.Generator) -> Texture:
    """A blasted rock face for tiles of 3 m, lit mostly from the camera and a little from one side."""
    half = n // 2
    relief, tone, crack = (np.zeros((n, n), np.float32) for _ in range(3))
    slow = [enlarged(spectral(n // 4, rng, 1.5, 3), n) for _ in range(2)]
    quick = [enlarged(spectral(half, rng, 1.0, 20), n) for _ in range(2)]
    for count, height, contrast, depth in ((45, 0.034, 0.06, 0.5), (300, 0.016, 0.05, 0.45), (2500, 0.005, 0.04, 0.3)):
        cells = Cells(half, count, rng)
        width = 1.0 / cells.per_side
        shift = [0.16 * width * a + 0.05 * width * b for a, b in zip(slow, quick)]
        tilt = rng.standard_normal((3, cells.number)).astype(np.float32)
        own = cells.owner
        relief += height * enlarged(tilt[0, own] * cells.x + tilt[1, own] * cells.y + 0.35 * tilt[2, own], n, *shift)
        is_open = (rng.random(cells.number) < 0.6)[own]
        border = np.exp(-(((cells.second - cells.nearest) / 0.05) ** 2)) * is_open
        crack += depth * enlarged(border.astype(np.float32), n, *shift)
        tone += contrast * enlarged(rng.standard_normal(cells.number).astype(np.float32)[own], n, *shift)
    relief += 0.008 * spectral(n, rng, 1.35, 3) + 0.0008 * spectral(n, rng, 0.8, 40) - 0.006 * crack
    relief = blurred(relief, 0.7)
    hollow = np.clip((relief - blurred(relief, 12.0)) / 0.006, -1.5, 1.2)
    grain = spectral(n, rng, 0.35, n / 24)
    vein = enlarged(np.exp(-((spectral(half, rng, 1.9, 2) / 0.03) ** 2)).astype(np.float32), n)
    albedo = 0.74 + 1.2 * tone + 0.06 * spectral(n, rng, 1.2, 2) + 0.035 * grain + 0.07 * hollow + 0.2 * vein
    return finished(albedo * _lit(relief, n) - 0.12 * np.clip(crack, 0, 1), 0.42, 0.145)


def gravel(n: int, rng: np.random.Generator) -> Texture:
    """A trodden floor of crushed stone and mud for tiles of 3 m."""
    half = n // 2
    relief, tone = (np.zeros((n, n), np.float32) for _ in range(2))
    slow = [enlarged(spectral(half, rng, 1.0, 30), n) for _ in range(2)]
    for count, height, share in ((1225, 0.018, 0.4), (4900, 0.010, 0.7), (19600, 0.005, 0.9)):
        cells = Cells(half, count, rng)
        width = 1.0 / cells.per_side
        shift = [0.10 * width * a for a in slow]
        size = rng.uniform(0.5, 1.1, cells.number).astype(np.float32) * (rng.random(cells.number) < share)
        tilt = 0.35 * rng.standard_normal((2, cells.number)).astype(np.float32)
        own = cells.owner
        edge = np.clip(1 - cells.nearest / np.maximum(cells.second, 1e-3), 0, 1) * size[own]
        stone = np.sqrt(edge) * (1 + tilt[0, own] * cells.x + tilt[1, own] * cells.y)
        relief = np.maximum(relief, height * enlarged(stone.astype(np.float32), n, *shift))
        tone += 0.06 * enlarged((rng.standard_normal(cells.number) * (size > 0)).astype(np.float32)[own], n, *shift)
    mud = np.clip(0.5 + 0.5 * spectral(n, rng, 1.4, 2), 0, 1)
    relief = relief * (1 - 0.7 * mud) + 0.0012 * spectral(n, rng, 1.2, 6) + 0.0003 * spectral(n, rng, 0.7, 60)
    relief = blurred(relief, 0.7)
    hollow = np.clip((relief - blurred(relief, 8.0)) / 0.003, -1.5, 1.2)
    albedo = 0.72 + tone * (1 - 0.6 * mud) - 0.10 * mud + 0.05 * hollow + 0.03 * spectral(n, rng, 0.4, n / 24)
    return finished(albedo * _lit(relief, n), 0.40, 0.125)


def _lit(relief: F32, n: int) -> F32:
    """Brightness of a relief [tiles] of about a third of its slope, from in front and from one side."""
    gx, gy = (0.33 * 0.5 * n * (np.roll(relief, -1, axis) - np.roll(relief, 1, axis)) for axis in (1, 0))
    facing = 1 / np.sqrt(1 + gx * gx + gy * gy)
    return np.clip((0.78 + 0.42 * gy + 0.18 * gx) * facing, 0.08, 1.6)


def finished(grey: F32, mean: float, deviation: float) -> Texture:
    """To 8 bit with a given mean and standard deviation."""
    scaled = mean + deviation * (grey - grey.mean()) / grey.std()
    return (np.clip(scaled, 0.03, 0.98) * 255 + 0.5).astype(np.uint8)


def regolith(n: int, rng: np.random.Generator, sun: Array, tile_m: float) -> Texture:
    """Dust, clods, pebbles and small craters on a tile of ``tile_m``, most of its energy at wavelengths of 1 to 15 cm;
    ``sun``: unit vector towards it, x along u."""
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
    gx, gy = (0.5 * n * (np.roll(height, -1, axis) - np.roll(height, 1, axis)) for axis in (1, 0))
    facing = (slope - east * gx - north * gy) / (slope * np.sqrt(1 + gx * gx + gy * gy))
    light = np.clip(facing, 0.12, 1.9)
    shadow = np.zeros_like(height)
    for step in (2, 4, 6, 9, 13, 18, 24, 32):
        ahead = np.roll(height, (-round(step * north), -round(step * east)), axis=(0, 1))
        shadow = np.maximum(shadow, np.clip((ahead - height - step / n * slope) * n / 1.5, 0, 1))
    return light * (1 - 0.8 * blurred(shadow.astype(np.float32), 0.8))

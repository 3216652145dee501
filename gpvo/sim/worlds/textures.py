"""Textures, tileable and grey (uint8). Their square is the albedo. Made from noise: spectral on a torus, lattice
noise in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array

F32 = NDArray[np.float32]
_LATTICE = 64


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


Texture = NDArray[np.uint8]


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

"""Noise to make surfaces from: spectral on a torus, lattice noise in space."""

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

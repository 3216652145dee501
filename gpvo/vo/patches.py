"""The last step of every search: a patch is found again as the picture of a small plane, not of a moving square.

Lucas and Kanade's search moves a square of the image until it fits. But what is seen from nearer is larger, and in the
other camera it is sheared, so that the square which fits best is off by as much as the texture lies off its middle:
some hundredths of a pixel, and on ground that comes near always to the same side. Here the patch deforms as its plane
does. The plane's slope in disparity is estimated with the disparity, and its deformation by the motion follows from
the motion that is expected (J. Shi, C. Tomasi, "Good features to track", 1994, section 3, with the deformation known;
S. Baker, I. Matthews, "Lucas-Kanade 20 years on", 2004, section 3.2: the inverse compositional step). Grey values are
compared less their mean: what is brighter as a whole has not moved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array
from gpvo.vo.opencv import Image, Points

Patches = NDArray[np.float32]
_STEPS = 3  # at most: the search before ends within a tenth of a pixel
_CLOSE_PX = 0.03  # a step this small leaves an error of a tenth of it
_FARTHEST_PX = 1.0  # from where that search ended: beyond, the step has followed something else
_GREY = 4.0  # standard deviation of a grey value
_SLOPE = 0.3  # of a plane's disparity per pixel, as seen before anything is measured: a level road has about as much
_ALIKE = 0.9  # difference of two patches of one thing over what varies within; those of noise have 1.1 to 1.4


@dataclass(frozen=True)
class Aligned:
    """Where patches were found: ``uv`` (N, 2) [px], how they are deformed there, ``A`` (N, 2, 2), and which of them
    look like what was sought, ``alike`` (N,).

    In noise a search succeeds wherever it starts. But two patches of noise differ by more than varies within each: at a
    correlation of r, the variance of the difference is ``2 (1 - r)`` times that.
    """

    uv: Points
    A: Array
    alike: NDArray[np.bool_]


def cut(image: Image, uv: Points, window_px: int) -> Patches:
    """Patches (N, 3, M) around points (N, 2): the grey values less their mean, and their derivatives by u and v, of M
    pixels each.

    Between pixels by bilinear interpolation.
    """
    h, w = image.shape
    whole = np.floor(uv).astype(np.intp)
    a, b = (uv - whole).astype(np.float32).T[:, :, None]
    half, size = (window_px - 1) // 2, window_px + 3
    offset = np.arange(-half - 1, size - half - 1)
    column = np.clip(whole[:, :1] + offset, 0, w - 1)
    row = np.clip(whole[:, 1:] + offset, 0, h - 1) * w
    grey = image.ravel().take(row[:, :, None] + column[:, None, :], mode="wrap").astype(np.float32)
    # Pixel after pixel, from the end of each row on to the next one, whose last columns are not used: rows are short.
    flat = grey.reshape(len(uv), size**2)
    for part, step in ((a, 1), (b, size)):
        change = flat[:, step:] - flat[:, :-step]
        change *= part
        flat[:, :-step] += change
    out = np.empty((len(uv), 3, window_px, window_px), np.float32)
    out[:, 0] = grey[:, 1:-2, 1:-2]
    grey *= 0.5
    np.subtract(grey[:, 1:-2, 2:-1], grey[:, 1:-2, :-3], out=out[:, 1])
    np.subtract(grey[:, 2:-1, 1:-2], grey[:, :-3, 1:-2], out=out[:, 2])
    patches = out.reshape(len(uv), 3, window_px**2)
    patches[:, 0] -= patches[:, 0].mean(axis=1, keepdims=True)
    return patches


def stands_out(patches: Patches, noise: float) -> NDArray[np.bool_]:
    """(N,) which patches (N, 3, M), as of :func:`cut`, vary enough beside ``noise``, its standard deviation [grey
    values], to be recognised in another image with as much."""
    return np.asarray(2 * noise**2 < _ALIKE**2 * np.square(patches[:, 0]).mean(axis=1))


def align(patches: Patches, image: Image, start: Points, A: Array, h: Array | None = None) -> Aligned:
    """Patches (N, 3, M), as of :func:`cut`, found in another image near ``start`` (N, 2), deformed by ``A`` (N, 2, 2).

    A pixel at ``o`` from the middle of the patch is seen at ``uv + A o / (1 + h o)``, with ``h`` (N, 2) the growth of
    depth over the patch. None for a pair's other camera, where each row of a patch moves along itself: then the first
    row of ``A`` is estimated as well.
    """
    sheared, size = h is None, math.isqrt(patches.shape[2])
    xy = np.indices((size, size), np.float32)[::-1].reshape(2, size**2) - (size - 1) // 2
    sought, D = patches[:, 0], patches[:, 1:]
    if sheared:
        D = np.concatenate([D, D[:, :1] * xy], axis=1)
    prior = np.array([1e-3, 1e-3] + [(_GREY / _SLOPE) ** 2] * 2 * sheared)
    # Of the derivatives, only what varies over the patch counts; times a misfit without mean, it alone does anyhow.
    mean = D.mean(axis=2)[:, :, None]
    H = (D @ D.transpose(0, 2, 1) - size**2 * mean * mean.transpose(0, 2, 1)).astype(np.float64)
    gain = np.linalg.inv(H + np.diag(prior))
    # Half the depth within a patch is no plane but a wrong slope.
    nearer = None if h is None else 1.0 / np.maximum(1.0 + h.astype(np.float32) @ xy, np.float32(0.5))
    uv, A, apart = start.astype(np.float64), A.copy(), np.abs(sought).mean(axis=1)
    limit, going = _ALIKE * apart, np.arange(len(patches))
    for _ in range(_STEPS):
        misfit = _sampled(image, uv[going], A[going], xy, nearer)
        misfit -= misfit.mean(axis=1, keepdims=True)
        misfit -= sought
        r = (D @ misfit[:, :, None])[:, :, 0].astype(np.float64)
        apart[going] = np.abs(misfit, out=misfit).mean(axis=1)
        if sheared:
            r[:, 2:] += prior[2:] * (A[going, 0] - (1.0, 0.0))
        step = np.clip((gain @ r[:, :, None])[:, :, 0], -1.0, 1.0)
        uv[going] -= (A[going] @ step[:, :2, None])[:, :, 0]
        if sheared:
            A[going, 0] -= step[:, 2:]
        step[:, 2:] *= size / 4
        far = np.abs(step).max(axis=1, initial=0.0) > _CLOSE_PX
        if not far.any():
            break
        going, D, gain, sought = going[far], D[far], gain[far], sought[far]
        nearer = None if nearer is None else nearer[far]
    alike = (apart < limit) & (np.abs(uv - start).max(axis=1, initial=0.0) < _FARTHEST_PX)
    return Aligned(uv.astype(np.float32), A, alike)


def _sampled(image: Image, uv: Array, A: Array, xy: Patches, nearer: Patches | None = None) -> NDArray[np.float32]:
    """(N, M) grey values at ``uv + A xy nearer``, by bilinear interpolation; OpenCV's rounds to 1/32 of a pixel."""
    h, w = image.shape
    at, parts = np.zeros(1, np.int32), []
    for k, size, stride in ((0, w, 1), (1, h, w)):
        u = A[:, k].astype(np.float32) @ xy
        if nearer is not None:
            u *= nearer
        u += uv[:, k : k + 1].astype(np.float32)
        np.clip(u, 0.0, size - 1.001, out=u)
        whole = np.floor(u)
        u -= whole
        at = at + whole.astype(np.int32) * stride
        parts.append(u)
    (u, v), flat, at = parts, image.ravel(), at.astype(np.intp)
    # Nothing is out of range; to wrap is the fastest way not to look.
    a, b, c, d = (flat[k:].take(at, mode="wrap").astype(np.float32) for k in (0, 1, w, w + 1))
    b -= a
    b *= u
    b += a
    d -= c
    d *= u
    d += c
    d -= b
    d *= v
    d += b
    return d

"""The light that reaches each pixel: numba kernels for texture, lamps and dust."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gpvo.sim.render.raster import OPTIONS

f4 = np.float32
# Columns of a triangle's table: what is linear over it, against the ray; then constants.
U, V, LIGHT, U0, V0, TAP_U, TAP_V, START, SIZE, TAPS = 0, 3, 6, 9, 10, 11, 12, 13, 14, 15
COLUMNS = 16


@njit(**OPTIONS)
def _vertex_light(v, vertices, P, axis, lights):
    """Radiance factor of a vertex: ambient and baked light, and a lamp at the camera that shines forward."""
    x, y, z = P[0] - vertices[v, 0], P[1] - vertices[v, 1], P[2] - vertices[v, 2]
    square = x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(max(square, 1e-12))
    facing = max((vertices[v, 3] * x + vertices[v, 4] * y + vertices[v, 5] * z) * inverse, 0.0)
    forward = -(axis[0] * x + axis[1] * y + axis[2] * z) * inverse
    beam = min(max((forward - 0.30) / 0.65, 0.0), 1.0)
    beam = beam * beam * (3.0 - 2.0 * beam)
    return vertices[v, 9] * (lights[0] + vertices[v, 8] + lights[1] * beam * facing / (0.15 + square))


@njit(**OPTIONS)
def _prepare(t, rows, corner, vertices, R, P, lights, rays, width, plane, reach, texture, most_taps, table, integers):
    """Fill the table of one triangle."""
    i, j, k = corner[t, 0], corner[t, 1], corner[t, 2]
    axis = R[2]
    La = _vertex_light(i, vertices, P, axis, lights)
    Lb = _vertex_light(j, vertices, P, axis, lights) - La
    Lc = _vertex_light(k, vertices, P, axis, lights) - La
    ub, uc = vertices[j, 6] - vertices[i, 6], vertices[k, 6] - vertices[i, 6]
    vb, vc = vertices[j, 7] - vertices[i, 7], vertices[k, 7] - vertices[i, 7]
    for a in range(3):
        s, b, c = rows[t, a], rows[t, 3 + a], rows[t, 6 + a]
        table[t, U + a] = ub * b + uc * c
        table[t, V + a] = vb * b + vc * c
        table[t, LIGHT + a] = f4(La) * s + f4(Lb) * b + f4(Lc) * c
    # Whole tiles are taken off for the sake of precision; a few are left so that no coordinate is negative.
    table[t, U0] = vertices[i, 6] - f4(math.floor(vertices[i, 6])) + f4(2)
    table[t, V0] = vertices[i, 7] - f4(math.floor(vertices[i, 7])) + f4(2)
    size, level_start = texture
    level, taps = _footprint(t, rows, vertices, i, j, k, R, P, rays, width, plane, reach, size, most_taps, table)
    # The blend between levels happens in the middle half of each step: half of the pixels need one level only.
    last = level_start.shape[1] - 2
    level = min(max(level, f4(0)), f4(last + 1))
    low = min(int(level), last)
    blend = min(max((level - f4(low)) * f4(2) - f4(0.5), f4(0)), f4(1))
    if blend == f4(1):
        low, blend = low + 1, f4(0)
    integers[t, START] = level_start[corner[t, 3], low]
    table[t, SIZE] = f4(size >> low)
    table[t, TAPS] = f4(taps) + f4(0.5) * blend


@njit(**OPTIONS)
def _footprint(t, rows, vertices, i, j, k, R, P, rays, width, plane, reach, size, most_taps, table):
    """Level of detail and the taps along the longer axis of a pixel's shadow on the texture, at the centroid.

    P. Heckbert, "Fundamentals of texture mapping and image warping" (1989), section 3.5.8, for the ellipse.
    """
    x = (np.float64(vertices[i, 0]) + vertices[j, 0] + vertices[k, 0]) / 3.0 - P[0]
    y = (np.float64(vertices[i, 1]) + vertices[j, 1] + vertices[k, 1]) / 3.0 - P[1]
    z = (np.float64(vertices[i, 2]) + vertices[j, 2] + vertices[k, 2]) / 3.0 - P[2]
    d = math.sqrt(x * x + y * y + z * z)
    X = f4((R[0, 0] * x + R[0, 1] * y + R[0, 2] * z) / d)
    Y = f4((R[1, 0] * x + R[1, 1] * y + R[1, 2] * z) / d)
    Z = f4((R[2, 0] * x + R[2, 1] * y + R[2, 2] * z) / d)
    grid = plane.shape[0] - 1
    w = f4(1) / max(Z + f4(1), f4(1e-6))
    gx = min(max(int(f4(0.5) * (X * w / reach[0] + f4(1)) * f4(grid) + f4(0.5)), 0), grid)
    gy = min(max(int(f4(0.5) * (Y * w / reach[1] + f4(1)) * f4(grid) + f4(0.5)), 0), grid)
    px = min(max(int(plane[gy, gx, 0]), 0), width - 2)
    py = min(max(int(plane[gy, gx, 1]), 0), rays.shape[0] - 2)
    table[t, TAP_U], table[t, TAP_V] = f4(0), f4(0)
    s = rows[t, 0] * X + rows[t, 1] * Y + rows[t, 2] * Z
    norm = rays[py, 2, px + 1] * rays[py, 2, px] * rays[py + 1, 2, px]
    if s <= 0 or norm == 0:
        return f4(0), 1
    turn = f4(1) / s
    u = (table[t, U] * X + table[t, U + 1] * Y + table[t, U + 2] * Z) * turn
    v = (table[t, V] * X + table[t, V + 1] * Y + table[t, V + 2] * Z) * turn
    qa = qb = qc = f4(0)
    for step in range(2):
        yn, xn = (py, px + 1) if step == 0 else (py + 1, px)
        dx = rays[yn, 0, xn] - rays[py, 0, px]
        dy = rays[yn, 1, xn] - rays[py, 1, px]
        dz = rays[yn, 2, xn] - rays[py, 2, px]
        ds = rows[t, 0] * dx + rows[t, 1] * dy + rows[t, 2] * dz
        du = (table[t, U] * dx + table[t, U + 1] * dy + table[t, U + 2] * dz - ds * u) * turn
        dv = (table[t, V] * dx + table[t, V + 1] * dy + table[t, V + 2] * dz - ds * v) * turn
        qa += du * du
        qb += du * dv
        qc += dv * dv
    mean, half = f4(0.5) * (qa + qc), f4(0.5) * (qa - qc)
    root = f4(math.sqrt(half * half + qb * qb))
    long, short = mean + root, max(mean - root, (mean + root) * f4(1e-4))
    taps = min(max(int(f4(math.sqrt(long / short)) + f4(0.5)), 1), most_taps)
    eu, ev = (long - qc, qb) if qa >= qc else (qb, long - qa)
    length = f4(math.sqrt(eu * eu + ev * ev))
    if taps > 1 and length > 0:
        stretch = f4(math.sqrt(long)) / length
        table[t, TAP_U], table[t, TAP_V] = eu * stretch, ev * stretch
    else:
        taps = 1
    level = f4(0.5) * f4(math.log2(long * f4(size * size) / f4(taps * taps) + f4(1e-9)))
    return level, taps


@njit(**OPTIONS)
def _bilinear(texels, start, size, u, v):
    """Texture value 0..255, repeated; each texel also holds its right and lower neighbours."""
    x, y = u * size - f4(0.5), v * size - f4(0.5)
    i, j = np.int32(x), np.int32(y)
    across, down = x - f4(i), y - f4(j)
    whole = np.int32(size)
    four = texels[start + (j & (whole - 1)) * whole + (i & (whole - 1))]
    a, b = f4(four & 255), f4((four >> 8) & 255)
    c, d = f4((four >> 16) & 255), f4(four >> 24)
    upper, lower = a + (b - a) * across, c + (d - c) * across
    return upper + (lower - upper) * down


@njit(**OPTIONS)
def _texture(t, table, integers, texels, u, v):
    """Texture value 0..255 of triangle ``t``: taps along the longer axis of the footprint, of one or two levels."""
    taps = int(table[t, TAPS])
    start, size = np.int64(integers[t, START]), table[t, SIZE]
    step, blend = f4(1) / f4(taps), (table[t, TAPS] - f4(taps)) * f4(2)
    total = f4(0)
    for k in range(taps):
        along = (f4(k) + f4(0.5)) * step - f4(0.5)
        at_u, at_v = u + along * table[t, TAP_U], v + along * table[t, TAP_V]
        total += _bilinear(texels, start, size, at_u, at_v) * (step * (blend * f4(-1) + f4(1)))
        if blend > 0:
            next_start = start + np.int64(size) * np.int64(size)
            total += _bilinear(texels, next_start, size * f4(0.5), at_u, at_v) * (step * blend)
    return total


@njit(**OPTIONS)
def shade(
    inverse, owner, rows, corner, vertices, texels, texture, R, P, lights, rays, width, plane, reach, most_taps,
    table, integers, radiance, depth, y_first, y_last,
):  # fmt: skip
    """Radiance and depth of the rows ``y_first`` to ``y_last`` (exclusive) from the visibility buffer.

    ``lights``: ambient, head lamp. ``table`` (T, 16) float32, ``integers`` the same memory as
    int32; a row whose TAPS are 0 is not filled yet.
    """
    for y in range(y_first, y_last):
        for x in range(width):
            t = np.int64(owner[y, x])
            if t == 0:
                radiance[y, x], depth[y, x] = f4(0), f4(np.nan)
                continue
            if table[t, TAPS] == 0:
                _prepare(
                    t, rows, corner, vertices, R, P, lights, rays, width, plane, reach, texture, most_taps, table,
                    integers,
                )  # fmt: skip
            rx, ry, rz = rays[y, 0, x], rays[y, 1, x], rays[y, 2, x]
            distance = f4(1) / max(inverse[y, x], f4(1e-9))
            u = table[t, U0] + (table[t, U] * rx + (table[t, U + 1] * ry + table[t, U + 2] * rz)) * distance
            v = table[t, V0] + (table[t, V] * rx + (table[t, V + 1] * ry + table[t, V + 2] * rz)) * distance
            light = (table[t, LIGHT] * rx + (table[t, LIGHT + 1] * ry + table[t, LIGHT + 2] * rz)) * distance
            albedo = _texture(t, table, integers, texels, u, v) * f4(1 / 255.0)
            radiance[y, x], depth[y, x] = albedo * albedo * light, rz * distance


@njit(**OPTIONS)
def _shadow(image, u, v, origin_u, origin_v, per_texel):
    """Light map value 0..1, 1 outside."""
    x = (u - origin_u) * per_texel - f4(0.5)
    y = (v - origin_v) * per_texel - f4(0.5)
    if x < 0 or y < 0 or x >= f4(image.shape[1] - 1) or y >= f4(image.shape[0] - 1):
        return f4(1)
    i, j = int(y), int(x)
    fx, fy = x - f4(j), y - f4(i)
    a, b = f4(image[i, j]), f4(image[i, j + 1])
    c, d = f4(image[i + 1, j]), f4(image[i + 1, j + 1])
    upper = a + (b - a) * fx
    lower = c + (d - c) * fx
    return (upper + (lower - upper) * fy) * f4(1 / 255.0)


@njit(**OPTIONS)
def cast_shadows(rays, inverse, owner, corner, vertices, table, light_map, radiance, y_first, y_last):
    """Multiply the light map into the pixels of its material."""
    image, material, origin_u, origin_v, scale = light_map
    for y in range(y_first, y_last):
        for x in range(radiance.shape[1]):
            t = np.int64(owner[y, x])
            if t == 0 or corner[t, 3] != material:
                continue
            rx, ry, rz = rays[y, 0, x], rays[y, 1, x], rays[y, 2, x]
            distance = f4(1) / inverse[y, x]
            i = corner[t, 0]
            u = vertices[i, 6] + (table[t, U] * rx + table[t, U + 1] * ry + table[t, U + 2] * rz) * distance
            v = vertices[i, 7] + (table[t, V] * rx + table[t, V + 1] * ry + table[t, V + 2] * rz) * distance
            radiance[y, x] *= _shadow(image, u, v, origin_u, origin_v, scale)

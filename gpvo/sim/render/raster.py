"""Which triangle each pixel sees: numba kernels for culling and the visibility buffer.

A triangle with corners A, B, C in the camera frame maps a ray r to ``[A B C]^-1 r``: its barycentrics times the inverse
distance along r. The rows of that inverse, dotted with rays, therefore give exact barycentrics and exact inverse
distance for any lens; nothing is clipped or projected (M. Olano, T. Greer, "Triangle scan conversion using 2D
homogeneous coordinates", 1997).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gpvo.sim.render.scene import LANES

# Contraction to fused multiply-adds, no NaNs: the same in every thread, unlike a change of the order of sums.
FAST = {"contract", "nsz", "nnan", "arcp"}
OPTIONS = {"nogil": True, "cache": True, "boundscheck": False, "error_model": "numpy", "fastmath": FAST}
f4 = np.float32


@njit(**OPTIONS)
def cull(sphere, cone, R, P, reach, max_angle, far, index, distance):
    """Clusters whose bounding sphere meets the field of view, not all turned away. Returns their number."""
    n = 0
    limit = math.tan(0.5 * max_angle)
    for c in range(sphere.shape[0]):
        x = np.float64(sphere[c, 0]) - P[0]
        y = np.float64(sphere[c, 1]) - P[1]
        z = np.float64(sphere[c, 2]) - P[2]
        radius = np.float64(sphere[c, 3])
        d = math.sqrt(x * x + y * y + z * z)
        if d - radius > far:
            continue
        if d > radius:
            facing = cone[c, 0] * x + cone[c, 1] * y + cone[c, 2] * z
            if cone[c, 3] < 1.5 and facing > cone[c, 3] * d + radius:
                continue
            X = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
            Y = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
            Z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
            # In the stereographic plane a cone is a circle.
            sine = radius / d
            half = sine / (1.0 + math.sqrt(max(1.0 - sine * sine, 0.0)))
            w = max(Z + d, 1e-9 * d)
            p = math.sqrt(X * X + Y * Y) / w
            if p * half < 1.0:
                inner = (p - half) / (1.0 + p * half)
                outer = (p + half) / (1.0 - p * half)
                if inner > limit:
                    continue
                middle = 0.5 * (inner + outer)
                r = 0.5 * (outer - inner)
                scale = middle / max(p, 1e-12) / w
                if abs(X * scale) - r > reach[0] or abs(Y * scale) - r > reach[1]:
                    continue
        index[n] = c
        distance[n] = d - radius
        n += 1
    return n


@njit(**OPTIONS)
def _to_pixels(vertices, start, count, R, P, plane, reach, camera, pixel):
    """Vertices of a cluster to the camera frame and, for bounds, to pixels."""
    size = plane.shape[0]
    top = f4(size - 1.001)
    scale_x = f4(0.5 * (size - 1)) / reach[0]
    scale_y = f4(0.5 * (size - 1)) / reach[1]
    for k in range(count):
        x = np.float64(vertices[start + k, 0]) - P[0]
        y = np.float64(vertices[start + k, 1]) - P[1]
        z = np.float64(vertices[start + k, 2]) - P[2]
        X = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        Y = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        Z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        camera[0, k] = X
        camera[1, k] = Y
        camera[2, k] = Z
        d = f4(math.sqrt(f4(X * X + Y * Y + Z * Z)))
        w = f4(1) / max(f4(Z) + d, f4(1e-6) * d + f4(1e-20))
        gx = min(max((f4(X) * w + reach[0]) * scale_x, f4(0)), top)
        gy = min(max((f4(Y) * w + reach[1]) * scale_y, f4(0)), top)
        i = int(gy)
        j = int(gx)
        fx = gx - f4(j)
        fy = gy - f4(i)
        for axis in range(2):
            a = plane[i, j, axis]
            b = plane[i, j + 1, axis]
            c = plane[i + 1, j, axis]
            e = plane[i + 1, j + 1, axis]
            upper = a + (b - a) * fx
            lower = c + (e - c) * fx
            pixel[axis, k] = upper + (lower - upper) * fy


@njit(**OPTIONS)
def _hidden(inverse, x0, x1, y0, y1, nearest):
    """Whether all pixels of a box are covered by something nearer than the inverse distance ``nearest``."""
    for y in range(y0, y1 + 1):
        for x in range(x0 // LANES * LANES, (x1 // LANES + 1) * LANES):
            if inverse[y, x] < nearest:
                return False
    return True


@njit(**OPTIONS)
def _solve(camera, i, j, k, rows, t):
    """Rows of the inverse of [A B C]: sum, B, C. False where the triangle shows its back. Also the tolerance."""
    ax, ay, az = camera[0, i], camera[1, i], camera[2, i]
    ux, uy, uz = camera[0, j] - ax, camera[1, j] - ay, camera[2, j] - az
    vx, vy, vz = camera[0, k] - ax, camera[1, k] - ay, camera[2, k] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    det = ax * nx + ay * ny + az * nz
    if not det < -1e-15:
        return False
    inverse = 1.0 / det
    rows[t, 0], rows[t, 1], rows[t, 2] = f4(nx * inverse), f4(ny * inverse), f4(nz * inverse)
    rows[t, 3] = f4((vy * az - vz * ay) * inverse)
    rows[t, 4] = f4((vz * ax - vx * az) * inverse)
    rows[t, 5] = f4((vx * ay - vy * ax) * inverse)
    rows[t, 6] = f4((ay * uz - az * uy) * inverse)
    rows[t, 7] = f4((az * ux - ax * uz) * inverse)
    rows[t, 8] = f4((ax * uy - ay * ux) * inverse)
    # Neighbours round differently along their common edge: both claim a hair's breadth across it.
    edge = math.sqrt(max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz))
    rows[t, 9] = f4(min(max(1e-4, -4e-7 * edge * (ax * ax + ay * ay + az * az) * inverse), 0.05))
    return True


@njit(**OPTIONS)
def _cover(rays, inverse, owner, rows, t, x0, x1, y0, y1):
    """Let triangle ``t`` take those pixels of its box, widened to whole groups, that it covers first."""
    ax, ay, az, bx, by, bz, cx, cy, cz, tolerance = (
        rows[t, 0], rows[t, 1], rows[t, 2], rows[t, 3], rows[t, 4],
        rows[t, 5], rows[t, 6], rows[t, 7], rows[t, 8], -rows[t, 9],
    )  # fmt: skip
    this = np.int32(t)
    first, end = x0 // LANES * LANES, (x1 // LANES + 1) * LANES
    for y in range(y0, y1 + 1):
        # Slices let the compiler see that it may work on many pixels at once.
        rx, ry, rz = rays[y, 0, first:end], rays[y, 1, first:end], rays[y, 2, first:end]
        nearest, owners = inverse[y, first:end], owner[y, first:end]
        for k in range(end - first):
            near = ax * rx[k] + (ay * ry[k] + az * rz[k])
            second = bx * rx[k] + (by * ry[k] + bz * rz[k])
            third = cx * rx[k] + (cy * ry[k] + cz * rz[k])
            edge, old = tolerance * near, nearest[k]
            inside = (near > old) & (second >= edge) & (third >= edge) & (near - second - third >= edge)
            nearest[k] = near if inside else old
            owners[k] = this if inside else owners[k]


@njit(**OPTIONS)
def _box(left, right, top, bottom, spare, bend, width, y_first, y_last):
    """Pixels x0, x1, y0, y1 (inclusive) of the image that bounds, and how far edges bulge out of them, may touch."""
    grow = spare + bend * ((right - left) * (right - left) + (bottom - top) * (bottom - top))
    return (
        max(math.ceil(left - grow), 0), min(math.floor(right + grow), width - 1),
        max(math.ceil(top - grow), y_first), min(math.floor(bottom + grow), y_last - 1),
    )  # fmt: skip


@njit(**OPTIONS)
def visibility(
    order, distance, scene, R, P, plane, reach, bend, width, rays, inverse, owner, y_first, y_last, camera,
    pixel, rows, corner,
):  # fmt: skip
    """Fill the visibility buffer of rows ``y_first`` to ``y_last`` (exclusive).

    Returns one more than the number of triangles kept: they count from 1, and 0 is the blank that empty pixels see.

    ``corner`` (T, 4): indices of each kept triangle's three vertices and its material.
    """
    vertices, triangles, vertex_start, triangle_start, material = scene
    kept = 1
    for q in range(len(order)):
        c = order[q]
        start = vertex_start[c]
        count = vertex_start[c + 1] - start
        _to_pixels(vertices, start, count, R, P, plane, reach, camera, pixel)
        left = right = pixel[0, 0]
        top = bottom = pixel[1, 0]
        for k in range(1, count):
            left, right = min(left, pixel[0, k]), max(right, pixel[0, k])
            top, bottom = min(top, pixel[1, k]), max(bottom, pixel[1, k])
        x0, x1, y0, y1 = _box(left, right, top, bottom, f4(0.6), bend, width, y_first, y_last)
        if x1 < x0 or y1 < y0:
            continue
        near = distance[q]
        if near > 0 and _hidden(inverse, x0, x1, y0, y1, f4(1.0 / near)):
            continue
        for t in range(triangle_start[c], triangle_start[c + 1]):
            i, j, k = np.int64(triangles[t, 0]), np.int64(triangles[t, 1]), np.int64(triangles[t, 2])
            left = min(min(pixel[0, i], pixel[0, j]), pixel[0, k])
            right = max(max(pixel[0, i], pixel[0, j]), pixel[0, k])
            top = min(min(pixel[1, i], pixel[1, j]), pixel[1, k])
            bottom = max(max(pixel[1, i], pixel[1, j]), pixel[1, k])
            x0, x1, y0, y1 = _box(left, right, top, bottom, f4(0.03), bend, width, y_first, y_last)
            if x1 < x0 or y1 < y0 or not _solve(camera, i, j, k, rows, kept):
                continue
            _cover(rays, inverse, owner, rows, kept, x0, x1, y0, y1)
            corner[kept, 0], corner[kept, 1], corner[kept, 2] = start + i, start + j, start + k
            corner[kept, 3] = material[c]
            kept += 1
    return kept

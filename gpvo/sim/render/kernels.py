"""What runs per triangle and per pixel, compiled by numba.

A triangle with corners A, B, C in the camera frame is hit by the ray r where ``r t = a A + b B + c C`` with
a + b + c = 1. The rows of the inverse of the matrix [A B C], dotted with r, are a/t, b/t and c/t: all positive inside,
and their sum is the inverse range. This holds for the ray of any lens, needs no clipping, and any attribute that is
linear on the triangle becomes one more row. (M. Olano, T. Greer, "Triangle scan conversion using 2D homogeneous
coordinates", 1997, section 4.)
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "cache": True, "error_model": "numpy"}
f4 = np.float32

TILE = 16  # edge of the tiles of the coarse depth buffer [px]
ROWS = 20  # floats kept per visible triangle: see _store
_EVERY = 150  # clusters between two updates of the coarse depth buffer
_UNSEEN = 1e30
_NEAR_M = 0.02
_SIDE_RAD = 0.35  # how far outside the field of view a fisheye still projects corners


@njit(**_OPTIONS)
def _project(lens, k, X, Y, Z, max_angle):  # type: ignore[no-untyped-def]
    """Pixel of a point in the camera frame; (1e30, 0) where the lens does not see it."""
    if lens == 0:
        if Z < _NEAR_M:
            return _UNSEEN, 0.0
        x, y = X / Z, Y / Z
        r2 = x * x + y * y
        if k[4] != 0 or k[5] != 0 or k[6] != 0 or k[7] != 0 or k[8] != 0:
            if r2 > k[9] * k[9]:
                return _UNSEEN, 0.0
            radial = 1 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
            x, y = (
                x * radial + 2 * k[6] * x * y + k[7] * (r2 + 2 * x * x),
                y * radial + k[6] * (r2 + 2 * y * y) + 2 * k[7] * x * y,
            )
        return k[0] * x + k[2], k[1] * y + k[3]
    r = math.sqrt(X * X + Y * Y)
    theta = math.atan2(r, Z)
    if theta > min(max_angle + _SIDE_RAD, k[9]):
        return _UNSEEN, 0.0
    t2 = theta * theta
    scale = theta * (1 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7])))) / max(r, 1e-12)
    return k[0] * X * scale + k[2], k[1] * Y * scale + k[3]


@njit(**_OPTIONS)
def _far_tiles(inverse, coarse):  # type: ignore[no-untyped-def]
    """Smallest inverse range, i.e. the farthest point, in each tile."""
    H, W = inverse.shape
    for ty in range(coarse.shape[0]):
        for tx in range(coarse.shape[1]):
            least = f4(1e9)
            for y in range(ty * TILE, min((ty + 1) * TILE, H)):
                for x in range(tx * TILE, min((tx + 1) * TILE, W)):
                    least = min(least, inverse[y, x])
            coarse[ty, tx] = least


@njit(**_OPTIONS)
def _candidates(C, R, P, max_angle, slope_x, slope_y, far, index, distance):  # type: ignore[no-untyped-def]
    """Clusters whose sphere may lie in view and that do not turn their backs; how many there are."""
    count = 0
    cos_view, sin_view = math.cos(max_angle), math.sin(max_angle)
    norm_x, norm_y = math.sqrt(1 + slope_x * slope_x), math.sqrt(1 + slope_y * slope_y)
    for c in range(C.shape[0]):
        dx, dy, dz, r = C[c, 0] - P[0], C[c, 1] - P[1], C[c, 2] - P[2], C[c, 3]
        d = math.sqrt(dx * dx + dy * dy + dz * dz)
        if d - r > far:
            continue
        if d > r:
            z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
            if math.sqrt(max(d * d - z * z, 0.0)) * cos_view - z * sin_view > r:
                continue
            if slope_x > 0:
                x = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
                y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
                if z < -r or abs(x) - slope_x * z > r * norm_x or abs(y) - slope_y * z > r * norm_y:
                    continue
            along = C[c, 4] * dx + C[c, 5] * dy + C[c, 6] * dz
            if C[c, 7] > 0 and along * C[c, 7] - math.sqrt(max(d * d - along * along, 0.0)) * C[c, 8] > r:
                continue
        index[count] = c
        distance[count] = d - r
        count += 1
    return count


@njit(**_OPTIONS)
def _hidden(C, c, R, P, lens, k, max_angle, px_per_rad, coarse):  # type: ignore[no-untyped-def]
    """Whether all tiles that a cluster may touch already show something nearer."""
    dx, dy, dz, r = C[c, 0] - P[0], C[c, 1] - P[1], C[c, 2] - P[2], C[c, 3]
    d = math.sqrt(dx * dx + dy * dy + dz * dz)
    if d < 2.5 * r:
        return False
    X = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
    Y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
    Z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    u, v = _project(lens, k, X, Y, Z, max_angle)
    if u >= _UNSEEN:
        return False
    reach = px_per_rad * math.asin(r / d) * 1.1 + 2
    nearest = 1 / (d - r)
    x0, x1 = max(int((u - reach) / TILE), 0), min(int((u + reach) / TILE), coarse.shape[1] - 1)
    y0, y1 = max(int((v - reach) / TILE), 0), min(int((v + reach) / TILE), coarse.shape[0] - 1)
    for ty in range(y0, y1 + 1):
        for tx in range(x0, x1 + 1):
            if coarse[ty, tx] < nearest:
                return False
    return True


@njit(**_OPTIONS)
def _footprint(row, rays, x, y, size, aniso):  # type: ignore[no-untyped-def]
    """Texture filter of a triangle, from the footprint of one of its pixels: level, taps, and the step between them."""
    row[14], row[15], row[16], row[17] = f4(0), f4(1), f4(0), f4(0)
    rx, ry, rz = rays[0, y, x], rays[1, y, x], rays[2, y, x]
    inverse = row[0] * rx + row[1] * ry + row[2] * rz
    if inverse <= 0 or rays[2, y, x + 1] == 0 or rays[2, y + 1, x] == 0:
        return
    t = f4(1) / inverse
    du = (row[3] * rx + row[4] * ry + row[5] * rz) * t
    dv = (row[6] * rx + row[7] * ry + row[8] * rz) * t
    qx, qy, qz = rays[0, y, x + 1] - rx, rays[1, y, x + 1] - ry, rays[2, y, x + 1] - rz
    w = row[0] * qx + row[1] * qy + row[2] * qz
    ux = (row[3] * qx + row[4] * qy + row[5] * qz - w * du) * t
    vx = (row[6] * qx + row[7] * qy + row[8] * qz - w * dv) * t
    qx, qy, qz = rays[0, y + 1, x] - rx, rays[1, y + 1, x] - ry, rays[2, y + 1, x] - rz
    w = row[0] * qx + row[1] * qy + row[2] * qz
    uy = (row[3] * qx + row[4] * qy + row[5] * qz - w * du) * t
    vy = (row[6] * qx + row[7] * qy + row[8] * qz - w * dv) * t
    # Axes of the ellipse that a round pixel covers: eigenvalues of J J'.
    a, b, c = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    mean, half = f4(0.5) * (a + c), f4(0.5) * (a - c)
    root = math.sqrt(half * half + b * b)
    major = mean + root
    minor = max(mean - root, major * f4(1e-4))
    taps = min(int(math.sqrt(major / minor) + f4(0.5)), aniso)
    if taps > 1:
        eu, ev = (major - c, b) if a >= c else (b, major - a)
        norm = math.sqrt(eu * eu + ev * ev)
        if norm > 0:
            row[15] = f4(taps)
            row[16], row[17] = f4(eu / norm * math.sqrt(major)), f4(ev / norm * math.sqrt(major))
    row[14] = f4(0.5) * f4(math.log2(major * size * size / (row[15] * row[15]) + f4(1e-9)))


@njit(**_OPTIONS)
def _store(row, a, b, c, i0, i1, i2, UV, lit, material):  # type: ignore[no-untyped-def]
    """Keep a visible triangle: rows of 1/t, u/t, v/t, radiance/t, the first corner's uv, [filter], material."""
    for axis in range(3):
        row[axis] = a[axis] + b[axis] + c[axis]
        row[3 + axis] = (UV[i1, 0] - UV[i0, 0]) * b[axis] + (UV[i2, 0] - UV[i0, 0]) * c[axis]
        row[6 + axis] = (UV[i1, 1] - UV[i0, 1]) * b[axis] + (UV[i2, 1] - UV[i0, 1]) * c[axis]
        row[9 + axis] = lit[i0] * a[axis] + lit[i1] * b[axis] + lit[i2] * c[axis]
    row[12] = UV[i0, 0] - math.floor(UV[i0, 0])
    row[13] = UV[i0, 1] - math.floor(UV[i0, 1])
    row[18] = f4(material)


@njit(**_OPTIONS)
def _cover(rays, inverse, seen, me, a, b, c, x0, x1, y0, y1):  # type: ignore[no-untyped-def]
    """Test a triangle against the pixels of its box; how many of them it now owns."""
    a0, a1, a2, b0, b1, b2 = a[0], a[1], a[2], b[0], b[1], b[2]
    s0, s1, s2 = a0 + b0 + c[0], a1 + b1 + c[1], a2 + b2 + c[2]
    edge = f4(-1e-4)  # shared edges belong to both neighbours: no pixel falls between them
    start = x0 & ~7
    width = ((x1 | 7) + 1) - start
    hits = np.int32(0)
    for y in range(y0, y1 + 1):
        r0, r1, r2 = rays[0, y, start : start + width], rays[1, y, start : start + width], rays[2, y, start:]
        z, s = inverse[y, start : start + width], seen[y, start : start + width]
        for x in range(width):
            rx, ry, rz = r0[x], r1[x], r2[x]
            old, owner = z[x], s[x]
            it = s0 * rx + s1 * ry + s2 * rz
            ea, eb = a0 * rx + a1 * ry + a2 * rz, b0 * rx + b1 * ry + b2 * rz
            inside = min(min(ea, eb), it - ea - eb) - edge * it
            mine = (inside >= 0) & (it > old)
            z[x] = it if mine else old
            s[x] = me if mine else owner
            hits += np.int32(mine)
    return hits


@njit(**_OPTIONS)
def raster(V, N, UV, light, albedo, F, material, C, cluster, R, P, rays, blocked, lens, k, max_angle, slope_x, slope_y, px_per_rad, far, ambient, head, size, aniso, width, Xc, px, lit, stamp, frame, rows, seen, inverse, coarse):  # type: ignore[no-untyped-def]  # noqa: E501
    """Find the triangle that each pixel sees. Fills ``seen`` (index into ``rows``, -1: none) and ``inverse`` range.

    ``blocked`` (H, P) is the start of the inverse range: 0, or huge where there is no ray. Returns the number of rows.
    """
    H, W = rays.shape[1], width
    inverse[:] = blocked
    seen[:] = -1
    index, distance = np.empty(C.shape[0], np.int32), np.empty(C.shape[0], np.float32)
    found = _candidates(C, R, P, max_angle, slope_x, slope_y, far, index, distance)
    order = np.argsort(distance[:found])
    count = 0
    a, b, c = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    for q in range(found):
        cl = index[order[q]]
        if q > 0 and q % _EVERY == 0:
            _far_tiles(inverse, coarse)
        if q >= _EVERY and _hidden(C, cl, R, P, lens, k, max_angle, px_per_rad, coarse):
            continue
        for t in range(cl * cluster, min((cl + 1) * cluster, F.shape[0])):
            umin, umax, vmin, vmax = 1e9, -1e9, 1e9, -1e9
            unseen = 0
            for corner in range(3):
                v = F[t, corner]
                if stamp[v] != frame:
                    stamp[v] = frame
                    dx, dy, dz = V[v, 0] - P[0], V[v, 1] - P[1], V[v, 2] - P[2]
                    X = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
                    Y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
                    Z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
                    Xc[v, 0], Xc[v, 1], Xc[v, 2] = X, Y, Z
                    px[v, 0], px[v, 1] = _project(lens, k, X, Y, Z, max_angle)
                    d2 = dx * dx + dy * dy + dz * dz
                    di = 1.0 / math.sqrt(d2)
                    spot = min(max((Z * di - 0.35) / 0.6, 0.0), 1.0)
                    facing = max(-(N[v, 0] * dx + N[v, 1] * dy + N[v, 2] * dz) * di, 0.0)
                    lamp = head * spot * spot * (3 - 2 * spot) * facing / (1.0 + 0.35 * d2)
                    lit[v] = albedo[v] * (ambient + light[v] + lamp)
                if px[v, 0] >= _UNSEEN:
                    unseen += 1
                else:
                    umin, umax = min(umin, px[v, 0]), max(umax, px[v, 0])
                    vmin, vmax = min(vmin, px[v, 1]), max(vmax, px[v, 1])
            if unseen == 3:
                continue
            i0, i1, i2 = F[t, 0], F[t, 1], F[t, 2]
            if unseen > 0:
                # A corner out of the lens's sight: the triangle may reach anywhere, unless it lies beside the view.
                if slope_x > 0:
                    m0, m1, m2 = slope_x * Xc[i0, 2], slope_x * Xc[i1, 2], slope_x * Xc[i2, 2]
                    if (Xc[i0, 0] > m0 and Xc[i1, 0] > m1 and Xc[i2, 0] > m2) or (
                        -Xc[i0, 0] > m0 and -Xc[i1, 0] > m1 and -Xc[i2, 0] > m2
                    ):
                        continue
                    m0, m1, m2 = slope_y * Xc[i0, 2], slope_y * Xc[i1, 2], slope_y * Xc[i2, 2]
                    if (Xc[i0, 1] > m0 and Xc[i1, 1] > m1 and Xc[i2, 1] > m2) or (
                        -Xc[i0, 1] > m0 and -Xc[i1, 1] > m1 and -Xc[i2, 1] > m2
                    ):
                        continue
                elif umin > W - 1 or umax < 0 or vmin > H - 1 or vmax < 0:
                    continue
                umin, umax, vmin, vmax = 0.0, W - 1.0, 0.0, H - 1.0
            else:
                bend = 1e-3
                if lens != 0 or k[4] != 0 or k[5] != 0:  # straight edges bow out of the box of their ends
                    span = max(umax - umin, vmax - vmin)
                    bend = 0.5 + span * span / (4 * k[0])
                umin, umax, vmin, vmax = umin - bend, umax + bend, vmin - bend, vmax + bend
                if umax < 0 or vmax < 0 or umin > W - 1 or vmin > H - 1:
                    continue
            x0, x1 = max(int(math.ceil(umin)), 0), min(int(math.floor(umax)), W - 1)
            y0, y1 = max(int(math.ceil(vmin)), 0), min(int(math.floor(vmax)), H - 1)
            if x1 < x0 or y1 < y0:
                continue
            ax, ay, az = Xc[i0, 0], Xc[i0, 1], Xc[i0, 2]
            bx, by, bz = Xc[i1, 0], Xc[i1, 1], Xc[i1, 2]
            gx, gy, gz = Xc[i2, 0], Xc[i2, 1], Xc[i2, 2]
            ux, uy, uz = by * gz - bz * gy, bz * gx - bx * gz, bx * gy - by * gx
            det = ax * ux + ay * uy + az * uz
            if det >= -1e-14:  # its back, or seen edge on
                continue
            di = 1.0 / det
            a[0], a[1], a[2] = ux * di, uy * di, uz * di
            b[0], b[1], b[2] = (gy * az - gz * ay) * di, (gz * ax - gx * az) * di, (gx * ay - gy * ax) * di
            c[0], c[1], c[2] = (ay * bz - az * by) * di, (az * bx - ax * bz) * di, (ax * by - ay * bx) * di
            if _cover(rays, inverse, seen, np.int32(count), a, b, c, x0, x1, y0, y1):
                _store(rows[count], a, b, c, i0, i1, i2, UV, lit, material[t])
                _footprint(rows[count], rays, min((x0 + x1) // 2, W - 2), min((y0 + y1) // 2, H - 2), f4(size), aniso)
                count += 1
                if count == rows.shape[0]:
                    return count
    return count


@njit(**_OPTIONS)
def _bilinear(texels, offset, n, u, v):  # type: ignore[no-untyped-def]
    x, y = u * f4(n) - f4(0.5), v * f4(n) - f4(0.5)
    i, j = np.int32(x + f4(65536)) - np.int32(65536), np.int32(y + f4(65536)) - np.int32(65536)
    fx, fy = x - f4(i), y - f4(j)
    m = n - 1
    c0, c1 = i & m, (i + 1) & m
    r0, r1 = offset + (j & m) * n, offset + ((j + 1) & m) * n
    p = f4(texels[r0 + c0]) + (f4(texels[r0 + c1]) - f4(texels[r0 + c0])) * fx
    q = f4(texels[r1 + c0]) + (f4(texels[r1 + c1]) - f4(texels[r1 + c0])) * fx
    return p + (q - p) * fy


@njit(**_OPTIONS)
def shade(texels, offsets, stride, size, rays, rows, seen, inverse, radiance, depth):  # type: ignore[no-untyped-def]
    """Radiance and depth (along the axis, 0: nothing) of every pixel, with trilinear and anisotropic filtering."""
    H, W = radiance.shape
    levels = offsets.shape[0]
    for y in range(H):
        for x in range(W):
            s = seen[y, x]
            if s < 0:
                radiance[y, x] = f4(0)
                depth[y, x] = f4(0)
                continue
            row = rows[s]
            rx, ry, rz = rays[0, y, x], rays[1, y, x], rays[2, y, x]
            t = f4(1) / inverse[y, x]
            u = row[12] + (row[3] * rx + row[4] * ry + row[5] * rz) * t
            v = row[13] + (row[6] * rx + row[7] * ry + row[8] * rz) * t
            light = (row[9] * rx + row[10] * ry + row[11] * rz) * t
            level, blend = 0, f4(0)
            if row[14] > 0:
                level = int(row[14])
                blend = row[14] - f4(level)
                if level > levels - 2:
                    level, blend = levels - 2, f4(1)
            base = np.int64(row[18]) * stride
            taps = int(row[15])
            total = f4(0)
            for tap in range(taps):
                along = (f4(tap) + f4(0.5)) / f4(taps) - f4(0.5)
                ut, vt = u + along * row[16], v + along * row[17]
                grey = _bilinear(texels, base + offsets[level], size >> level, ut, vt)
                if blend > f4(0.02):
                    coarse = _bilinear(texels, base + offsets[level + 1], size >> (level + 1), ut, vt)
                    grey += (coarse - grey) * blend
                total += grey
            total *= f4(1 / 255.0) / f4(taps)
            radiance[y, x] = total * total * light
            depth[y, x] = rz * t

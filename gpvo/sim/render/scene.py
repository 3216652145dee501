"""What the kernels read: a world's mesh cut into clusters with their own vertices, its textures as one pyramid, and the
rays of a lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.errors import GpvoError
from gpvo.sim.worlds import LightMap, Mesh, World
from gpvo.types import Array

F32 = NDArray[np.float32]
LANES = 8  # rows of pixels are filled up to whole groups of so many
_GRID = 192
_MARGIN = 1.12
_PINHOLE_LIMIT_RAD = 1.45  # a pinhole's tangent runs away near 90 degrees; no image reaches that far
_TRIANGLES = 80  # of a cluster at most, so that its vertices can be counted in a byte


@dataclass(frozen=True)
class Scene:
    """What the kernels read.

    Clusters: ``sphere`` (C, 4) centre and radius, ``cone`` (C, 4) mean normal and sine of the spread (2 where it is
    too wide), ``vertex_start``, ``triangle_start`` (C + 1,), ``cluster_material`` (C,). ``vertices`` (N, 10), repeated
    for each cluster: position, normal, texture coordinates, light, albedo. ``triangles`` (T, 3) uint8 count from the
    cluster's first vertex.
    ``texels`` uint32: four neighbours per texel; ``level_start`` (M, L) where each material's levels begin.
    """

    sphere: F32
    cone: F32
    vertex_start: NDArray[np.int32]
    triangle_start: NDArray[np.int32]
    cluster_material: NDArray[np.int32]
    vertices: F32
    triangles: NDArray[np.uint8]
    texels: NDArray[np.uint32]
    level_start: NDArray[np.int32]
    texture_size: int
    light_map: LightMap | None

    @classmethod
    def of(cls, world: World) -> Scene:
        """Cut and pack a world.

        Raises GpvoError where the textures differ in size or are not squares of a power of two.
        """
        mesh = world.mesh
        order, cluster = _clusters(mesh)
        faces = mesh.faces[order].astype(np.int64)
        count = int(cluster[-1]) + 1
        # Vertices of each cluster: distinct pairs (cluster, vertex), sorted by cluster.
        key = cluster[:, None] * len(mesh.vertices) + faces
        pairs, local = np.unique(key.ravel(), return_inverse=True)
        owner, vertex = pairs // len(mesh.vertices), pairs % len(mesh.vertices)
        vertex_start = np.searchsorted(owner, np.arange(count + 1)).astype(np.int32)
        local = local.reshape(-1, 3) - vertex_start[cluster][:, None]
        triangle_start = np.searchsorted(cluster, np.arange(count + 1)).astype(np.int32)
        texels, level_start = pyramids(world.textures)
        columns = (mesh.vertices, mesh.normals, mesh.uv, mesh.light[:, None], mesh.albedo[:, None])
        return cls(
            sphere=_spheres(mesh, vertex, vertex_start),
            cone=_cones(mesh, faces, cluster, triangle_start),
            vertex_start=vertex_start,
            triangle_start=triangle_start,
            cluster_material=mesh.material[order][triangle_start[:-1]].astype(np.int32),
            vertices=np.concatenate(columns, axis=1).astype(np.float32)[vertex],
            triangles=np.ascontiguousarray(local.astype(np.uint8)),
            texels=texels,
            level_start=level_start,
            texture_size=world.textures[0].shape[0],
            light_map=world.light_map,
        )


def _clusters(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Order of the faces by material and along a space-filling curve, and the cluster of each in that order."""
    centre = mesh.vertices[mesh.faces].mean(axis=1)
    low = centre.min(axis=0)
    cell = ((centre - low) / max(float((centre.max(axis=0) - low).max()), 1e-9) * 4095).astype(np.uint64)
    code = np.zeros(len(cell), np.uint64)
    for bit in range(12):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    order = np.lexsort((code, mesh.material))
    material = mesh.material[order].astype(np.int64)
    place = np.arange(len(order)) - np.searchsorted(material, material)
    step = np.concatenate([[0], (np.diff(material) != 0) | (place[1:] % _TRIANGLES == 0)])
    return order, np.cumsum(step)


def _spheres(mesh: Mesh, vertex: NDArray[np.int64], start: NDArray[np.int32]) -> F32:
    points = mesh.vertices[vertex].astype(np.float64)
    low = np.minimum.reduceat(points, start[:-1], axis=0)
    high = np.maximum.reduceat(points, start[:-1], axis=0)
    middle = ((low + high) / 2).astype(np.float32).astype(np.float64)
    owner = np.repeat(np.arange(len(start) - 1), np.diff(start))
    distance = np.linalg.norm(points - middle[owner], axis=1)
    radius = np.maximum.reduceat(distance, start[:-1]) * 1.0001 + 1e-5
    return np.concatenate([middle, radius[:, None]], axis=1).astype(np.float32)


def _cones(mesh: Mesh, faces: NDArray[np.int64], cluster: NDArray[np.int64], start: NDArray[np.int32]) -> F32:
    a, b, c = (mesh.vertices[faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    axis = np.add.reduceat(normal, start[:-1], axis=0)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-30)
    cosine = np.minimum.reduceat((normal * axis[cluster]).sum(axis=1), start[:-1])
    sine = np.where(cosine > 0.05, np.sqrt(np.clip(1 - cosine**2, 0, 1)) + 1e-4, 2.0)
    return np.concatenate([axis, sine[:, None]], axis=1).astype(np.float32)


def pyramids(textures: tuple[NDArray[np.uint8], ...]) -> tuple[NDArray[np.uint32], NDArray[np.int32]]:
    """Halved images of each texture down to one texel; each texel holds its right, lower and diagonal neighbour.

    Returns all texels in one row, and (M, L) the place at which each level of each texture begins.
    """
    size = len(textures[0])
    if size & (size - 1) or any(t.shape != (size, size) for t in textures):
        raise GpvoError("the textures of a world must be squares of one size, a power of two")
    parts: list[NDArray[np.uint32]] = []
    starts: list[list[int]] = []
    total = 0
    for texture in textures:
        image = texture.astype(np.float32)
        row = []
        while True:
            q = np.clip(image + 0.5, 0, 255).astype(np.uint32)
            right = np.roll(q, -1, axis=1)
            below, diagonal = np.roll(q, -1, axis=0), np.roll(right, -1, axis=0)
            parts.append((q | right << 8 | below << 16 | diagonal << 24).astype(np.uint32).ravel())
            row.append(total)
            total += q.size
            if len(image) == 1:
                break
            image = image.reshape(len(image) // 2, 2, -1, 2).mean(axis=(1, 3))
        starts.append(row)
    return np.concatenate(parts), np.array(starts, dtype=np.int32)


@dataclass(frozen=True)
class RayTable:
    """Tables of a lens, from its ``project`` and ``unproject``: rays of all pixels, and pixels of all directions.

    ``rays`` (H, 3, C) float32: unit rays of the pixels of a row, filled up to whole groups, zero where there is none.
    ``valid`` (H, W). ``plane`` (G, G, 2) float32: pixel (u, v) of directions given in the stereographic plane
    ``p = (x, y) / (z + |xyz|)``, on an even grid over ``|p_x| <= reach[0], |p_y| <= reach[1]``; it only has to
    bound triangles. ``bend`` [1/px]: straight edges of length L bulge by at most ``bend L^2`` pixels.
    """

    rays: NDArray[np.float32]
    valid: NDArray[np.bool_]
    plane: NDArray[np.float32]
    reach: NDArray[np.float32]
    max_angle_rad: float
    bend: float

    @classmethod
    def of(cls, model: CameraModel, max_angle_rad: float) -> RayTable:
        """Tables of a lens; pixels whose ray leaves the cone of ``max_angle_rad`` see nothing."""
        H, W = model.height, model.width
        v, u = np.mgrid[0:H, 0:W].astype(np.float64)
        rays = model.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(rays).all(axis=1) & (rays[:, 2] >= np.cos(max_angle_rad))
        rays = np.where(valid[:, None], rays, 0.0)
        angle = float(np.arccos(np.clip(rays[valid, 2].min(), -1, 1)))
        p = np.abs(rays[valid, :2] / (1 + rays[valid, 2:])).max(axis=0)
        reach = (p * _MARGIN + 0.02).astype(np.float32)
        packed = np.zeros((H, 3, -(-W // LANES) * LANES), np.float32)
        packed[:, :, :W] = rays.reshape(H, W, 3).transpose(0, 2, 1)
        straight = isinstance(model, PinholeRadtan) and not any(model.distortion)
        return cls(
            rays=packed,
            valid=valid.reshape(H, W),
            plane=_pixel_plane(model, reach),
            reach=reach,
            max_angle_rad=angle,
            bend=0.0 if straight else 1.0 / (8.0 * min(model.fx_px, model.fy_px)),
        )


def _pixel_plane(model: CameraModel, reach: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pixels over the stereographic plane, continued outwards evenly where the lens model ends."""
    px, py = np.meshgrid(*(np.linspace(-r, r, _GRID) for r in reach.astype(np.float64)))
    radius = np.hypot(px, py).ravel()
    theta = 2 * np.arctan(radius)
    direction = np.stack([px.ravel(), py.ravel()], 1) / np.maximum(radius, 1e-12)[:, None]
    limit = _largest_angle(model)
    inside = np.minimum(theta, limit)
    points = np.concatenate([direction * np.sin(inside)[:, None], np.cos(inside)[:, None]], axis=1)
    uv, _ = model.project(points)
    focal: Array = np.array([model.fx_px, model.fy_px])
    uv = uv + np.maximum(theta - limit, 0.0)[:, None] * direction * focal
    return np.ascontiguousarray(uv.reshape(_GRID, _GRID, 2).astype(np.float32))


def _largest_angle(model: CameraModel) -> float:
    """Angle up to which the model projects every direction."""
    if isinstance(model, KannalaBrandt):
        return model.max_angle_rad
    assert isinstance(model, PinholeRadtan)
    return min(float(np.arctan(model.max_radius)), _PINHOLE_LIMIT_RAD)

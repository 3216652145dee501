"""A world's mesh cut into clusters with their own vertices, and its textures as one pyramid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.sim.worlds.world import Lighting, LightMap, Mesh, World

F32 = NDArray[np.float32]
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
    lighting: Lighting

    @classmethod
    def of(cls, world: World) -> Scene:
        """Cut and pack a world.

        Raises
        ------
        GpvoError
            Where the textures differ in size or are not squares of a power of two.
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
        return cls(
            sphere=_spheres(mesh, vertex, vertex_start),
            cone=_cones(mesh, faces, cluster, triangle_start),
            vertex_start=vertex_start,
            triangle_start=triangle_start,
            cluster_material=mesh.material[order][triangle_start[:-1]].astype(np.int32),
            vertices=_records(mesh)[vertex],
            triangles=np.ascontiguousarray(local.astype(np.uint8)),
            texels=texels,
            level_start=level_start,
            texture_size=world.textures[0].shape[0],
            light_map=getattr(world, "light_map", None),
            lighting=world.lighting,
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


def _records(mesh: Mesh) -> F32:
    columns = (mesh.vertices, mesh.normals, mesh.uv, mesh.light[:, None], mesh.albedo[:, None])
    return np.concatenate(columns, axis=1).astype(np.float32)


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

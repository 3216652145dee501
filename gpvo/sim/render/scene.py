"""A world laid out for drawing: triangles in clusters of neighbours, textures as pyramids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.sim.worlds.world import Mesh, World

CLUSTER = 64


@dataclass(frozen=True)
class Scene:
    """``mesh`` with its faces in order of clusters of 64; ``clusters`` (C, 9) float32: centre, radius of the bounding
    sphere, axis of the cone of normals, cosine and sine of its half angle (cosine -1: no useful cone).

    ``texels``: the pyramids of all textures, one after the other; ``offsets`` (levels,) within one of them; ``stride``
    texels from one pyramid to the next; ``size``: texels along the finest level.
    """

    mesh: Mesh
    clusters: NDArray[np.float32]
    texels: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    stride: int
    size: int
    ambient: float
    head_lamp: float

    @classmethod
    def of(cls, world: World) -> Scene:
        """Lay out a world.

        Raises
        ------
        GpvoError
            Where the textures differ in size or are not squares of a power of two.
        """
        size = world.textures[0].shape[0]
        if size & (size - 1) or any(t.shape != (size, size) for t in world.textures):
            raise GpvoError("textures must be squares of one size, a power of two")
        mesh = _in_clusters(world.mesh)
        levels = [_pyramid(texture) for texture in world.textures]
        sizes = [level.size for level in levels[0]]
        return cls(
            mesh=mesh,
            clusters=_bounds(mesh),
            texels=np.concatenate([level.ravel() for pyramid in levels for level in pyramid]),
            offsets=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
            stride=int(sum(sizes)),
            size=size,
            ambient=world.lighting.ambient,
            head_lamp=world.lighting.head_lamp,
        )


def _pyramid(texture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    levels, image = [], texture.astype(np.float32)
    while True:
        levels.append(np.clip(image + 0.5, 0, 255).astype(np.uint8))
        n = image.shape[0]
        if n == 1:
            return levels
        image = image.reshape(n // 2, 2, n // 2, 2).mean(axis=(1, 3))


def _in_clusters(mesh: Mesh) -> Mesh:
    """Faces sorted along a Morton curve through their centres, so that 64 in a row are neighbours."""
    centre = mesh.vertices[mesh.faces].mean(axis=1)
    low = centre.min(axis=0)
    cell = ((centre - low) / max(float((centre.max(axis=0) - low).max()), 1e-9) * 4095).astype(np.uint64)
    code = sum((_spread_bits(cell[:, k]) << np.uint64(k) for k in range(3)), np.zeros(len(cell), dtype=np.uint64))
    order = np.argsort(code, kind="stable")
    as_f32 = [
        np.ascontiguousarray(a, dtype=np.float32)
        for a in (mesh.vertices, mesh.normals, mesh.uv, mesh.light, mesh.albedo)
    ]
    faces = np.ascontiguousarray(mesh.faces[order], dtype=np.int32)
    return Mesh(*as_f32, faces, np.ascontiguousarray(mesh.material[order]))


def _spread_bits(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Two zero bits between any two of the lowest 12 bits."""
    out = np.zeros_like(x)
    for bit in range(12):
        out |= ((x >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit)
    return out


def _bounds(mesh: Mesh) -> NDArray[np.float32]:
    count = -(-len(mesh.faces) // CLUSTER)
    pad = np.minimum(np.arange(count * CLUSTER), len(mesh.faces) - 1)
    corners = mesh.vertices[mesh.faces[pad]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    points = corners.reshape(count, CLUSTER * 3, 3)
    centre = 0.5 * (points.min(axis=1) + points.max(axis=1))
    radius = np.linalg.norm(points - centre[:, None], axis=2).max(axis=1)
    normal = normal.reshape(count, CLUSTER, 3)
    axis = normal.mean(axis=1)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-20)
    cosine = np.clip((normal * axis[:, None]).sum(axis=2).min(axis=1), -1, 1)
    useful = cosine > 0.1
    out = np.empty((count, 9))
    out[:, :3], out[:, 3], out[:, 4:7] = centre, radius * (1 + 1e-5) + 1e-5, axis
    out[:, 7] = np.where(useful, cosine, -1.0)
    out[:, 8] = np.where(useful, np.sqrt(1 - cosine**2), 0.0)
    return out.astype(np.float32)

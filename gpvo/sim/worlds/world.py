"""What a world is: one textured, baked mesh and what paths and vehicles need to know about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.sim.worlds.distance import TriangleDistance
from gpvo.types import Array

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Mesh:
    """Triangles seen from the side on which they run counter-clockwise.

    ``vertices`` (V, 3) [m], ``normals`` (V, 3), ``uv`` (V, 2) in texture tiles, ``light`` (V,) irradiance of the
    world's fixed lamps or sun, ``albedo`` (V,) factor on the texture that also holds ambient occlusion (all float32);
    ``faces`` (F, 3) int32; ``material`` (F,) uint8, index of a face's texture.
    """

    vertices: F32
    normals: F32
    uv: F32
    light: F32
    albedo: F32
    faces: NDArray[np.int32]
    material: NDArray[np.uint8]

    @classmethod
    def of(
        cls,
        vertices: Array,
        normals: Array,
        uv: Array,
        light: Array,
        albedo: Array,
        faces: NDArray[np.integer],
        material: NDArray[np.integer],
    ) -> Mesh:
        """A mesh from arrays of any number type."""

        def single(a: Array) -> F32:
            return np.ascontiguousarray(a, dtype=np.float32)

        return cls(
            vertices=single(vertices),
            normals=single(normals),
            uv=single(uv),
            light=single(light),
            albedo=single(albedo),
            faces=faces.astype(np.int32),
            material=material.astype(np.uint8),
        )


@dataclass(frozen=True)
class Lighting:
    """Light that is not baked. ``ambient``: irradiance from everywhere. ``head_lamp``: radiant intensity of a lamp at
    the camera, 0 for none. ``dust_airlight``: radiance of a thick cloud of dust in this light.
    """

    ambient: float = 0.01
    head_lamp: float = 0.0
    dust_airlight: float = 0.1


@dataclass(frozen=True)
class LightMap:
    """Fine shadows on one material: ``image`` (H, W) uint8, 255 in full light, over a rectangle of its texture plane.

    Texel centres lie at ``uv = origin + (column + 0.5, row + 0.5) * texel``; outside, full light.
    """

    image: NDArray[np.uint8]
    origin: tuple[float, float]
    texel: float
    material: int


@dataclass(frozen=True)
class World:
    """A built world. z is up, lengths in metres.

    ``textures``: one (n, n) uint8 image per material, tileable, n a power of two; grey 255 is albedo 1 after squaring.
    ``centreline`` (N, 3): a line one can fly or drive along. ``start_pose`` (4, 4): body (FLU) at its beginning.
    ``bounds`` (2, 3): corners of the box in which paths may run. ``heights``: terrain grids, empty where there is none.
    """

    kind: str
    seed: int
    params: Mapping[str, Any]
    mesh: Mesh
    textures: tuple[NDArray[np.uint8], ...]
    lighting: Lighting
    centreline: Array
    start_pose: Array
    bounds: Array
    heights: tuple[HeightGrid, ...] = field(default=())
    light_map: LightMap | None = None

    @property
    def texture(self) -> NDArray[np.uint8]:
        """The first material's texture."""
        return self.textures[0]

    @cached_property
    def _distance(self) -> TriangleDistance:
        return TriangleDistance(self.mesh.vertices, self.mesh.faces)

    def clearance(self, points: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the nearest surface, negative inside rock, ground or a wall."""
        return self._distance.signed(np.asarray(points, dtype=np.float64).reshape(-1, 3))

    def landmarks(self, n: int, seed: int) -> Array:
        """``n`` points (n, 3) spread evenly over the surfaces."""
        rng = np.random.default_rng(seed)
        corners = self.mesh.vertices[self.mesh.faces].astype(np.float64)
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = np.linalg.norm(np.cross(edge1, edge2), axis=1)
        face = rng.choice(len(area), size=n, p=area / area.sum())
        a, b = np.sqrt(rng.random(n)), rng.random(n)
        return corners[face, 0] + (a * (1 - b))[:, None] * edge1[face] + (a * b)[:, None] * edge2[face]

    def height(self, x: Array, y: Array) -> Array:
        """Height of the ground [m] at (x, y), without boulders; worlds with terrain only.

        Raises
        ------
        GpvoError
            In a world without terrain, or outside of it.
        """
        if not self.heights:
            raise GpvoError(f"the world '{self.kind}' has no terrain")
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        out = np.full(x.shape, np.nan)
        for grid in self.heights:
            inside = np.isnan(out) & grid.contains(x, y)
            out[inside] = grid(x[inside], y[inside])
        if np.isnan(out).any():
            raise GpvoError("a height was asked for outside the terrain", cure="keep the path within World.bounds")
        return out


@dataclass(frozen=True)
class HeightGrid:
    """Heights (rows along y, columns along x) [m] on a square grid: ``x = x0 + column * cell``, ``y`` likewise."""

    z: F32
    x0: float
    y0: float
    cell: float

    def contains(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Whether (x, y) lies on the grid."""
        rows, columns = self.z.shape
        u, v = (x - self.x0) / self.cell, (y - self.y0) / self.cell
        return (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)

    def __call__(self, x: Array, y: Array) -> Array:
        """Height on the two triangles of each cell, split from (0, 1) to (1, 0) as the mesh is."""
        rows, columns = self.z.shape
        u, v = (x - self.x0) / self.cell, (y - self.y0) / self.cell
        j = np.clip(u.astype(int), 0, columns - 2)
        i = np.clip(v.astype(int), 0, rows - 2)
        u, v = u - j, v - i
        z = self.z.astype(np.float64)
        z00, z10, z01, z11 = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
        lower = z00 + u * (z10 - z00) + v * (z01 - z00)
        upper = z11 + (1 - u) * (z01 - z11) + (1 - v) * (z10 - z11)
        return np.where(u + v <= 1, lower, upper)

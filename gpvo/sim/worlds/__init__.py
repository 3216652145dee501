"""Procedural worlds: a mine tunnel, the moon, a motion-capture hall. Built from a seed, kept in a cache.

A world is one textured, baked mesh and what paths and vehicles need to know about it.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gpvo.errors import GpvoError, SourceError
from gpvo.files import replacing
from gpvo.io.snapshot import code_digest
from gpvo.types import Array, field_names, out_of_limits

F32 = NDArray[np.float32]
KINDS = ("tunnel", "lunar", "room")
_NEIGHBOURS = 16
_CHUNK = 4096
_LARGEST_BYTES = 2_000_000_000
_ARRAYS = ("centreline", "start_pose", "bounds")


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
        cls, vertices: Array, normals: Array, uv: Array, light: Array, albedo: Array, faces: NDArray[np.integer],
        material: NDArray[np.integer],
    ) -> Mesh:  # fmt: skip
        """A mesh from arrays of any number type."""
        V, N, UV, L, A = (np.ascontiguousarray(a, dtype=np.float32) for a in (vertices, normals, uv, light, albedo))
        return cls(V, N, UV, L, A, faces.astype(np.int32), material.astype(np.uint8))


@dataclass(frozen=True)
class Lighting:
    """Light that is not baked. ``ambient``: irradiance from everywhere. ``head_lamp``: radiant intensity of a lamp at
    the camera, 0 for none."""

    ambient: float = 0.01
    head_lamp: float = 0.0


@dataclass(frozen=True)
class LightMap:
    """Fine shadows on one material: ``image`` (H, W) uint8, 255 in full light, over a rectangle of its texture plane.

    Texel centres lie at ``uv = origin (2,) + (column + 0.5, row + 0.5) * texel``; outside, full light.
    """

    image: NDArray[np.uint8]
    origin: Array
    texel: float
    material: int


@dataclass(frozen=True)
class World:
    """A built world. z is up, lengths in metres.

    ``textures``: one (n, n) uint8 image per material, tileable, n a power of two; grey 255 is albedo 1 after squaring.
    ``centreline`` (N, 3): a line one can fly or drive along. ``start_pose`` (4, 4): body (FLU) at its beginning.
    ``bounds`` (2, 3): corners of the box in which paths may run. ``ground``: heights of the terrain without boulders,
    None where there is none.
    """

    mesh: Mesh
    textures: tuple[NDArray[np.uint8], ...]
    lighting: Lighting
    centreline: Array
    start_pose: Array
    bounds: Array
    ground: HeightGrid | None = None
    light_map: LightMap | None = None

    @cached_property
    def _distance(self) -> TriangleDistance:
        return TriangleDistance(self.mesh.vertices, self.mesh.faces)

    def clearance(self, points: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the nearest surface, negative inside rock, ground or a wall."""
        return self._distance.signed(np.asarray(points, dtype=np.float64).reshape(-1, 3))


@dataclass(frozen=True)
class HeightGrid:
    """Heights (rows along y, columns along x) [m] on a square grid: ``x = x0 + column * cell``, ``y`` likewise."""

    z: F32
    x0: float
    y0: float
    cell: float

    def __call__(self, x: Array, y: Array) -> Array:
        """Height on the two triangles of each cell, split from (0, 1) to (1, 0) as the mesh is.

        Raises GpvoError outside the grid.
        """
        rows, columns = self.z.shape
        u, v = (np.asarray(x) - self.x0) / self.cell, (np.asarray(y) - self.y0) / self.cell
        if not ((u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)).all():
            raise GpvoError("a height was asked for outside the terrain", cure="keep the path within World.bounds")
        j = np.clip(u.astype(int), 0, columns - 2)
        i = np.clip(v.astype(int), 0, rows - 2)
        u, v = u - j, v - i
        z = self.z.astype(np.float64)
        z00, z10, z01, z11 = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
        lower = z00 + u * (z10 - z00) + v * (z01 - z00)
        upper = z11 + (1 - u) * (z01 - z11) + (1 - v) * (z10 - z11)
        return np.where(u + v <= 1, lower, upper)


class TriangleDistance:
    """Distance to the nearest of a mesh's triangles, found among those whose centres are near.

    Triangles of each class of size are searched apart, lest many small ones hide a large one.
    ``vertices`` (V, 3), ``faces`` (F, 3), visible from the side of positive distance.
    """

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
        self._corners = vertices[faces].astype(np.float64)
        centre = self._corners.mean(axis=1)
        size = np.linalg.norm(self._corners - centre[:, None], axis=2).max(axis=1)
        size_class = np.floor(np.log2(np.maximum(size, 1e-6)) / 1.5)
        self._members = [np.flatnonzero(size_class == k) for k in np.unique(size_class)]
        self._trees = [cKDTree(centre[members]) for members in self._members]

    def signed(self, points: Array) -> Array:
        """(N, 3) to (N,) [m], positive on the visible side."""
        parts = [self._signed(points[k : k + _CHUNK]) for k in range(0, len(points), _CHUNK)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _signed(self, points: Array) -> Array:
        found = []
        for tree, members in zip(self._trees, self._members):
            count = min(_NEIGHBOURS, len(members))
            found.append(members[tree.query(points, k=count)[1].reshape(len(points), count)])
        index = np.concatenate(found, axis=1)
        a, b, c = np.moveaxis(self._corners[index], 2, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
        offset = _offsets(points[:, None], a, b, c, normal)
        distance = np.linalg.norm(offset, axis=-1)
        # Several triangles share an edge or a corner: the one seen most squarely says which side it is.
        side = _dot(offset, normal)
        best = distance.min(axis=1, keepdims=True)
        side = np.where(distance <= best + 1e-9 + 1e-6 * best, side, 0.0)
        winner = np.abs(side).argmax(axis=1)
        sign = np.where(side[np.arange(len(points)), winner] < 0, -1.0, 1.0)
        return sign * best[:, 0]


def _offsets(p: Array, a: Array, b: Array, c: Array, normal: Array) -> Array:
    """From the nearest point of triangles ``a b c`` to ``p``, all (..., 3): it lies below, or else on an edge."""
    above, nearest, least = np.ones(a.shape[:-1], bool), np.zeros_like(a), np.full(a.shape[:-1], np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along, off = end - start, p - start
        above &= _dot(np.cross(normal, along), off) > 0  # of a triangle without area, never
        off -= np.clip(_dot(off, along) / np.maximum(_dot(along, along), 1e-300), 0, 1)[..., None] * along
        square = _dot(off, off)
        nearest, least = np.where((square < least)[..., None], off, nearest), np.minimum(square, least)
    return np.where(above[..., None], _dot(p - a, normal)[..., None] * normal, nearest)


def _dot(x: Array, y: Array) -> Array:
    return np.asarray(np.einsum("...i,...i", x, y))


def build_world(kind: str, seed: int, **params: object) -> World:
    """The world of a kind (``tunnel``, ``lunar``, ``room``) and a seed; the second time it comes from the cache.

    ``params``: single values of ``Params`` in the kind's module.

    The cache lies in ``$XDG_CACHE_HOME/gpvo``; it may be deleted at any time. Raises GpvoError for an unknown kind or
    parameter, or a value a world cannot be built with; MissingExtraError where Embree or numba are not installed (extra
    ``gpvo[sim]``).
    """
    if kind not in KINDS:
        raise GpvoError(f"unknown world '{kind}'", cure=f"choose from {', '.join(KINDS)}")
    module = import_module(f"gpvo.sim.worlds.{kind}")
    known = field_names(module.Params)
    if unknown := sorted(set(params) - set(known)):
        raise GpvoError(f"the world '{kind}' has no parameter '{unknown[0]}'", cure=f"it has {', '.join(known)}")
    full = module.Params(**params)
    for name, value, low, high in out_of_limits(full):
        raise GpvoError(f"{name} = {value} is not between {low} and {high}")
    text = json.dumps([kind, int(seed), asdict(full), code_digest(Path(__file__).parent)], sort_keys=True, default=str)
    path = cache_folder() / f"{kind}-{seed}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    with suppress(OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):  # absent or damaged: built anew
        return load_world(path)
    world: World = module.build(seed, full)
    with suppress(OSError, SourceError):  # a full or read-only home costs time at the next run, nothing else
        _save_world(world, path)
    return world


def cache_folder() -> Path:
    """Where worlds are kept: ``$XDG_CACHE_HOME/gpvo/worlds``, by default under ``~/.cache``."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    # A user without a home, as in a container run under a number: nothing can be kept below a device.
    return Path(os.devnull if base.startswith("~") else base) / "gpvo" / "worlds"


_PARTS: dict[str, type] = {"mesh": Mesh, "lighting": Lighting, "ground": HeightGrid, "light_map": LightMap}


def _save_world(world: World, path: Path) -> None:
    """Write a world atomically. Raises OSError or SourceError where the folder cannot be written."""
    arrays: dict[str, Any] = {f"texture_{k}": texture for k, texture in enumerate(world.textures)}
    arrays |= {name: getattr(world, name) for name in _ARRAYS}
    for part in _PARTS:
        if (whole := getattr(world, part)) is not None:
            arrays |= {f"{part}.{name}": value for name, value in vars(whole).items()}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def load_world(path: Path) -> World:
    """Read a world. Raises OSError, ValueError, KeyError, TypeError or zipfile.BadZipFile where the file is absent or
    damaged."""
    with zipfile.ZipFile(path) as archive:
        if sum(info.file_size for info in archive.infolist()) > _LARGEST_BYTES:
            raise ValueError(f"{path} is too large for a world")
    with np.load(path, allow_pickle=False) as data:
        read = {name: value if value.ndim else value.item() for name, value in data.items()}
    values: dict[str, Any] = {name: read[name] for name in _ARRAYS}
    for part, kind in _PARTS.items():
        own = {name.partition(".")[2]: value for name, value in read.items() if name.startswith(f"{part}.")}
        values[part] = kind(**own) if own else None
    return World(textures=tuple(v for name, v in read.items() if name.startswith("texture_")), **values)

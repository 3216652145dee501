"""Procedural worlds: a mine tunnel, the moon, a motion-capture hall. Built from a seed, kept in a cache."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from importlib import import_module
from pathlib import Path

import numpy as np

from gpvo.errors import GpvoError, SourceError
from gpvo.files import replacing
from gpvo.io.snapshot import code_digest
from gpvo.sim.worlds.world import HeightGrid, Lighting, LightMap, Mesh, World

__all__ = ["KINDS", "HeightGrid", "LightMap", "Lighting", "Mesh", "World", "build_world", "world_parameters"]

KINDS = ("tunnel", "lunar", "room")


def world_parameters(kind: str) -> dict[str, object]:
    """Names and defaults of the parameters that ``build_world`` takes for a kind."""
    _check_kind(kind)
    signature = inspect.signature(import_module(f"gpvo.sim.worlds.{kind}").build)
    return {name: p.default for name, p in signature.parameters.items() if name != "seed"}


def build_world(kind: str, seed: int, **params: object) -> World:
    """The world of a kind (``tunnel``, ``lunar``, ``room``) and a seed; the second time it comes from the cache.

    The cache lies in ``$XDG_CACHE_HOME/gpvo``; it may be deleted at any time.

    Raises
    ------
    GpvoError
        For an unknown kind or parameter, or a value a world cannot be built with.
    MissingExtraError
        Where Embree or numba are not installed (extra ``gpvo[sim]``).
    """
    known = world_parameters(kind)
    if unknown := sorted(set(params) - set(known)):
        raise GpvoError(f"the world '{kind}' has no parameter '{unknown[0]}'", cure=f"it has {', '.join(known)}")
    full = {**known, **params}
    build = import_module(f"gpvo.sim.worlds.{kind}").build
    return cached(kind, seed, full, lambda: build(seed, **full))


def _check_kind(kind: str) -> None:
    if kind not in KINDS:
        raise GpvoError(f"unknown world '{kind}'", cure=f"choose from {', '.join(KINDS)}")


_LARGEST_BYTES = 2_000_000_000


def cache_folder() -> Path:
    """Where worlds are kept: ``$XDG_CACHE_HOME/gpvo/worlds``, by default under ``~/.cache``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "gpvo" / "worlds"


def cached(kind: str, seed: int, params: Mapping[str, object], build: Callable[[], World]) -> World:
    """The world from its file, or built and written; a file that cannot be read or written is no hindrance."""
    text = json.dumps([kind, int(seed), dict(params), code_digest(Path(__file__).parent)], sort_keys=True, default=str)
    path = cache_folder() / f"{kind}-{seed}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    try:
        return load_world(path)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        pass
    world = build()
    with suppress(OSError, SourceError):  # a full or read-only home costs time at the next run, nothing else
        save_world(world, path)
    return world


def save_world(world: World, path: Path) -> None:
    """Write a world atomically.

    Raises
    ------
    OSError
        Where the folder cannot be written.
    """
    arrays: dict[str, np.ndarray] = {f"mesh_{f.name}": getattr(world.mesh, f.name) for f in fields(Mesh)}
    arrays |= {f"texture_{k}": texture for k, texture in enumerate(world.textures)}
    arrays |= {"centreline": world.centreline, "start_pose": world.start_pose, "bounds": world.bounds}
    header: dict[str, object] = {
        "kind": world.kind,
        "seed": world.seed,
        "params": dict(world.params),
        "lighting": asdict(world.lighting),
        "textures": len(world.textures),
        "ground": None,
        "light_map": None,
    }
    if world.ground is not None:
        arrays["ground"] = world.ground.z
        header["ground"] = (world.ground.x0, world.ground.y0, world.ground.cell)
    if world.light_map is not None:
        arrays["light_map"] = world.light_map.image
        header["light_map"] = (world.light_map.origin, world.light_map.texel, world.light_map.material)
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_world(path: Path) -> World:
    """Read a world.

    Raises
    ------
    OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile
        Where the file is absent or damaged.
    """
    with zipfile.ZipFile(path) as archive:
        if sum(info.file_size for info in archive.infolist()) > _LARGEST_BYTES:
            raise ValueError(f"{path} is too large for a world")
    with np.load(path, allow_pickle=False) as data:
        header = json.loads(data["header"].tobytes())
        light_map = None
        if header["light_map"] is not None:
            (u, v), texel, material = header["light_map"]
            light_map = LightMap(data["light_map"], (u, v), texel, material)
        return World(
            kind=header["kind"],
            seed=header["seed"],
            params=header["params"],
            mesh=Mesh(**{f.name: data[f"mesh_{f.name}"] for f in fields(Mesh)}),
            textures=tuple(data[f"texture_{k}"] for k in range(header["textures"])),
            lighting=Lighting(**header["lighting"]),
            centreline=data["centreline"],
            start_pose=data["start_pose"],
            bounds=data["bounds"],
            ground=HeightGrid(data["ground"], *header["ground"]) if header["ground"] is not None else None,
            light_map=light_map,
        )

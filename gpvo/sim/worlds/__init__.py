"""Procedural worlds: a mine tunnel, the moon, a motion-capture hall. Built from a seed, kept in a cache."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import zipfile
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
    if kind not in KINDS:
        raise GpvoError(f"unknown world '{kind}'", cure=f"choose from {', '.join(KINDS)}")
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
    text = json.dumps([kind, int(seed), full, code_digest(Path(__file__).parent)], sort_keys=True, default=str)
    path = cache_folder() / f"{kind}-{seed}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    with suppress(OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):  # absent or damaged: built anew
        return load_world(path)
    world: World = import_module(f"gpvo.sim.worlds.{kind}").build(seed, **full)
    with suppress(OSError, SourceError):  # a full or read-only home costs time at the next run, nothing else
        save_world(world, path)
    return world


_LARGEST_BYTES = 2_000_000_000
_ARRAYS = ("centreline", "start_pose", "bounds")


def cache_folder() -> Path:
    """Where worlds are kept: ``$XDG_CACHE_HOME/gpvo/worlds``, by default under ``~/.cache``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "gpvo" / "worlds"


def save_world(world: World, path: Path) -> None:
    """Write a world atomically.

    Raises
    ------
    OSError
        Where the folder cannot be written.
    """
    ground, shadows = world.ground, world.light_map
    header = {
        "kind": world.kind,
        "seed": world.seed,
        "params": dict(world.params),
        "lighting": asdict(world.lighting),
        "textures": len(world.textures),
        "ground": None if ground is None else (ground.x0, ground.y0, ground.cell),
        "light_map": None if shadows is None else (shadows.origin, shadows.texel, shadows.material),
    }
    arrays = {
        **{f"mesh_{f.name}": getattr(world.mesh, f.name) for f in fields(Mesh)},
        **{f"texture_{k}": texture for k, texture in enumerate(world.textures)},
        **{name: getattr(world, name) for name in _ARRAYS},
        **({} if ground is None else {"ground": ground.z}),
        **({} if shadows is None else {"light_map": shadows.image}),
        "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


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
            **{name: data[name] for name in _ARRAYS},
            ground=HeightGrid(data["ground"], *header["ground"]) if header["ground"] is not None else None,
            light_map=light_map,
        )

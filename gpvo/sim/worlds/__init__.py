"""Procedural worlds: a mine tunnel, the moon, a motion-capture hall. Built from a seed, kept in a cache."""

from __future__ import annotations

import inspect
from importlib import import_module

from gpvo.errors import GpvoError
from gpvo.sim.worlds.cache import cached
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

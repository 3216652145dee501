"""Stereo images of a world: exact geometry for any lens, in numba."""

from __future__ import annotations

from gpvo.sim.render.stereo import StereoRenderer

__all__ = ["StereoRenderer"]

"""The noise of a twin: the residuals of each track as a whole, with a random sign.

So noise keeps its size by depth, place and time, and how it goes on along a track. Patches of neighbouring points
overlap, and points of one moving thing are displaced together, so neighbours may err alike; then neighbours have their
signs from one smooth field. Multiplying residuals by dependent random numbers, and how far the dependence must reach:
X. Shao, "The dependent wild bootstrap" (2010).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from gpvo.twin.adjustment import Structure
from gpvo.twin.observations import WHITEN, Observations
from gpvo.types import Array

_EDGES_PX = (0.0, 10.0, 20.0, 40.0)
_AGREE, _SURE = 0.1, 3.0
_LARGEST = 4.0  # whitened residuals count no more


@dataclass(frozen=True)
class Neighbours:
    """Pairs of tracks that were near each other: ``first``, ``second`` (P,) and their mean ``distance_px`` (P,); the
    sums of the products of their whitened residuals, ``product``, and of the mean of their squares, ``square``."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    distance_px: Array
    product: Array
    square: Array

    @classmethod
    def of(cls, seen: Observations, structure: Structure) -> Neighbours:
        """Pairs within twice the largest distance over which residuals may agree."""
        z = (structure.residual_px @ WHITEN.T) / structure.sigma_px[seen.frame][:, None]
        z = np.clip(z, -_LARGEST, _LARGEST)
        used = structure.weight > 0
        starts = np.searchsorted(seen.frame, np.arange(len(structure.T_world_cam) + 1))
        pairs = [np.zeros((0, 2), np.int64)]
        for i, j in itertools.pairwise(starts):
            rows = i + np.flatnonzero(used[i:j])
            if len(rows) > 1:
                near = cKDTree(seen.uvd[rows, :2]).query_pairs(2 * _EDGES_PX[-1], output_type="ndarray")
                pairs.append(rows[near])
        a, b = np.concatenate(pairs).T
        n = len(structure.points_world)
        tracks = np.sort(np.stack([seen.track[a], seen.track[b]]), axis=0)
        key, place = np.unique(tracks[0] * n + tracks[1], return_inverse=True)
        first, second = np.divmod(key, max(n, 1))
        count = np.maximum(np.bincount(place, minlength=len(key)), 1)

        def summed(values: Array) -> Array:
            return np.bincount(place, values, minlength=len(key)).astype(np.float64)

        return cls(
            first,
            second,
            summed(np.linalg.norm(seen.uvd[a, :2] - seen.uvd[b, :2], axis=1)) / count,
            summed((z[a] * z[b]).sum(axis=1)),
            summed(0.5 * ((z[a] ** 2).sum(axis=1) + (z[b] ** 2).sum(axis=1))),
        )

    @property
    def reach_px(self) -> float:
        """Distance up to which residuals agree: a correlation beyond a tenth and beyond chance. 0 where none does."""
        reach = 0.0
        for low, high in itertools.pairwise(_EDGES_PX):
            own = (self.distance_px >= low) & (self.distance_px < high)
            total, square = self.product[own].sum(), self.square[own].sum()
            if total < max(_AGREE * square, _SURE * float(np.sqrt((self.product[own] ** 2).sum()))) or not square:
                break
            reach = high
        return reach


def draw_signs(count: int, neighbours: Neighbours, rng: np.random.Generator) -> Array:
    """Signs (count,) of tracks: independent, or of a field that is smooth over twice the reach of the residuals."""
    signs, reach = rng.choice([-1.0, 1.0], size=count), neighbours.reach_px
    if reach == 0.0:
        return signs
    weight = np.maximum(1.0 - neighbours.distance_px / (2 * reach), 0.0)
    mixing = sparse.csr_matrix((weight, (neighbours.first, neighbours.second)), shape=(count, count))
    own = rng.standard_normal(count)
    field = own + mixing @ own + mixing.T @ own
    return np.where(field < 0, -1.0, 1.0)

"""Errors that the points of a frame share: a smooth random field over the image and depth, added to a twin's noise.

Noise with a sign of its own on each track averages out over a frame. Imperfect matching that depends on the place in
the image, jitter between the cameras, objects and foreshortening do not. Each channel u, v, d of the field is
``c_k . (1, x, y, x^2, xy, y^2, q)`` [px] in frame k, with the image scaled to [-1, 1], and q the nearness: -1 for four
times, 1 for a quarter of the usual depth. The 21 coefficients have one variance for (u, v) and one for d, and those of
q have two of their own, of each kind (:data:`KINDS`) of dependence on time. What adds up from frame to frame is as
large as the image moves: how a point looks changes with the view of it, and not while the vehicle rests.

The residuals of a motion (measured minus moved, ``e = r_k - G r_{k-1}``, whitened), with its six directions A projected
out, say of the 21 modes F ``S_k = F' (1 - A A^+) e``, to which increments ``c_k`` of a field add ``N_k c_k``, with
``N_k = F' (1 - A A^+) F``. The mean over the run is taken off: a fit to noisy points is biased, and so are twins of
their own. Energies of sums of S over blocks of several lengths, each block in units of what white noise would make of
it, are compared with those of draws of the twins' noise. If they exceed them by a quarter and beyond chance (the
randomisation test of E. Pitman, 1937), non-negative least squares finds the variances that explain it. What lies within
the six directions is unseen: it is taken to be as strong.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gpvo.twin.bundle import WHITEN, Observations, pose_jacobian, projection_jacobian
from gpvo.twin.noise import Neighbours, Structure, draw_signs
from gpvo.types import Array
from gpvo.vo.points import point_jacobian

KINDS = ("level", "white", "1 s", "10 s")
"""White noise of each frame; and increments that a point accumulates from its first view: white, or correlated."""
_TAU_S = (0.0, 0.0, 1.0, 10.0)
_BLOCKS_S = (0.0, 0.25, 1.0, 3.0, 10.0)
_TERMS = 7  # functions of the place
_GROUPS = tuple(i + j for i in (0, _TERMS, 2 * _TERMS) for j in (0, 1, 3, 6))  # u, v, d: where order 0, 1, 2, q begin
_NEAR = np.arange(3 * _TERMS) % _TERMS == _TERMS - 1
_UVD = np.repeat(np.eye(2), (2 * _TERMS, _TERMS), axis=1)
_CHANNELS = np.concatenate([_UVD * ~_NEAR, _UVD * _NEAR])  # of (u, v), of d by the place in the image, and by q
_FOUR = np.log(4.0)
_DRAWS, _FIELDS = 99, 24  # a run is beyond all the draws by chance once in a hundred
_WORTH = 1.25  # less changes sigma by no more than an eighth
_MIN_PAIRS, _MIN_MOTIONS, _MIN_BLOCKS = 20, 40, 4
_MIN_DISPARITY_PX = 0.1
_MAX_GAP, _LARGEST = 3, 4.0  # frames between two views of a pair, as over a repeat; whitened residuals count no more
Pairs = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True)
class CommonField:
    """``variance_px2`` (4, 2) by kind, of (u, v) and of d; zero where none is. ``step_s``: median between frames.
    ``pace`` (F,): how far the image moves, over the usual: increments are as large, as nothing changes while it rests.
    ``near_px2`` (4, 2): variances of what depends on the nearness.
    """

    variance_px2: Array
    step_s: float
    pace: Array
    near_px2: Array = field(default_factory=lambda: np.zeros((len(KINDS), 2)))

    @classmethod
    def of(
        cls, seen: Observations, structure: Structure, noise_px: Array, signs: NDArray[np.int8], t_ns: NDArray[np.int64]
    ) -> CommonField:
        """The field that a run shows, beyond what draws of the noise (M, 3) with ``signs`` (N, draws) of tracks would.
        ``t_ns`` (F,) stamps. None is found where fewer than forty motions have twenty points.
        """
        step_s = max(float(np.median(np.diff(t_ns))) * 1e-9, 1e-6) if len(t_ns) > 1 else 1.0
        pairs = _pairs(seen, structure.weight > 0)
        S, N = _modes(seen, structure, noise_px, signs, pairs)
        pace = _pace(seen, len(S), pairs)
        lengths = [max(1, round(s / step_s)) for s in _BLOCKS_S]
        lengths = [n for n in dict.fromkeys(lengths) if len(S) // n >= _MIN_BLOCKS]
        variance = np.zeros((len(KINDS), len(_CHANNELS)))
        if (N[:, 0, 0] > 0).sum() < _MIN_MOTIONS:
            return cls(variance[:, :2], step_s, pace)
        told = N[:, 0, 0] > 0
        sums = _block_sums(S, told, lengths)
        weights = _weights(N, lengths)
        energy = _energies(sums, weights)
        varies = energy.std(axis=0) > 0  # not so nearness, where all points are equally far away
        energy = energy[:, varies]
        total = (energy / energy.std(axis=0)).sum(axis=1)
        if total[0] > total[1:].max() and (energy[0] / energy[1:].mean(axis=0)).mean() > _WORTH:
            scatter, rng = energy[1:].std(axis=0), np.random.default_rng(29)
            units = np.zeros((len(KINDS), len(_CHANNELS), len(scatter)))
            for kind, channel in itertools.product(range(len(KINDS)), range(len(_CHANNELS))):
                if _TAU_S[kind] <= lengths[-1] * step_s:  # longer than the blocks, it could not be told
                    c = _drawn(kind, (len(S), _FIELDS, 3 * _TERMS), step_s, rng) * _CHANNELS[channel]
                    c = np.diff(c, axis=0, prepend=0.0) if kind == 0 else c * pace[:, None, None]
                    seen_of_it = _energies(_block_sums(c @ N, told, lengths), weights).mean(axis=0)
                    units[kind, channel] = seen_of_it[varies] / scatter
            excess = (energy[0] - energy[1:].mean(axis=0)) / scatter
            variance = nnls(units.reshape(-1, len(scatter)).T, excess)[0].reshape(variance.shape)
        return cls(variance[:, :2], step_s, pace, variance[:, 2:])

    @classmethod
    def like(cls, variance_px2: Array, step_s: float, seen: Observations) -> CommonField:
        """One of known variances (4, 2), at the pace of what was seen."""
        return cls(variance_px2, step_s, _pace(seen, int(seen.frame.max(initial=-1)) + 1, _pairs(seen, seen.trusted)))

    def draw(self, seen: Observations, rng: np.random.Generator) -> Array:
        """(M, 3) the field [px] at the observations."""
        frames = int(seen.frame.max(initial=-1)) + 1
        level, *steps = c = np.zeros((len(KINDS), frames, 3 * _TERMS))
        for own, variances in ((~_NEAR, self.variance_px2), (_NEAR, self.near_px2)):
            if variances.any():
                for kind, variance in enumerate(variances):
                    root = np.sqrt(variance @ _UVD[:, own])
                    c[kind][:, own] = _drawn(kind, (frames, len(root)), self.step_s, rng) * root
        order = np.lexsort((seen.frame, seen.track))
        first = np.diff(seen.track[order], prepend=-1) != 0
        moved = self.pace[:frames, None] * sum(steps)
        gathered = np.where(first[:, None], 0.0, _at(moved, seen)[order]).cumsum(axis=0)
        field = _at(level, seen)
        field[order] += gathered - gathered[first][np.cumsum(first) - 1]
        return field

    def about(self) -> dict[str, list[float]]:
        """The variances [px^2] of the kinds found: of (u, v), of d, and of these by nearness."""
        found = np.concatenate([self.variance_px2, self.near_px2], axis=1)
        return {kind: v.tolist() for kind, v in zip(KINDS, found) if v.any()}

    def __bool__(self) -> bool:
        return bool(self.variance_px2.any() or self.near_px2.any())


def drawn_signs(count: int, neighbours: Neighbours) -> NDArray[np.int8]:
    """(count, draws) signs of tracks, for :meth:`CommonField.of`."""
    rng = np.random.default_rng(29)
    return np.stack([draw_signs(count, neighbours, rng).astype(np.int8) for _ in range(_DRAWS)], axis=1)


def _block_sums(S: NDArray[Any], told: NDArray[np.bool_], lengths: list[int]) -> list[NDArray[Any]]:
    """Sums (blocks, R, 21) over blocks of R series S (F, R, 21), for each length; takes off their means."""
    S -= (S.sum(axis=0, dtype=np.float64) / told.sum()).astype(S.dtype)
    S[~told] = 0.0
    return [np.add.reduceat(S[: len(S) // n * n], np.arange(0, len(S) // n * n, n), axis=0) for n in lengths]


def _weights(N: Array, lengths: list[int]) -> list[Array]:
    """(blocks, 21) one over what unit noise would make of the squares of the sums; 0 where they tell nothing."""
    out = []
    for n in lengths:
        square = np.add.reduceat(np.diagonal(N, axis1=1, axis2=2)[: len(N) // n * n], np.arange(0, len(N) // n * n, n))
        tells = square > 1e-6 * square.mean(axis=0)
        out.append(np.where(tells, 1.0 / np.where(tells, square, 1.0), 0.0))
    return out


def _energies(sums: list[NDArray[Any]], weights: list[Array]) -> Array:
    """(R, lengths x groups) weighted mean squares of sums over blocks, by group."""
    means = (np.einsum("brm,brm,bm->rm", s, s, w) / len(s) for s, w in zip(sums, weights, strict=True))
    return np.concatenate([np.add.reduceat(mean, _GROUPS, axis=1) for mean in means], axis=1)


def _drawn(kind: int, shape: tuple[int, ...], step_s: float, rng: np.random.Generator) -> Array:
    """Coefficients (F, ...) of unit variance, stationary in time."""
    x, keep = rng.standard_normal(shape), np.exp(-step_s / _TAU_S[kind]) if _TAU_S[kind] else 0.0
    x[1:] *= np.sqrt(1 - keep**2)
    if keep:  # by hand: loading scipy.signal takes as long as all else that twins need
        for before, now in itertools.pairwise(x):
            now += keep * before
    return x


def _basis(seen: Observations) -> Array:
    """(M, 7) the smooth functions at the observations."""
    x, y = (seen.uvd[:, :2] / [seen.camera.width / 2, seen.camera.height / 2] - 1.0).T
    d = np.maximum(seen.uvd[:, 2], _MIN_DISPARITY_PX)
    q = np.log(d / np.median(d)) / _FOUR if len(d) else d
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, np.clip(q, -1.0, 1.0)], axis=1)


def _at(c: Array, seen: Observations) -> Array:
    """(M, 3) fields of coefficients c (F, 21) at the observations."""
    B, n = _basis(seen), _TERMS
    return np.stack([np.einsum("mb,mb->m", B, c[seen.frame, i : i + n]) for i in (0, n, 2 * n)], axis=1)


def _pairs(seen: Observations, used: NDArray[np.bool_]) -> Pairs:
    """Consecutive observations of a track that are used (M,), in order of the later frame."""
    order = np.lexsort((seen.frame, seen.track))
    order = order[used[order]]
    a, b = order[:-1], order[1:]
    paired = (seen.track[a] == seen.track[b]) & (seen.frame[b] - seen.frame[a] <= _MAX_GAP)
    by_frame = np.argsort(b[paired])
    return a[paired][by_frame], b[paired][by_frame]


def _pace(seen: Observations, frames: int, pairs: Pairs) -> Array:
    """(F,) median way [px] of the points since the frame before, over its root mean square; 0 where none is known."""
    first, second = pairs
    way = np.linalg.norm(seen.uvd[second, :2] - seen.uvd[first, :2], axis=1)
    starts = np.searchsorted(seen.frame[second], np.arange(frames + 1))
    px = np.array([np.median(way[i:j]) if j > i else 0.0 for i, j in itertools.pairwise(starts)])
    return np.asarray(px / max(float(np.sqrt((px**2).sum() / max((px > 0).sum(), 1))), 1e-9))


def _modes(
    seen: Observations, structure: Structure, noise_px: Array, signs: NDArray[np.int8], pairs: Pairs
) -> tuple[NDArray[Any], Array]:
    """S (F, 1 + draws, 21) of the run and of the draws, and N (F, 21, 21)."""
    first, second = pairs
    P, R, B = structure.in_camera(seen), structure.T_world_cam[:, :3, :3], _basis(seen)
    n = 3 * _TERMS
    S, N = np.zeros((len(R), 1 + signs.shape[1], n), np.float32), np.zeros((len(R), n, n))
    starts = np.searchsorted(seen.frame[second], np.arange(len(R) + 1))
    for k in np.flatnonzero(np.diff(starts) >= _MIN_PAIRS):
        a, b = (of[starts[k] : starts[k + 1]] for of in (first, second))
        J, W = projection_jacobian(P[b], seen.camera), WHITEN / structure.sigma_px[k]
        G = J @ R[k].T @ R[seen.frame[a]] @ point_jacobian(seen.camera.project(P[a]), seen.camera)
        run, noise = ((r[b] - (G @ r[a][:, :, None])[:, :, 0]) @ W.T for r in (structure.residual_px, noise_px))
        # Huber's weights: the same for a residual and its opposite, so for all draws.
        w = np.minimum(1.0, _LARGEST / np.maximum(np.linalg.norm(run, axis=1), 1e-9))[:, None, None]
        A = w * (W @ J @ pose_jacobian(P[b]))
        place = B[b]
        # Of both views: the noise of one is in the residual, too, and what depends on it would look like a field.
        place[:, -1] = 0.5 * (B[a, -1] + B[b, -1])
        F = (w * (W[:, :, None] * place[:, None, None, :]).reshape(len(a), 3, n)).reshape(-1, n)
        Q = np.linalg.qr(A.reshape(-1, 6))[0]
        F -= Q @ (Q.T @ F)
        by_point = np.swapaxes(w * F.reshape(-1, 3, n), 1, 2)
        S[k, 0] = (by_point @ run[:, :, None]).sum(axis=0)[:, 0]
        S[k, 1:] = signs[seen.track[a]].T @ (by_point @ noise[:, :, None])[:, :, 0]
        N[k] = F.T @ F
    return S, N

"""The offset between the clocks of a log and its truth, from how much both turn and travel.

Angle and distance over a window do not depend on how the two frames are placed relative to each other, so nothing has
to be aligned first. (P. Furgale, J. Rehder, R. Siegwart, "Unified temporal and spatial calibration for multi-sensor
systems", 2013, estimate both at once from raw measurements; logs of poses do not need that.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.errors import MAX_GAP_S, interpolate_truth, sizes
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.types import Array, TruthLog, VoLog

# With clocks that overlap, offsets beyond this are mistakes of the search, not of the clocks: unless they leave of both
# turns and distances less than this share unexplained of what smaller ones do.
_MAX_OFFSET_S, _LESS_UNEXPLAINED = 5.0, 0.25
_WINDOW_S, _APART_S = 0.25, 0.025
_MIN_OVERLAP_S = 3.0
_MIN_CORRELATION = 0.3
_MAX_SAMPLES = 200_000
_ROUNDS, _ORDINARY = 8, 3.0  # the latter: median misfits, beyond which a sample counts less


def estimate_time_offset(log: VoLog, truth: TruthLog) -> float:
    """Seconds to add to the log's stamps so that they are of the truth's clock.

    Clocks whose times do not overlap at all are searched over their whole length. Raises GpvoError where either is too
    short, or the motions do not resemble one another at any offset.
    """
    if len(log) < 10 or len(truth.t_ns) < 10:
        raise GpvoError("too few poses to estimate a time offset", cure="give --time-offset in seconds")
    moving = TruthLog(log.t_ns, log.trajectory())
    needed_s = _MIN_OVERLAP_S + _WINDOW_S
    for name, t_ns in (("log", log.t_ns), ("truth", truth.t_ns)):
        if (lasts_s := (t_ns[-1] - t_ns[0]) * 1e-9) < needed_s:
            what = f"the {name} lasts {lasts_s:.2f} s; {needed_s:g} s are needed to estimate a time offset"
            raise GpvoError(what, cure="give --time-offset in seconds")
    step_s = float(np.median(np.diff(moving.t_ns))) * 1e-9
    window = max(1, round(_WINDOW_S / step_s))
    longest_s = max(int(t_ns[-1] - t_ns[0]) for t_ns in (log.t_ns, truth.t_ns)) * 1e-9
    coarse_s = min(max(step_s, longest_s / (_MAX_SAMPLES - 1)), _WINDOW_S)
    return _refine(moving, truth, _coarse(moving, truth, coarse_s, window * step_s), window)


def on_clock_of_log(truth: TruthLog, offset_s: float) -> TruthLog:
    """The truth with the stamps of a log whose offset to it is ``offset_s``."""
    return replace(truth, t_ns=truth.t_ns - round(offset_s * 1e9))


def _amounts(T: Array, ok: NDArray[np.bool_], window: int) -> Array:
    """(2, N - window) angle [rad] and distance [m] over each window; NaN where an end is unknown."""
    both = sizes(se3.inverse(T[:-window]) @ T[window:])[::-1]
    return np.where(ok[:-window] & ok[window:], both, np.nan)


def _on_grid(poses: TruthLog, step_s: float, window: int) -> tuple[Array, int]:
    """Amounts on an even grid of ``step_s``, and the grid's first stamp [ns]."""
    first, last = int(poses.t_ns[0]), int(poses.t_ns[-1])
    count = int((last - first) * 1e-9 / step_s)
    if not 2 * window < count < _MAX_SAMPLES:
        what = f"a log of {(last - first) * 1e-9:.1f} s is too short or too long to estimate a time offset"
        raise GpvoError(what, cure="give --time-offset in seconds")
    grid = first + np.rint(np.arange(count) * step_s * 1e9).astype(np.int64)
    return _amounts(*interpolate_truth(poses, grid, _gap_s(poses)), window), first


def _gap_s(poses: TruthLog) -> float:
    """The longest gap that is interpolated over: of slow poses a step and a half, longer than what errors are told by
    (``dataset.errors``), as only the time of the motions is asked for and without slow poses nothing tells it."""
    return max(MAX_GAP_S, 1.5e-9 * float(np.median(np.diff(poses.t_ns))))


def _coarse(log: TruthLog, truth: TruthLog, step_s: float, window_s: float) -> float:
    """Offset [s] of the best normalised correlation, to one step."""
    window = max(1, round(window_s / step_s))
    a, a_first = _on_grid(log, step_s, window)
    b, b_first = _on_grid(truth, step_s, window)
    by_kind = [_correlation(x, y, round(_MIN_OVERLAP_S / step_s)) for x, y in zip(a, b, strict=True)]
    score = np.maximum.reduce(by_kind)
    # Lag k: sample i of the log meets sample i + k of the truth.
    lag = np.arange(score.size) - (a.shape[1] - 1)
    offset = (b_first - a_first) * 1e-9 + lag * step_s
    if log.t_ns[0] <= truth.t_ns[-1] and truth.t_ns[0] <= log.t_ns[-1]:
        near = np.abs(offset) <= _MAX_OFFSET_S
        unexplained = _LESS_UNEXPLAINED * (1 - score[near].max(initial=0.0) ** 2)
        score = np.where(near | (np.minimum.reduce(by_kind) > np.sqrt(1 - unexplained)), score, -1.0)
    best = int(np.argmax(score))
    if score[best] < _MIN_CORRELATION:
        cure = "is it the truth of this log? If so, give --time-offset in seconds"
        raise GpvoError(f"the motions of log and truth do not match (correlation {score[best]:.2f})", cure=cure)
    return float(offset[best])


def _correlation(x: Array, y: Array, min_overlap: int) -> Array:
    """Pearson's correlation of ``x[i]`` with ``y[i + k]`` for every lag k, -1 where too few samples overlap."""
    n = x.size + y.size - 1
    size = 1 << (n - 1).bit_length()
    # A slip of the log must not outweigh everything: amounts are cut at thrice their upper decile.
    parts = []
    for v in (x, y):
        known = np.isfinite(v)
        cut = 3.0 * np.percentile(v[known], 90) if known.any() else 0.0
        parts.append((known.astype(np.float64), np.where(known, np.minimum(v, cut), 0.0)))
    (mx, vx), (my, vy) = parts

    def sliding(p: Array, q: Array) -> Array:
        spectrum = np.conj(np.fft.rfft(p, size)) * np.fft.rfft(q, size)
        return np.roll(np.fft.irfft(spectrum, size), x.size - 1)[:n]

    count = np.maximum(sliding(mx, my), 1.0)
    sx, sy = sliding(vx, my), sliding(mx, vy)
    var_x = sliding(vx**2, my) - sx**2 / count
    var_y = sliding(mx, vy**2) - sy**2 / count
    power = np.sqrt(np.maximum(var_x, 0) * np.maximum(var_y, 0))
    covariance = sliding(vx, vy) - sx * sy / count
    floor = 1e-9 * max(float(power.max(initial=0.0)), 1e-300)
    enough = (count >= max(min_overlap, 0.2 * min(mx.sum(), my.sum()))) & (power > floor)
    return np.where(enough, covariance / np.where(enough, power, 1.0), -1.0)


def _refine(log: TruthLog, truth: TruthLog, offset_s: float, window: int) -> float:
    """Minimum of a robust misfit near ``offset_s``, to a fraction of a step: of the parabola through three offsets,
    whole steps of the truth apart. Interpolation averages the noise of two poses, most of all midway between them: of
    offsets between which its fractions differ, noise alone would choose one."""
    T = log.T_world_cam
    mine, gap_s = _amounts(T, np.ones(len(T), dtype=bool), window), _gap_s(truth)
    own_s = 1e-9 * float(np.median(np.diff(truth.t_ns)))
    apart_s = own_s * max(1, round(_APART_S / own_s))
    for _ in range(_ROUNDS):
        asked = (log.t_ns + round((offset_s + k * apart_s) * 1e9) for k in (-1, 0, 1))
        d = np.stack([mine - _amounts(*interpolate_truth(truth, t_ns, gap_s), window) for t_ns in asked])
        d = d[:, :, np.isfinite(d).all(axis=(0, 1))]
        if d.shape[2] < 10:
            break  # too few samples to judge by: the offset stands
        spread2 = np.maximum(np.median(np.abs(d[1]), axis=1, keepdims=True), 1e-9) ** 2
        left, middle, right = (d**2 / (_ORDINARY**2 * spread2 + d[1] ** 2)).sum(axis=(1, 2))
        bend = left - 2 * middle + right
        if bend <= 0:
            break
        offset_s += apart_s * float(np.clip(0.5 * (left - right) / bend, -1, 1))
    return offset_s

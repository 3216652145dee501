"""Stretches of a run from which nothing should be learned about odometry, because the truth is in doubt there.

Waits: while the vehicle stands still but its truth does not, the apparent error of odometry is the truth's. Satellite
positions wander by decimetres while a car waits at a light, and odometry, which sees that nothing moves, would be
blamed for it. Image and IMU together decide whether the vehicle stands still: a motion to which odometry is blind does
not escape a gyroscope.

Jumps: motion capture confuses its markers, and pieces of a truth have different origins. Where the truth moves as the
vehicle cannot, and odometry does not, the error is the truth's; and so it is between jumps there and back.

Odd stretches: where odometry and truth differ far more than elsewhere in the sequence, one of the two is wrong, and a
model that learned from them would be too cautious everywhere. Two differences are looked for: the share of the true
motion that odometry shows; and the direction of travel, as when the truth climbs while the vehicle does not. Each must
be far from its own median in the sequence, both by its spread there (the median absolute deviation, which also holds
errors that last) and by what white noise leaves over the same window. How noise is spread over the motions, odometry
states; how large it is, differences between neighbours tell. Which of the two is wrong is for the user to decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.dataset.errors import MotionErrors, interpolate_truth, motion_errors, without_held
from gpvo.geometry import se3
from gpvo.online.slip import flag_slips
from gpvo.stats.series import moving_sums
from gpvo.types import Array, ImuMoments, Status, StereoCamera, TruthLog, VoLog, VoRecord

STILL_S = 1.0
"""So long a vehicle must stand at least for a wait."""
STILL_PX, TRUTH_PX = 1.0, 2.0
"""Image motion up to which an image is at rest, and that a truth must claim to contradict it."""
GYRO_STD_RADPS, ACC_STD_MPS2 = 0.005, 0.5
"""Spread up to which an IMU is at rest. Small gyroscopes have 0.0015 to 0.0035 rad/s of noise at 200 Hz; on the road,
cars are seldom below 0.007 rad/s for a second (KITTI). The limit on accelerations lets an engine idle."""
_SHORT_S, _LONG_S = 0.25, 2.5
"""Windows over which the share, and the direction, are taken."""
_LEAST_SHORT, _LEAST_LONG = 5, 50
"""Motions that these hold at least. The long one holds at most half the sequence."""
_NOWHERE_M = 1e-6  # no motion, and no noise, is smaller
_LEAST_MOTIONS = 4  # in a row whose share is the same

_SIGMAS = 5.0
_LEAST_SHARE, _LEAST_TURN = 0.1, 0.02
"""Smaller differences, of the share and in radians, are nobody's gross mistake."""
_MOST = 1 / 3
"""Of the sequence: what makes up more is how the sequence is."""


def wandering_waits(log: VoLog, truth: TruthLog) -> NDArray[np.int64]:
    """(W, 2) times [ns] of the first and the last frame of waits during which the truth moves.

    Over a wait, odometry moves by less than ``STILL_PX`` of the image and the IMU is still; the truth moves where
    its motion would be more than ``TRUTH_PX``. Without a camera, or an IMU in the log, nothing is called a wait.
    """
    if log.camera is None:
        return np.zeros((0, 2), dtype=np.int64)
    found, (T_true, known), t_ns = [], interpolate_truth(truth, log.t_ns), log.t_ns
    scene = _Scene.of(log, log.camera)
    for first, last in _waits(log, log.trajectory(), scene):
        span = slice(first, last + 1)
        if known[span].all() and scene.motion_px(_extent(T_true[span]), last) > TRUTH_PX:
            found.append(t_ns[[first, last]])
    return np.array(found, dtype=np.int64).reshape(-1, 2)


_JUMP_MEDIANS, _BACK_S, _BETWEEN = 10.0, 1.0, 0.5  # the last: share of the motions between two jumps


def jumps(log: VoLog, truth: TruthLog) -> list[Stretch]:
    """Motions in which the truth, at its own rate, moves as the vehicle cannot, though odometry does not, and far more
    of an error than usual; as one, with what lies between, those less than a second apart, or with such errors between
    them: markers that were confused until the second."""
    errors = motion_errors(log, truth)
    large = errors.far(_JUMP_MEDIANS)
    if not large.any():
        return []
    t_ns, t_prev_ns = log.t_ns, log.column("t_prev_ns")
    leaps = in_waits(log, _impossible(log, truth))[errors.index]
    far = large & leaps & flag_slips(log).usable[errors.index]
    found: list[Stretch] = []
    for k, xi in zip(errors.index[far].tolist(), errors.xi[far], strict=True):
        first, span_ns = k, (int(t_prev_ns[k]), int(t_ns[k]))
        between = large[(errors.index > found[-1].last) & (errors.index < k)] if found else large[:0]
        if found and (span_ns[0] - found[-1].t_ns[1] < _BACK_S * 1e9 or (len(between) and between.mean() > _BETWEEN)):
            first, span_ns = found[-1].first, (found[-1].t_ns[0], span_ns[1])
            found.pop()
        metres, degrees = np.linalg.norm(xi[:3]), np.rad2deg(np.linalg.norm(xi[3:]))
        what = f"truth jumps, last by {metres:.2g} m and {degrees:.2g} deg; not scored"
        found.append(Stretch(first, k, span_ns, what))
    return found


def _impossible(log: VoLog, truth: TruthLog) -> NDArray[np.int64]:
    """(K, 2) times [ns] between which the truth moves, from one pose to the next, as the log's vehicle cannot."""
    own = without_held(truth)
    motions = se3.inverse(own.T_world_cam[:-1]) @ own.T_world_cam[1:]
    spans = np.stack([own.t_ns[:-1], own.t_ns[1:]], axis=1)
    records = [VoRecord(end, start, Status.OK, T) for (start, end), T in zip(spans.tolist(), motions, strict=True)]
    return spans[~flag_slips(replace(log, records=records)).usable]


def false_motions(log: VoLog, truth: TruthLog, leaps: Sequence[Stretch] | None = None) -> NDArray[np.int64]:
    """(W, 2) times [ns] of waits during which the truth moves, and of its jumps: ``leaps`` if they are known."""
    found = [s.t_ns for s in (jumps(log, truth) if leaps is None else leaps)]
    return np.concatenate([wandering_waits(log, truth), np.array(found, dtype=np.int64).reshape(-1, 2)])


def in_waits(log: VoLog, waits: ArrayLike) -> NDArray[np.bool_]:
    """(N,) which motions, or windows of motions, share time with one of the waits, or odd stretches, (W, 2) [ns]."""
    first, last = np.sort(np.asarray(waits, dtype=np.int64).reshape(-1, 2), axis=0).T
    start, end = log.column("t_prev_ns"), log.t_ns
    # More have begun by its end than were over by its start: compared in pairs, a day of stops would fill the memory.
    return np.asarray(np.searchsorted(first, end) > np.searchsorted(last, start, side="right"), dtype=np.bool_)


def without_wandering_truth(log: VoLog, truth: TruthLog, leaps: Sequence[Stretch] | None = None) -> VoLog:
    """The log with such :func:`false_motions` called lost, so that neither an error nor a sum of errors reaches over
    them; for statistics alone."""
    waits = false_motions(log, truth, leaps)
    if not len(waits):
        return log
    marked = zip(log, in_waits(log, waits))
    return log.judged_as(r.with_status(Status.LOST, "truth moves otherwise") if i else r for r, i in marked)


@dataclass(frozen=True)
class _Scene:
    """How the image answers to a translation, frame by frame: ``spread`` (N,) mean square of the image coordinates
    seen, ``inverse_m`` (N,): focal lengths over depth of the near points [px/m]."""

    spread: Array
    inverse_m: Array

    @classmethod
    def of(cls, log: VoLog, camera: StereoCamera) -> _Scene:
        spread = log.column("spread_u") ** 2 + log.column("spread_v") ** 2
        return cls(spread, log.column("disparity_p90_px") / camera.baseline_m)

    def motion_px(self, extent_m: Array, k: Any) -> Array:
        """Image motion [px] at frame(s) k that translations (..., 3) along the camera's axes make of the near points:
        ``f / Z (t_xy - (x, y) t_z)``, in the mean square over the image coordinates (x, y) seen."""
        x, y, z = np.moveaxis(extent_m, -1, 0)
        return np.asarray(np.sqrt(x**2 + y**2 + self.spread[k] * z**2) * self.inverse_m[k])


def _waits(log: VoLog, T_est: Array, scene: _Scene) -> list[tuple[int, int]]:
    """First and last frame of the longest stretches at rest, one after the other."""
    found, first, t_ns, usable = [], 0, log.t_ns, log.usable
    may_begin = _nearby_later(t_ns, T_est, scene)
    while first < len(log) - 1:
        if may_begin[first]:
            last = _rests_until(first, log, usable, T_est, scene)
            if (t_ns[last] - t_ns[first]) * 1e-9 >= STILL_S:
                found.append((first, last))
                first = last
        first += 1
    return found


def _nearby_later(t_ns: NDArray[np.int64], T_est: Array, scene: _Scene) -> NDArray[np.bool_]:
    """(N,) whether a wait may begin: after ``STILL_S``, the vehicle is where it was. To find that out frame by frame
    takes long where it creeps."""
    later = np.searchsorted(t_ns, t_ns + round(STILL_S * 1e9))
    end = np.minimum(later, len(t_ns) - 1)
    here = np.einsum("ni,nij->nj", T_est[end, :3, 3] - T_est[:, :3, 3], T_est[:, :3, :3])
    beyond = scene.motion_px(here, end) > STILL_PX * (1 + 1e-6)  # what is unknown, NaN, is looked at
    return np.asarray((later < len(t_ns)) & ~beyond, dtype=np.bool_)


def _rests_until(first: int, log: VoLog, usable: NDArray[np.bool_], T_est: Array, scene: _Scene) -> int:
    """The last frame up to which the vehicle stands from the frame ``first`` on."""
    low, high, moments = np.zeros(3), np.zeros(3), ImuMoments.of(None)
    for k in range(first + 1, len(log)):
        here = (T_est[k, :3, 3] - T_est[first, :3, 3]) @ T_est[first, :3, :3]
        low, high = np.minimum(low, here), np.maximum(high, here)
        moments = moments.with_later(ImuMoments.of_record(log.records[k]))
        gyro, acc = np.sqrt(moments.variance).reshape(2, 3).max(axis=1)
        # Written so that what is unknown, NaN, is not at rest; an accelerometer may be missing.
        still = scene.motion_px(high - low, k) <= STILL_PX and gyro <= GYRO_STD_RADPS
        if not (usable[k] and still) or acc > ACC_STD_MPS2:
            return k - 1
    return len(log) - 1


def _extent(T_world_cam: Array) -> Array:
    """(3,) how far positions (n, 4, 4) spread along the axes of the first."""
    return np.ptp((T_world_cam[:, :3, 3] - T_world_cam[0, :3, 3]) @ T_world_cam[0, :3, :3], axis=0)


@dataclass(frozen=True)
class Stretch:
    """``first``, ``last``: indices of its motions in the log, which begin and end at ``t_ns`` (2,)."""

    first: int
    last: int
    t_ns: tuple[int, int]
    what: str

    def __str__(self) -> str:
        return f"motions {self.first} to {self.last}: {self.what}"


def odd_stretches(log: VoLog, truth: TruthLog) -> list[Stretch]:
    """Those of a log against its truth, in order of time; none where nothing moves."""
    errors = motion_errors(log, truth)
    true, seen = errors.T_true[:, :3, 3], errors.T_est[:, :3, 3]
    length = np.linalg.norm(true, axis=1)
    if len(length) < 2 * _LEAST_LONG or length.max() < _NOWHERE_M:
        return []
    rate_hz = 1 / float(np.median(errors.dt_s))
    short, long = (
        max(least, min(round(seconds * rate_hz), len(length) // 2))
        for least, seconds in ((_LEAST_SHORT, _SHORT_S), (_LEAST_LONG, _LONG_S))
    )
    stated = _stated_m(log, errors)
    share = (true * seen).sum(1) / np.maximum(length**2, _NOWHERE_M**2)
    usual = float(np.median(share[_moving(length, 1)]))
    error = seen - usual * true
    noise = _white_noise(np.column_stack([error, (share - usual) * length]), stated, long)
    found = _of_share(share, usual, length, noise[:, 3], short)
    for first, last, _ in found:  # what the share explains is not a matter of direction too
        error[first : last + 1] = 0.0
    found += _of_direction(error, true, noise[:, :3], long)
    spans = [(int(errors.index[a]), int(errors.index[b]), what) for a, b, what in found]
    return sorted(
        (Stretch(i, k, (log.records[i].t_prev_ns, log.records[k].t_ns), what) for i, k, what in spans),
        key=lambda s: s.t_ns,
    )


def _white_noise(errors: Array, stated: Array, count: int) -> Array:
    """(M, D) standard deviation of each error (M, D): what is stated tells motions apart; how large it is, the
    differences between neighbours tell, by their upper quartile over ``count`` around: no slip disturbs it."""
    steps = np.abs(np.diff(errors / stated[:, None], axis=0, append=0.0))
    steps[-1] = steps[-2]
    around = np.pad(steps, ((count // 2, (count - 1) // 2), (0, 0)), mode="symmetric")
    windows, rank = np.lib.stride_tricks.sliding_window_view(around, count, axis=0), 3 * count // 4
    blocks = (windows[k : k + 1000] for k in range(0, len(windows), 1000))  # all at once would fill the memory
    # Not their median: where noise steps up, half of them are still small.
    quartile = np.concatenate([np.partition(block, rank)[..., rank].copy() for block in blocks])
    return np.asarray(quartile / (1.1503 * np.sqrt(2)) * stated[:, None])


def _of_share(own: Array, usual: float, length: Array, noise: Array, count: int) -> list[tuple[int, int, str]]:
    """By each motion's share ``own`` (M,) of its true ``length`` (M,) [m], and its ``noise`` (M,) along that."""
    error = np.where(_moving(length, 1), (own - usual) * length, 0.0)
    z = moving_sums(error, count) / _noise_of_sums(noise, count)
    z /= max(1.0, float(_spread(z[_moving(length, count)])))
    found = []
    for first, last in _runs(_covered(np.abs(z) > _SIGMAS, count)):
        farthest = first + int(np.argmax(np.abs(z[first : last - count + 2])))
        level = float(np.median(own[farthest : farthest + count]))
        # The windows at either end hold motions like all others; a level is steady, what noise makes is not.
        alike = np.abs(own - level) < 0.5 * abs(level - usual)
        steady = [(a + first, b + first) for a, b in _runs(alike[first : last + 1])]
        k, m = max(steady, key=lambda run: run[1] - run[0], default=(0, -1))
        beyond = abs(error[k : m + 1].sum()) > _SIGMAS * np.sqrt((noise[k : m + 1] ** 2).sum())
        if m - k + 1 >= _LEAST_MOTIONS and abs(level - usual) > _LEAST_SHARE and beyond:
            level = float(np.mean(own[k : m + 1]))
            found.append((k, m, f"odometry shows {level:.2f} of the true motion, else {usual:.2f}"))
    return found


def _of_direction(error: Array, true: Array, noise: Array, count: int) -> list[tuple[int, int, str]]:
    """By the ``error`` (M, 3), with its ``noise`` (M, 3), of motions that are truly ``true`` (M, 3), across these."""
    length = np.linalg.norm(true, axis=1)
    moving, path = _moving(length, count), np.maximum(moving_sums(length, count), _NOWHERE_M)[:, None]
    summed = moving_sums(true, count)
    unit = summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), _NOWHERE_M)
    across = np.eye(3) - unit[:, :, None] * unit[:, None]  # (W, 3, 3) projection onto what lies across each window
    turn = np.einsum("wij,wj->wi", across, moving_sums(error, count)) / path
    usual = np.median(turn[moving], axis=0)
    # Noise along one axis, as depth's, lies partly along another of what is across.
    noise_m = np.sqrt(np.einsum("wij,wj->wi", across**2, _noise_of_sums(noise, count) ** 2))
    allowed = np.maximum(_spread(turn[moving] - usual), noise_m / path)
    # What a single motion makes of a window, on whatever axis lies across it, is a slip: it says nothing of the others.
    size = np.linalg.norm(error, axis=1)
    single = np.lib.stride_tricks.sliding_window_view(size, count).max(axis=-1)[:, None] / path
    off = moving & (np.abs(turn - usual) - single > np.maximum(_SIGMAS * allowed, _LEAST_TURN)).any(axis=1)
    found = []
    for first, last in _runs(_covered(off, count)) if off.mean() <= _MOST else []:
        here = turn[first : last - count + 2][off[first : last - count + 2]].mean(axis=0) - usual
        degrees = float(np.rad2deg(np.arctan(np.linalg.norm(here))))
        axis = ("sideways", "vertically", "in depth")[int(np.argmax(np.abs(here)))]
        found.append((first, last, f"truth leaves odometry's direction by {degrees:.1f} deg, {axis}"))
    return found


def _moving(length: Array, count: int) -> NDArray[np.bool_]:
    """Which windows are not slow beside the upper quartile: most of a sequence may be at rest, or truth jump."""
    least = max(0.4 * float(np.quantile(length, 0.75)), 0.5 * _NOWHERE_M)
    return np.asarray(moving_sums(length, count) > least * count)


def _spread(values: Array) -> Array:
    """Robust standard deviation, by column, of what lies around zero."""
    return np.asarray(1.4826 * np.median(np.abs(values), axis=0))


def _noise_of_sums(noise: Array, count: int) -> Array:
    """(W, D) what white noise makes of sums over windows."""
    return np.sqrt(np.maximum(moving_sums(noise**2, count), _NOWHERE_M**2))


def _covered(off: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """(M,) which motions lie in one of the windows (W,) of ``count``: windows that overlap are one stretch."""
    return np.convolve(off, np.ones(count)) > 0.5


def _runs(off: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last of each run."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _stated_m(log: VoLog, errors: MotionErrors) -> Array:
    """(M,) what odometry says of its own noise, by the first covariance that all motions have and their residuals."""
    covariances = (log.covariance(m)[errors.index] for m in log.methods)
    known = next((C for C in covariances if not np.isnan(C).all(axis=(1, 2)).any()), None)
    if known is None:
        return np.ones(len(errors.index))
    stated = np.sqrt(np.trace(known[:, :3, :3], axis1=1, axis2=2))
    noise_px = log.column("reproj_rms_px")[errors.index]
    return np.maximum(stated * np.where(np.isfinite(noise_px), np.maximum(noise_px, 1e-3), 1.0), _NOWHERE_M)

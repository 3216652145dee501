"""``gpvo doctor``: what is wrong with anyone's odometry, of a bag or a live topic, and what filters make of it.

robot_localization: src/ros_filter.cpp, src/ekf.cpp (variances below 1e-9 become 1e-9, negative ones positive, NaN is
not checked for). PX4: src/modules/ekf2/EKF/aid_sources/external_vision and params_external_vision.yaml (floors).
ArduPilot: libraries/GCS_MAVLink/GCS_Common.cpp, AP_VisualOdom_MAV.cpp (clamps). FusionCore: what is stated drives its
chi-square gate, zeros fall back to parameters, off-diagonal elements are not read.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError, SourceError, counted, printable
from gpvo.geometry import se3
from gpvo.geometry.covariance import LARGEST, are_covariances, variances
from gpvo.io.bag_messages import covariances_of, pose_of
from gpvo.io.bag_reader import POSE_TYPES, is_bag, messages, open_bag, stamp_ns, topics_of
from gpvo.io.trajectory import FARTHEST_M
from gpvo.live import WIRES
from gpvo.live.intake import Mailbox, arrivals
from gpvo.live.job import open_wire
from gpvo.live.outputs import decode
from gpvo.types import Array

_ENOUGH = 10  # messages that there must be to judge
_LEAST, _MOST = 0.02, 300.0  # jitter of frames cancels in the pose; a bias adds up over as many frames as it lasts
_SWAPPED = "every consumer reads metres where there are radians, and vice versa"
_UNLIKE = 0.7  # of the motion over a second
_HUGE, _TINY = 1e3, 0.999e-9  # 1e-9 in single precision is good
_ZERO_FALLBACK = "FusionCore uses its parameters instead (pose: 0.1 m and 0.02 rad)"
_RL_FLOOR = "robot_localization uses 1e-9, a sigma of 0.03 mm, and ignores everything else"
_PX4_FLOOR = "PX4 uses EKF2_EVP_NOISE, EKF2_EVV_NOISE and EKF2_EVA_NOISE (0.1) instead"
_AP_FLOOR = "ArduPilot uses VISO_POS_M_NSE (0.2 m) and VISO_YAW_M_NSE (0.2 rad)"
_DEPTH = 10_000  # messages of a live topic that may wait


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: ``code`` for scripts, what was seen, and what each consumer makes of it."""

    code: str
    what: str
    consequence: str
    share: float = 1.0

    @classmethod
    def where(cls, bad: Any, code: str, what: str, consequence: str) -> Iterator[Finding]:
        """Of the messages that are ``bad`` (N,); none where none is."""
        if bad.any():
            yield cls(code, what, consequence, float(bad.mean()))

    def __str__(self) -> str:
        part = "" if self.share >= 1.0 else f" ({100 * self.share:.3g} % of the messages)"
        return f"{self.code}: {self.what}{part}\n    {self.consequence}"


@dataclass(frozen=True)
class Stated:
    """A recording of one topic. ``T`` (N, 4, 4); ``pose``, ``twist`` (N, 6, 6) or None where the type has none; ``v``
    (N, 6) the twist, None likewise; ``quaternion_norm`` (N,); ``frames``: the pairs of frame names that occur.
    """

    t_ns: np.ndarray
    T: Array
    quaternion_norm: Array
    frames: tuple[tuple[str, str], ...]
    pose: Array | None
    twist: Array | None
    v: Array | None

    @classmethod
    def of(cls, messages: Iterable[Any], where: object = None) -> Stated:
        """From messages of a bag ``where``, in the order of their arrival. GpvoError where there are fewer than ten."""
        kept = list(messages)
        if len(kept) < _ENOUGH:
            what = f"{counted(len(kept), 'message')}: too few to judge"
            raise GpvoError(what, where=where, cure=f"record at least {_ENOUGH}")
        rows = np.array([pose_of(m) for m in kept])
        norm = np.linalg.norm(rows[:, 3:], axis=1)
        near = np.abs(rows[:, :3]).max(axis=1) < FARTHEST_M  # false for NaN
        good = near & np.isfinite(rows).all(axis=1) & (norm > 1e-6)
        T = np.tile(np.full((4, 4), np.nan), (len(rows), 1, 1))
        T[good] = se3.from_quaternion(rows[good, :3], rows[good, 3:] / norm[good, None])
        pairs = ((m.header.frame_id, getattr(m, "child_frame_id", "-")) for m in kept)
        frames = dict.fromkeys((printable(parent), printable(child)) for parent, child in pairs)
        v = [_twist(m) for m in kept] if hasattr(kept[0], "twist") else None
        # What is beyond all measure is as good as infinite, and squares of the rest stay finite.
        stated = (covariances_of(kept, name) for name in ("pose", "twist"))
        pose, twist = (None if C is None else np.where(np.abs(C) >= LARGEST, np.inf, C) for C in stated)
        t_ns = np.array([stamp_ns(m) for m in kept], dtype=np.int64)
        return cls(t_ns, T, norm, tuple(frames), pose, twist, None if v is None else np.array(v))

    def dated(self) -> Stated:
        """The messages with a stamp: one without would begin or end a motion of decades."""
        rows = {name: value[self.t_ns != 0] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **rows)


def _twist(message: Any) -> list[float]:
    a, b = message.twist.twist.linear, message.twist.twist.angular
    return [a.x, a.y, a.z, b.x, b.y, b.z]


def examine_bag(path: Path, topic: str | None = None) -> dict[str, list[Finding]]:
    """Findings of a topic, or of every topic that holds poses. SourceError for what is no bag, or has no such topic."""
    if not path.exists() or not is_bag(path):
        what = "is not a bag" if path.exists() else "no such bag"
        raise SourceError(what, where=path, cure=f"for a running topic add --{', --'.join(WIRES)}")
    with open_bag(path) as reader:
        found = list(topics_of(reader, POSE_TYPES))
        if not found:
            raise SourceError("holds no poses to check", where=path, cure="'gpvo run' makes odometry of images")
        if topic is not None and topic not in found:
            raise SourceError(f"has no poses on '{topic}' (poses on: {', '.join(found)})", where=path)
        wanted = found if topic is None else [topic]
        return {t: examine(Stated.of((m for _, m in messages(reader, [t])), path)) for t in wanted}


def examine_topic(
    wire: str, topic: str, msgtype: str, seconds: float, address: str | None = None, domain: int = 0
) -> list[Finding]:
    """Findings about what a running system publishes within ``seconds``. GpvoError if nothing is received."""
    link, mailbox, stop = open_wire(wire, address, domain), Mailbox(_DEPTH), threading.Event()
    kept: list[Any] = []
    try:
        link.subscribe(topic, msgtype, lambda name, data: mailbox.put(name, data))
        end_s = time.monotonic() + seconds
        for arrival in arrivals(mailbox, lambda _, data: decode(link, data, msgtype), stop, Counter()):
            kept += [] if arrival is None else [arrival.message]
            if time.monotonic() > end_s:
                break
    finally:
        link.close()
    if not kept:
        raise GpvoError(f"nothing received on '{topic}' in {seconds:g} s", cure="is it published, and of that type?")
    return examine(Stated.of(kept))


def examine(stated: Stated) -> list[Finding]:
    """Everything that is wrong with a recording, worst first; empty for a good one."""
    dated = stated.dated()
    motions = _motions(dated)
    found = [*_stamps(stated), *_frames(stated), *_poses(stated), *(_jumps(*motions[1:]) if motions else ())]
    if stated.pose is None and stated.twist is None:
        found.append(Finding("no-covariance", "the message type has no covariance", _PX4_FLOOR))
    for name, C in (("pose", stated.pose), ("twist", stated.twist)):
        found += () if C is None else _matrices(name, C)
    return [*found, *(_pose_against_twist(dated, *motions) if motions else ())]


def _matrices(name: str, C: Array) -> Iterator[Finding]:
    """Findings about each matrix on its own."""
    if (bad := ~np.isfinite(C).all(axis=(1, 2))).any():
        text = "robot_localization does not check, so its state becomes NaN; ArduPilot checks only element 0 for NaN"
        yield from Finding.where(bad, f"{name}-not-finite", f"the {name}'s covariance holds NaN or infinity", text)
        return
    D, scale = variances(C), np.abs(C).max(axis=(1, 2))[:, None, None]
    symmetric = (np.abs(C - np.swapaxes(C, 1, 2)) <= 1e-6 * scale).all(axis=(1, 2))
    zero = (C == 0).all(axis=(1, 2))
    if zero.all():
        text = f"{_RL_FLOOR}; {_PX4_FLOOR}; {_AP_FLOOR}; {_ZERO_FALLBACK}"
        yield Finding(f"{name}-zero", f"the {name}'s covariance is zero throughout: 'unknown' stated as certain", text)
        return
    sound = (D > 0).all() and symmetric.all()
    checks: list[tuple[str, str, Any, str]] = [
        ("some-zero", "variances of the {} are exactly zero", (D == 0).any(axis=1), f"{_RL_FLOOR}; {_ZERO_FALLBACK}"),
        ("negative", "variances of the {} are negative", (D < 0).any(axis=1),
         "robot_localization takes the absolute value; PX4 and ArduPilot take their floors; Cholesky fails elsewhere"),
        ("tiny", "variances of the {} are below 1e-9: a placeholder, not a measurement",
         ((D > 0) & (D < _TINY)).any(axis=1), f"{_RL_FLOOR}; {_PX4_FLOOR}; FusionCore's gate rejects good twists"),
        ("huge", "variances of the {} are above 1e3 (9999, 1e6: 'unknown' or 'lost')", (D > _HUGE).any(axis=1),
         "no filter knows the flag: robot_localization fuses it with almost no weight and its correlations blow up; "
         "ArduPilot clamps it at 100 m and 1.5 rad and goes on fusing"),
        ("asymmetric", "the {}'s covariance is not symmetric", ~symmetric,
         "filters read different halves: PX4 and ArduPilot the diagonal, robot_localization all of it"),
        ("not-positive", "the {}'s covariance is not positive definite", ~are_covariances(C) & sound,
         "its correlations are impossible: robot_localization's gain goes wrong, Cholesky factorisation fails"),
    ]  # fmt: skip
    for code, what, bad, text in checks:
        yield from Finding.where(bad, f"{name}-{code}", what.format(name), text)
    if np.ptp(C, axis=0).max() == 0.0:
        text = "every frame has the same weight, in bad light and in good: a gate passes bad frames and drops good ones"
        yield Finding(f"{name}-constant", f"the {name}'s covariance never changes", text)
    elif len(np.unique(D.round(12), axis=0)) <= 4 < len(D) // 4:
        text = "a few levels only (such as a tracker's confidence): most of what the source knows is lost"
        yield Finding(f"{name}-levels", f"the {name}'s covariance takes four values or fewer", text)


def _stamps(s: Stated) -> Iterator[Finding]:
    text = "every consumer dates the measurement to the epoch and drops it"
    yield from Finding.where(s.t_ns == 0, "stamp-zero", "stamps are zero", text)
    steps = np.diff(s.t_ns[s.t_ns != 0])
    text = "robot_localization drops or replays them; PX4 and ArduPilot use them as they are"
    yield from Finding.where(steps < 0, "stamp-backward", "stamps go backward", text)
    text = "the same measurement is fused twice: the filter becomes overconfident"
    yield from Finding.where(steps == 0, "stamp-repeated", "stamps repeat", text)
    good = steps[steps > 0]
    if len(good) and good.max() > 10 * np.median(good):
        what = f"a gap of {good.max() * 1e-9:.2f} s, at {1e9 / np.median(good):.0f} Hz"
        text = "motion across a gap was not measured: the first message after it must say so"
        yield Finding("stamp-gap", what, text)


def _frames(s: Stated) -> Iterator[Finding]:
    text = "robot_localization cannot transform it and drops every message"
    if len(s.frames) > 1:
        yield Finding("frame-changes", f"frames change: {s.frames}", text)
    frame, child = s.frames[0]
    if not frame or not child:
        yield Finding("frame-empty", f"frame_id '{frame}', child_frame_id '{child}'", text)
    elif frame == child:
        text = "pose and twist lose their meaning"
        yield Finding("frame-same", f"frame_id and child_frame_id are both '{frame}'", text)
    elif "optical" in child:
        text = "twist and rotations are in axes with z forward: robot_localization needs TF to base_link"
        yield Finding("frame-optical", f"child_frame_id is '{child}', an optical frame", text)


def _poses(s: Stated) -> Iterator[Finding]:
    bad = ~np.isfinite(s.T).all(axis=(1, 2))
    what = "poses hold NaN, or absurdly large numbers"
    yield from Finding.where(bad, "pose-not-finite", what, "robot_localization drops them")
    off = np.abs(s.quaternion_norm - 1.0) > 1e-2
    if (off & ~bad).any():
        text = "robot_localization normalises with a warning, PX4 rejects the attitude"
        yield Finding("quaternion-norm", "quaternions are not of unit length", text, float(off.mean()))


def _jumps(steps: Array, dt: Array) -> Iterator[Finding]:
    speed = np.linalg.norm(steps[:, :3], axis=1) / dt
    jumps = speed > max(20 * float(np.median(speed)), 20.0)
    if jumps.any():
        size = float(np.linalg.norm(steps[jumps][:, :3], axis=1).max())
        what = f"{counted(int(jumps.sum()), 'jump')} of the pose, up to {size:.2g} m"
        text = "odometry must be continuous (REP 105): a differential pose fuses the jump as speed"
        yield Finding("pose-jump", what, text)


def _motions(s: Stated) -> tuple[NDArray[np.intp], Array, Array] | None:
    """Between messages whose stamps grow: indices (M,) of those where a motion ends, motions (M, 6) in the axes of the
    moving frame, and their durations (M,) [s]; None of fewer than ten."""
    dt = np.diff(s.t_ns) * 1e-9
    whole = np.asarray(np.isfinite(s.T).all(axis=(1, 2)))
    (start,) = np.nonzero((dt > 0) & whole[1:] & whole[:-1])
    if len(start) < _ENOUGH:
        return None
    return start + 1, se3.log(se3.inverse(s.T[start]) @ s.T[start + 1]), dt[start]


def _pose_against_twist(s: Stated, end: NDArray[np.intp], steps: Array, dt: Array) -> Iterator[Finding]:
    """What shows only when one part of the message is compared with another."""
    if s.v is not None and np.isfinite(s.v).all():
        moved = steps / dt[:, None]
        of_twist = list(_twist_against_motion(s.v[end], s.T[end, :3, :3], moved))
        yield from of_twist or _unlike(s.v[end], moved, dt)
    found: list[Finding] = []
    for name, C in (("pose", s.pose), ("twist", s.twist)):
        if C is not None and np.isfinite(C).all():
            found += [*_turned(name, C, s.T[:, :3, :3]), *_blocks(name, C)]
    yield from found
    if not any(f.code == "pose-swapped" for f in found):
        yield from _heading(s)
    if s.pose is not None and s.twist is not None:
        yield from _growth(s.pose, s.twist, np.diff(s.t_ns) * 1e-9)


def _usable(C: Array) -> bool:
    return bool(np.isfinite(C).all() and (variances(C) > 0).all() and np.ptp(C, axis=0).max() > 0)


def _twist_against_motion(said: Array, R: Array, moved: Array) -> Iterator[Finding]:
    """Twists (M, 6) at attitudes ``R`` (M, 3, 3), and velocities (M, 6) from the poses."""
    size = float(np.linalg.norm(moved[:, :3], axis=1).mean())
    if size < 0.05:
        return
    if not said.any():
        text = "a filter that fuses the twist is told to stand still"
        yield Finding("twist-empty", "the twist is zero while the pose moves", text)
        return
    in_parent = np.einsum("nij,nj->ni", R, moved[:, :3])
    own, other = (float(np.linalg.norm(said[:, :3] - m, axis=1).mean()) for m in (moved[:, :3], in_parent))
    if other < 0.5 * own and own > 0.2 * size:
        text = (
            "robot_localization rotates it once more by the heading; MAVLink receivers take it to be in the body frame"
        )
        yield Finding("twist-in-parent", "the twist is in frame_id's axes, not in child_frame_id's", text)
        return
    ratio = float(np.linalg.norm(said[:, :3], axis=1).mean()) / size
    if not 0.5 < ratio < 2.0:
        text = "the twist is per frame, in another unit, or on another clock"
        yield Finding("twist-scale", f"the twist is {ratio:.3g} times the motion of the pose", text)


def _unlike(said: Array, moved: Array, dt: Array) -> Iterator[Finding]:
    """Twists (M, 6) that are of other axes, signs or units than velocities (M, 6) from the poses, both taken over
    seconds, so that the noise of single poses cancels."""
    first = np.unique(np.floor(np.cumsum(dt)), return_index=True)[1]
    a, b = (np.add.reduceat(v * dt[:, None], first) for v in (said, moved))
    for name, part in (("linear", slice(3)), ("angular", slice(3, 6))):
        size = np.linalg.norm(b[:, part], axis=1)
        moves = size > 0.05  # [m] or [rad]; the median, as a jump of the pose is no fault of the twist
        if moves.sum() < 3:
            continue
        apart = float(np.median(np.linalg.norm((a - b)[moves, part], axis=1) / size[moves]))
        if apart > _UNLIKE:
            what = f"the {name} twist differs from the motion of the pose by {apart:.2g} times the motion"
            text = (
                "one of both is wrong for every consumer: axes (optical or FRD where child_frame_id is FLU), a sign,"
                " degrees, zeros for 'unknown', another clock, or a pose with its quaternion not x y z w, or inverse"
            )
            yield Finding(f"twist-{name}-unlike", what, text)


def _blocks(name: str, C: Array) -> Iterator[Finding]:
    """Rotation before translation: radians squared where metres squared belong."""
    D = np.median(variances(C), axis=0)
    first, second = D[:3].mean(), D[3:].mean()
    if (variances(C) > 0).all() and second > 100 * first and 0.05 < second < _HUGE:
        seen = f"{first:.2g} m^2 before {second:.2g} rad^2"
        what = f"the {name}'s blocks look swapped: {seen} (order is translation first)"
        yield Finding(f"{name}-swapped", what, _SWAPPED)


def _heading(s: Stated) -> Iterator[Finding]:
    """A wrong heading carries the position off with it: the position's variance grows with the distance travelled.

    If the heading's error is a random walk, the position's variance across the path is a third of the heading's
    variance times the distance squared; a hundredth of the sum over the axes is out of the question.
    """
    if s.pose is None or not _usable(s.pose) or not np.isfinite(s.T[[0, -1]]).all():
        return
    D = variances(s.pose)
    gained = D[-1] - D[0]
    way_m = float(np.linalg.norm(s.T[-1, :3, 3] - s.T[0, :3, 3]))
    if gained[3:].min() > 0 and way_m > 1.0 and gained[:3].sum() < 0.01 * gained[3:].sum() * way_m**2:
        what = f"the rotation's variance grows by {gained[3:].sum():.2g} rad^2 over {way_m:.0f} m, the position's by"
        yield Finding("pose-swapped", f"{what} {gained[:3].sum():.2g} m^2 only: blocks swapped?", _SWAPPED)


def _turned(name: str, C: Array, R: Array) -> Iterator[Finding]:
    """Variances rotated like the components of a vector, ``R d`` instead of ``R diag(d) R^T``."""
    off = C[:, ~np.eye(6, dtype=bool)]
    d = variances(C)[:, :3]
    good = np.isfinite(R).all(axis=(1, 2))
    if off.any() or good.sum() < _ENOUGH or np.ptp(np.abs(d), axis=0).max() < 1e-2 * np.abs(d).max():
        return
    for turn in (R, np.swapaxes(R, 1, 2)):
        back = np.einsum("nij,nj->ni", turn[good], d[good])
        if np.ptp(back, axis=0).max() < 1e-6 * np.abs(back).max():
            text = "a body that turns makes them negative or wrong for every consumer; rotate them by R C R^T"
            yield Finding(f"{name}-turned", f"the {name}'s variances are rotated as if they were a vector", text)
            return


def _growth(pose: Array, twist: Array, dt: Array) -> Iterator[Finding]:
    """Over the recording, a pose's covariance should grow by about what the twist's says."""
    if np.array_equal(pose, twist) and pose.any():
        text = "one of them is wrong: the pose's is in m^2 and rad^2, the twist's in their squares per second"
        yield Finding("pose-equals-twist", "pose and twist state the same covariance", text)
        return
    if not (_usable(pose) and _usable(twist)):
        return
    gained = float((variances(pose)[-1] - variances(pose)[0])[3:].sum())
    walked = float((variances(twist)[1:, 3:] * dt[:, None] ** 2).sum())
    if gained > 0 and not _LEAST < gained / walked < _MOST:
        text = "fuse only one of them: the other is far off (a covariance per frame is not per second)"
        what = f"the rotation's variance in the pose grows {gained / walked:.1g} times as much as the twist's says"
        yield Finding("pose-against-twist", what, text)

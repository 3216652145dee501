"""From records to features: the one path that flight and training share.

Impossible motions are marked ``lost``, with the reason, and leave no trace in the memory. Motions over a window are
joined into records, so that features and targets need no second definition.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry import covariance as transport
from gpvo.geometry import se3
from gpvo.online.features import FeatureStream
from gpvo.online.slip import SlipDetector
from gpvo.stats.series import Doubt
from gpvo.types import COUNT_FIELDS, FLOAT_FIELDS, IMU_FIELDS, Array, Status, StereoCamera, Vehicle, VoRecord

LONGEST_STEP_S = 60.0
"""A record that comes later than this after the previous one is believed only once the next one confirms its clock."""
_LONGEST_STEP_NS = round(LONGEST_STEP_S * 1e9)
_FARTHEST_M = 1e5  # No motion between two frames is longer.
_EYE = np.eye(4)
_EYE.setflags(write=False)
MOST_MOTIONS = 1000
"""In a window: to join them anew with each frame takes 40 us a motion."""
_PATTERN = re.compile(r"(window|length):([0-9]*\.?[0-9]+)(s|m)")


class Observer:
    """Judges stamps, flags slips, joins motions over a window, computes features: record by record, causally.

    ``names``: feature columns. ``target``: ``frame``, ``window:1s``, ``length:1m`` or ``position``. ``vehicle``: the
    bounds by which its motions are judged.
    """

    def __init__(
        self,
        names: Sequence[str],
        target: str = "frame",
        camera: StereoCamera | None = None,
        vehicle: Vehicle | None = None,
    ) -> None:
        self._intake = Intake()
        self.slip = SlipDetector(vehicle)
        self._window = Window.of(target)
        self._stream = FeatureStream(names, camera)

    def step(self, record: VoRecord) -> tuple[VoRecord, Array] | None:
        """The record as judged (or as joined over the window) and its features (d,); None while a window fills."""
        judged = self.slip.step(self._intake.step(record))
        joint = judged if self._window is None else self._window.step(judged)
        return None if joint is None else (joint, self._stream.step(joint))


class Intake:
    """Judges the stamps and the motion of one record after the other, in the order of their arrival.

    A record whose stamp repeats, goes back or jumps ahead is ``lost``, and the next one is judged by the record before
    it; if that next one follows the odd one, the clock itself was set, and is believed. A motion that is not finite
    and rigid is dropped.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._doubt: Doubt[int] = Doubt()

    def step(self, record: VoRecord) -> VoRecord:
        """The record, ``lost`` with the reason if it is impossible. Call once per record."""
        problem = self._clock(record)
        if record.T_prev_cur.shape != (4, 4) or not se3.is_rigid(record.T_prev_cur, _FARTHEST_M):
            record = replace(record, T_prev_cur=_EYE)
            problem = problem or "the motion is not finite and rigid"
        return record.with_status(Status.LOST, problem) if problem else record

    def _clock(self, record: VoRecord) -> str:
        t_ns, last_ns = record.t_ns, self._last_ns
        if (
            last_ns is not None
            and record.status is not Status.START
            and not (follows(last_ns, t_ns) or self._doubt.is_settled_by(t_ns, follows))
        ):
            step_s = (t_ns - last_ns) * 1e-9
            return "the stamp repeats" if step_s == 0 else f"the stamp jumps by {step_s:+.3g} s"
        self._last_ns = t_ns
        self._doubt.clear()
        if record.usable and record.t_prev_ns >= t_ns:
            return "the motion ends no later than it begins"
        return ""


def follows(before_ns: int, t_ns: int) -> bool:
    """Whether a stamp comes after the one before, and not too long after."""
    return 0 < t_ns - before_ns <= _LONGEST_STEP_NS


class Window:
    """Joins the latest motions into one that spans ``size`` seconds or metres, frame by frame and causally.

    ``kind`` is "window" (seconds) or "length" (metres of path). A window of metres holds at most ``MOST_MOTIONS``: a
    vehicle that stands would need ever more for one.
    """

    def __init__(self, kind: str, size: float) -> None:
        self.kind, self.size = kind, size
        self._motions: deque[tuple[VoRecord, float]] = deque(maxlen=MOST_MOTIONS if kind == "length" else None)

    @classmethod
    def of(cls, target: str) -> Window | None:
        """The window of a target such as ``window:1s`` or ``length:1m``; None for ``frame`` and ``position``."""
        if target in ("frame", "position"):
            return None
        match = _PATTERN.fullmatch(target)
        if match is None or (match[1] == "window") != (match[3] == "s") or float(match[2]) <= 0:
            raise GpvoError(f"unknown target '{target}'", cure="frame, window:1s, length:1m or position")
        return cls(match[1], float(match[2]))

    def step(self, record: VoRecord) -> VoRecord | None:
        """The motion over the window that ends with this record; None until it is full. A lost frame empties it."""
        if not record.usable:
            self._motions.clear()
            return None
        # Where the reference is an older frame, the motions that came after it are dropped.
        while self._motions and self._motions[-1][0].t_ns != record.t_prev_ns:
            self._motions.pop()
        long = record.dt_s if self.kind == "window" else float(np.linalg.norm(record.T_prev_cur[:3, 3]))
        self._motions.append((deepcopy(record), long))  # its giver may write the next motion into the same arrays
        enough = self.size * (1 - 1e-9)
        while len(self._motions) > 1 and self._extent() - self._motions[0][1] >= enough:
            self._motions.popleft()
        return joined([r for r, _ in self._motions]) if self._extent() >= enough else None

    def _extent(self) -> float:
        return sum(long for _, long in self._motions)


def joined(motions: list[VoRecord]) -> VoRecord:
    """One record for consecutive motions: compounded motion and covariances, means of what describes the images."""
    last = motions[-1]
    T = np.eye(4)
    covariances: dict[str, Array] = dict.fromkeys(last.covariances, np.zeros((6, 6)))
    for r in motions:
        T = T @ r.T_prev_cur
        covariances = {
            m: transport.symmetrise(transport.compound(r.T_prev_cur, C, r.covariances[m]))
            for m, C in covariances.items()
            if m in r.covariances
        }
    status = max((r.status for r in motions), key=lambda s: s.severity)
    known: dict[str, Any] = {name: float(np.mean([getattr(r, name) for r in motions])) for name in FLOAT_FIELDS}
    counts = {name: [getattr(r, name) for r in motions] for name in COUNT_FIELDS}
    known |= {name: int(np.mean(of)) if min(of) >= 0 else -1 for name, of in counts.items()}
    known |= {
        n: None if any(getattr(r, n) is None for r in motions) else np.mean([getattr(r, n) for r in motions], axis=0)
        for n in IMU_FIELDS
    }
    return replace(
        last,
        t_prev_ns=motions[0].t_prev_ns,
        T_prev_cur=T,
        status=status,
        covariances=covariances,
        v_t={},
        shared={},
        **known,
    )

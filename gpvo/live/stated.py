"""What a topic stated, message by message, as :mod:`gpvo.live.doctor` examines it, and what is found wrong with it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpvo.errors import GpvoError, counted, printable
from gpvo.geometry import se3
from gpvo.geometry.covariance import LARGEST
from gpvo.io.bag_messages import covariances_of, pose_of
from gpvo.io.bag_reader import stamp_ns
from gpvo.io.trajectory import FARTHEST_M
from gpvo.types import Array

ENOUGH = 10
"""Messages that there must be to judge."""


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
        part = "" if self.share >= 1.0 else f" ({100 * self.share:.0f} % of the messages)"
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
        if len(kept) < ENOUGH:
            what = f"{counted(len(kept), 'message')}: too few to judge"
            raise GpvoError(what, where=where, cure=f"record at least {ENOUGH}")
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


def _twist(message: Any) -> list[float]:
    a, b = message.twist.twist.linear, message.twist.twist.angular
    return [a.x, a.y, a.z, b.x, b.y, b.z]

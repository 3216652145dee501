"""Odometry of a robot's base frame, by the transforms that ROS publishes on /tf and /tf_static."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from gpvo.errors import printable
from gpvo.geometry import se3
from gpvo.io.bag_reader import pose_of
from gpvo.io.trajectory import FARTHEST_M
from gpvo.live.intake import Arrival
from gpvo.live.stages import Stage, Taken
from gpvo.types import Array, StereoCamera

TF_TYPE = "tf2_msgs/msg/TFMessage"
TF_STATIC = "/tf_static"
TF_TOPICS = ("/tf", TF_STATIC)
_MOST_FRAMES = 1000
_MOVED_M, _MOVED_RAD = 5e-3, 5e-3


class FrameTree:
    """The tree of frames in ``tf2_msgs/TFMessage``; of each frame the newest place on its parent holds.

    ``refused``: how many transforms were not finite, no rotation, or of a frame on itself.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._places: dict[str, tuple[str, Array]] = {}  # child: parent, T_parent_child

    def take(self, message: Any) -> None:
        """The transforms of one message."""
        for transform in message.transforms:
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            row = pose_of(transform)
            good = np.isfinite(row).all() and abs(np.linalg.norm(row[3:]) - 1.0) < 0.1
            is_full = child not in self._places and len(self._places) >= _MOST_FRAMES
            if not good or np.abs(row[:3]).max() > FARTHEST_M or parent == child or is_full:
                self.refused += 1
                continue
            self._places[child] = (parent, se3.from_quaternion(row[:3], row[3:]))

    def transform(self, target: str, source: str) -> Array | None:
        """T_target_source (4, 4); None where no chain of transforms joins the two frames."""
        to_target, to_source = self._ancestors(target), self._ancestors(source)
        common = next((name for name in to_target if name in to_source), None)
        return None if common is None else se3.inverse(to_target[common]) @ to_source[common]

    def _ancestors(self, name: str) -> dict[str, Array]:
        """The frame itself and all above it, nearest first, with T_ancestor_frame."""
        T, out = np.eye(4), {name: np.eye(4)}
        while name in self._places and self._places[name][0] not in out:
            name, T_parent = self._places[name][0], self._places[name][1]
            T = T_parent @ T
            out[name] = T
        return out


class BaseFrameStage:
    """A stage whose odometry is that of the frame ``base``, which sits rigidly on the frame that the source names.

    The place is read once, from the first transforms that join the two; messages of before are dropped and counted
    (``unplaced``). If the transforms say something else later, that is a problem, and the first place stays.
    """

    def __init__(self, inner: Stage, base: str) -> None:
        self.inner, self.base, self.topic = inner, frame_name(base), inner.topic
        self.counts: Counter[str] = inner.counts
        self.method = inner.method
        self._tree = FrameTree()
        self._source: str | None = None
        self._T_base_source: Array | None = None
        self._has_moved = False

    @property
    def camera(self) -> StereoCamera | None:
        """Of the images; None for poses."""
        return self.inner.camera

    @property
    def T_source_cam(self) -> Array:
        """As the stage within has it."""
        return self.inner.T_source_cam

    @property
    def T_body_cam(self) -> Array:
        """Camera to base; of a base that has no place yet, to the source's frame."""
        return self.T_source_cam if self._T_base_source is None else self._T_base_source @ self.T_source_cam

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """What the stage within takes, once the place of the base is known."""
        if arrival.topic in TF_TOPICS:
            self._tree.take(arrival.message)
            self.counts["tf_refused"] = self._tree.refused
            self._look_again()
            return
        if arrival.topic == self.topic and not self._is_placed(arrival.message):
            self.counts["unplaced"] += 1
            return
        yield from map(self._of_base, self.inner.take(arrival))

    def flush(self) -> Iterator[Taken]:
        """What waited in the stage within."""
        yield from map(self._of_base, self.inner.flush())

    def reset(self) -> None:
        """Begin anew with the next message; the place of the base holds."""
        self.inner.reset()

    def problems(self) -> list[str]:
        """What the transforms do not say, or say in two ways."""
        joined = f"{printable(self.base)} to {printable(self._source or '')}"
        if self._source is not None and self._T_base_source is None:
            return [f"no transform from {joined} on /tf_static or /tf", *self.inner.problems()]
        moved = [f"the transform from {joined} changes: the mounting must be rigid"] if self._has_moved else []
        return moved + self.inner.problems()

    def _is_placed(self, message: Any) -> bool:
        if self._T_base_source is None:
            self._source = frame_name(getattr(message, "child_frame_id", message.header.frame_id))
            self._T_base_source = self._tree.transform(self.base, self._source)
        return self._T_base_source is not None

    def _look_again(self) -> None:
        if self._T_base_source is None or self._source is None:
            return
        now = self._tree.transform(self.base, self._source)
        if now is not None:
            change = np.abs(se3.log(se3.inverse(self._T_base_source) @ now))
            self._has_moved = bool(change[:3].max() > _MOVED_M or change[3:].max() > _MOVED_RAD)

    def _of_base(self, taken: Taken) -> Taken:
        T = taken.T_parent_body
        if T is not None and self._T_base_source is not None:
            T = T @ se3.inverse(self._T_base_source)
        return replace(taken, T_parent_body=T, child_frame_id=self.base)


def frame_name(name: object) -> str:
    """Of a frame, without ROS 1's leading slash."""
    return str(name).removeprefix("/")

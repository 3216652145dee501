"""Motions over a window of time or length, as records: features and targets then need no second definition."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry import covariance as transport
from gpvo.types import Array, Status, VoRecord

_MEANS = (
    "reproj_rms_px",
    "disparity_p10_px",
    "disparity_p50_px",
    "disparity_p90_px",
    "spread_u",
    "spread_v",
    "log10_condition",
    "brightness",
    "contrast",
    "sharpness",
    "noise_level",
)
_COUNTS = ("n_detected", "n_stereo", "n_tracked", "n_inliers")
_IMU = ("imu_gyro_mean_radps", "imu_gyro_std_radps", "imu_acc_mean_mps2", "imu_acc_std_mps2")
_PATTERN = re.compile(r"(window|length):([0-9]*\.?[0-9]+)(s|m)")


class Window:
    """Joins the latest motions into one that spans ``size`` seconds or metres, frame by frame and causally.

    ``kind`` is "window" (seconds) or "length" (metres of path).
    """

    def __init__(self, kind: str, size: float) -> None:
        self.kind, self.size = kind, size
        self._motions: deque[VoRecord] = deque()

    @classmethod
    def of(cls, target: str) -> Window | None:
        """The window of a target such as ``window:1s`` or ``length:1m``; None for ``frame`` and ``position``."""
        if target in ("frame", "position"):
            return None
        match = _PATTERN.fullmatch(target)
        if match is None or (match[1] == "window") != (match[3] == "s") or float(match[2]) <= 0:
            raise GpvoError(f"there is no target '{target}'", cure="frame, window:1s, length:1m or position")
        return cls(match[1], float(match[2]))

    def step(self, record: VoRecord) -> VoRecord | None:
        """The motion over the window that ends with this record; None until it is full. A lost frame empties it."""
        if not record.usable:
            self._motions.clear()
            return None
        if self._motions and self._motions[-1].t_ns != record.t_prev_ns:
            # The reference is an older frame: drop the motions that came after it.
            while self._motions and self._motions[-1].t_ns != record.t_prev_ns:
                self._motions.pop()
        self._motions.append(record)
        while len(self._motions) > 1 and self._extent() - self._measure(self._motions[0]) >= self.size * (1 - 1e-9):
            self._motions.popleft()
        return joined(list(self._motions)) if self._extent() >= self.size * (1 - 1e-9) else None

    def _measure(self, record: VoRecord) -> float:
        return record.dt_s if self.kind == "window" else float(np.linalg.norm(record.T_prev_cur[:3, 3]))

    def _extent(self) -> float:
        return sum(self._measure(r) for r in self._motions)


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
    known: dict[str, Any] = {name: float(np.mean([getattr(r, name) for r in motions])) for name in _MEANS}
    known |= {name: int(np.mean([getattr(r, name) for r in motions])) for name in _COUNTS}
    known |= {
        n: None if any(getattr(r, n) is None for r in motions) else np.mean([getattr(r, n) for r in motions], axis=0)
        for n in _IMU
    }
    return replace(
        last,
        t_prev_ns=motions[0].t_prev_ns,
        T_prev_cur=T,
        status=Status(status),
        covariances=covariances,
        v_t={},
        **known,
    )

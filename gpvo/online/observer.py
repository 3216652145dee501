"""From records to features: the one path that flight and training share."""

from __future__ import annotations

from collections.abc import Sequence

from gpvo.online.features import FeatureStream
from gpvo.online.intake import Intake
from gpvo.online.slip import SlipDetector
from gpvo.online.window import Window
from gpvo.types import Array, StereoCamera, VoRecord


class Observer:
    """Judges stamps, flags slips, joins motions over a window, computes features: record by record, causally.

    ``names``: feature columns. ``target``: ``frame``, ``window:1s``, ``length:1m`` or ``position``.
    """

    def __init__(self, names: Sequence[str], target: str = "frame", camera: StereoCamera | None = None) -> None:
        self._intake = Intake()
        self.slip = SlipDetector()
        self._window = Window.of(target)
        self._stream = FeatureStream(names, camera)

    def step(self, record: VoRecord) -> tuple[VoRecord, Array] | None:
        """The record as judged (or as joined over the window) and its features (d,); None while a window fills."""
        judged: VoRecord | None = self.slip.step(self._intake.step(record))
        if self._window is not None:
            judged = self._window.step(judged) if judged is not None else None
        return None if judged is None else (judged, self._stream.step(judged))

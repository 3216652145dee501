"""How much is flown: seeds, durations, experiments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gpvo.errors import GpvoError
from gpvo.reproduce.experiments import EXPERIMENTS, FLIGHTS, SENSITIVITY, Experiment

Mode = Literal["images", "points"]
MODES: tuple[Mode, ...] = ("images", "points")
ALL: tuple[Experiment, ...] = (*EXPERIMENTS, *SENSITIVITY)
_RECORDINGS = "flown_paths"


@dataclass(frozen=True)
class Plan:
    """``seeds``: test flights with images; ``points_seeds``: further ones without. ``training``: flights that a model
    learns from, by mode. ``duration_s`` of a flight; ``stretch``: long straights are longer, as in the thesis.
    ``curve``: numbers of training flights of the learning curve. ``data``: folder of real data, of whose logs at most
    ``real_frames`` are taken. ``only``: keys or tables of experiments, by default all."""

    seeds: int = 5
    points_seeds: int = 20
    training: Mapping[Mode, int] = field(default_factory=lambda: {"images": 8, "points": 36})
    duration_s: float = 60.0
    rate_hz: float = 10.0
    stretch: bool = True
    curve: tuple[int, ...] = (1, 2, 4, 6)
    data: Path | None = None
    real_frames: int | None = None
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.seeds < 0 or self.points_seeds < 0 or self.seeds + self.points_seeds == 0:
            raise GpvoError("no flight was asked for", cure="--seeds or --points-seeds above 0")
        if self.data is not None and not self.data.is_dir():
            raise GpvoError("no such folder", where=self.data, cure="--data FOLDER, or set GPVO_DATA")
        known = list(dict.fromkeys(name for e in ALL for name in (e.table, e.key)))
        if unknown := [name for name in self.only if name not in known]:
            raise GpvoError(f"unknown experiment '{unknown[0]}'", cure=f"one of: {', '.join(known)}")

    @classmethod
    def quick(cls, **given: Any) -> Plan:
        """One seed, flights of 20 s; ``given`` values go before."""
        usual: dict[str, Any] = {
            "seeds": 1, "points_seeds": 6, "training": {"images": 4, "points": 8}, "duration_s": 20.0,
            "stretch": False, "curve": (1, 2, 4), "real_frames": 400,
        }  # fmt: skip
        return cls(**{**usual, **given})

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """What is asked for, in the order of the list."""
        return tuple(e for e in ALL if not self.only or e.key in self.only or e.table in self.only)

    @property
    def flight_sets(self) -> tuple[str, ...]:
        """The sets to fly: with all experiments, also those that claims alone need."""
        if not self.only:
            return tuple(FLIGHTS)
        needed = {name for e in self.experiments for name in (e.flights, e.training)}
        return tuple(name for name in FLIGHTS if name in needed)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The modes in which anything is flown."""
        return tuple(m for m in MODES if self.test_seeds(m))

    def test_seeds(self, mode: Mode) -> range:
        """Seeds of the test flights: those without images go on where those with images end."""
        return range(self.seeds) if mode == "images" else range(self.seeds, self.seeds + self.points_seeds)

    def recordings(self, half: str) -> list[Path]:
        """Recorded paths of one half, ``training`` or ``test``: no path is in both. Empty without data."""
        if self.data is None:
            return []
        files = sorted(p for p in (self.data / _RECORDINGS).glob("*") if p.suffix in (".txt", ".csv", ".tum"))
        return files[0::2] if half == "training" else files[1::2]

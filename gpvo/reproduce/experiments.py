"""The thesis' experiments as one declared list: rows of its tables, their flights, methods and published figures; and
how much of it is flown.

D. Ross, *Uncertainty Estimation for Stereo Visual Odometry* (West Virginia University), chapter 4. Its flights are not
available, so what is compared are ratios: predicted over actual, GP residual over RMSE.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gpvo.errors import GpvoError
from gpvo.files import read_toml

Way = Literal["recipe", "corrected", "full"]
WAYS: dict[Way, str] = {
    "recipe": "the thesis to the letter: every frame matched afresh; translation alone (V_T), rotation taken as known; "
    "diag(sigma_p, sigma_p, sigma_m) as printed, not squared; V_T summed up; GP of the position's residual on velocity "
    "and feature count, isotropic, constant noise",
    "corrected": "the same ideas without its errata: sigmas squared, the joint 6x6 covariance of translation and "
    "rotation, compounding by the adjoint, a keyframe kept at rest; GP of the error of each motion, not the position",
    "full": "gpvo's learned model: heteroscedastic, on all that odometry knows, its error in parts that add up apart",
}

OUT_OF_SCOPE = (
    "patchlets (thesis, equations 3.11 and 3.12)",
    "heteroscedastic errors-in-variables (HEIV) estimation of the motion",
    "bundle adjustment",
)
ERRATA = (
    "The thesis prints diag(sigma_p, sigma_p, sigma_m); a covariance needs the squares. At 0.1 px the printed one is a "
    "3.2 times larger deviation. The recipe keeps it, the corrected way does not.",
    "Equation 3.20 lacks the inverse of the kernel matrix; no way of computing a GP follows it as printed.",
    "The thesis does not state the pixel noise of its triangulation: 1 px is taken.",
)


@dataclass(frozen=True)
class FlightSet:
    """Flights of one kind.

    ``scenarios``: names, taken in turn. ``recorded``: flies recorded paths where there are any, of this half of them.
    ``longer``: the factor on the plan's duration. ``first_seed``: of a training set, far from all test seeds.
    ``thesis_preset``: odometry as in the thesis runs over it too.
    """

    name: str
    scenarios: tuple[str, ...]
    overrides: Mapping[str, Any] = field(default_factory=dict)
    recorded: Literal["training", "test", ""] = ""
    longer: float = 1.0
    first_seed: int = 0
    thesis_preset: bool = True
    points_only: bool = False

    @property
    def is_training(self) -> bool:
        """Whether models learn from it; else it is flown by the test seeds."""
        return self.first_seed > 0


@dataclass(frozen=True)
class Experiment:
    """One row of a table. ``method``: how the thesis stated the uncertainty there; ``sigma_px``: (pointing, matching)
    of ``pointing_matching``. ``flights``, ``training``: names of flight sets. ``thesis``: what it prints, see
    :func:`published`. ``figure``: its number there."""

    key: str
    table: str
    title: str
    flights: str
    training: str
    method: Literal["triangulation", "pointing_matching", "gp"]
    thesis: Mapping[str, float | None] | None
    figure: str = ""
    sigma_px: tuple[float, float] = (0.1, 0.5)
    stands_in: str = ""
    warning: bool = False


_DECLARED = read_toml(Path(__file__).with_name("experiments.toml"))


def _values(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}


def _experiment(table: Mapping[str, Any]) -> Experiment:
    values = _values(table)
    figures = values.pop("published", None)
    return Experiment(**values, thesis=figures and published(**figures))


def published(
    rmse_m: float, final_m: float, predicted_m: float, residual_m: float | None = None
) -> dict[str, float | None]:
    """What the thesis prints [m], 3-D RMSE, final error, predicted final error, and the GP's residual if any, with the
    ratios of these, as scripts read it."""
    return {
        "rmse_m": rmse_m,
        "final_error_m": final_m,
        "predicted_final_error_m": predicted_m,
        "ratio": predicted_m / final_m,
        "residual_m": residual_m,
        "residual_over_rmse": None if residual_m is None else residual_m / rmse_m,
    }


FLIGHTS: dict[str, FlightSet] = {name: FlightSet(name, **_values(s)) for name, s in _DECLARED["flights"].items()}
EXPERIMENTS: tuple[Experiment, ...] = tuple(map(_experiment, _DECLARED["experiment"]))

SENSITIVITY_PX: tuple[tuple[float, float], ...] = ((0.1, 0.1), (0.1, 0.5), (0.1, 1.0))
SENSITIVITY: tuple[Experiment, ...] = tuple(
    Experiment(
        f"sensitivity-{name}-{p}-{m}", "sensitivity", f"tunnel, {name}, sigma_p {p}, sigma_m {m}", flights,
        "tunnel-training", "pointing_matching", None, "4.9" if (p, m) == (0.1, 0.1) else "", (p, m),
        EXPERIMENTS[0].stands_in,
    )
    for name, flights in (("clean", "tunnel"), ("image noise 0.025", "tunnel-noisy"))
    for p, m in SENSITIVITY_PX
)  # fmt: skip

ALL: tuple[Experiment, ...] = (*EXPERIMENTS, *SENSITIVITY)


def printed(sigma_px: tuple[float, float]) -> tuple[float, float]:
    """The sigmas whose squares are what the thesis prints in place of squares."""
    return sigma_px[0] ** 0.5, sigma_px[1] ** 0.5


def sigma_pairs(flights: str, preset: str) -> tuple[tuple[float, float], ...]:
    """Every (pointing, matching) pair [px] that any experiment on a set of flights states; the thesis' odometry states
    what the thesis prints."""
    wanted = [e.sigma_px for e in ALL if e.method == "pointing_matching" and e.flights == flights]
    return tuple(dict.fromkeys(printed(pair) if preset == "thesis" else pair for pair in wanted))


Mode = Literal["images", "points"]
MODES: tuple[Mode, ...] = ("images", "points")
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

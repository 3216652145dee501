"""What the thesis claims in words (chapters 2, 4 and 5), and what our flights say of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.reproduce.bounds import Bounds, load_bounds
from gpvo.reproduce.experiments import WAYS, Way
from gpvo.reproduce.plan import Mode
from gpvo.reproduce.run import Cell, Flights, Workers
from gpvo.reproduce.sayings import Saying, SayingJob, say
from gpvo.reproduce.scores import Pooled, pooled
from gpvo.reproduce.store import Store
from gpvo.reproduce.studies import OTHER, SAME, Studies, gain
from gpvo.reproduce.tables import MODES, number, with_interval
from gpvo.types import Array

_REST_S = 2.9
_FLAT, _HARDLY, _OWN = 0.1, 1.25, 0.5
HOLDS, FAILS, OPEN = "holds", "does not hold", "open"


@dataclass(frozen=True)
class Claim:
    """One claim: ``verdict`` is holds, does not hold, or open; ``evidence`` one line of numbers."""

    claim: str
    verdict: str
    evidence: str


class Evidence:
    """Bounds by experiment and way, of the mode with more flights."""

    def __init__(self, cells: Sequence[Cell], store: Store, mode: Mode) -> None:
        self.mode = mode
        self._paths: dict[tuple[str, Way], Path] = {
            (c.experiment.key, c.way): c.job.path(store) for c in cells if c.mode == mode
        }

    def __call__(self, key: str, way: Way) -> list[Bounds]:
        """The flights of a row."""
        return load_bounds(self._paths[key, way])

    def has(self, *keys: str) -> bool:
        """Whether all these rows were flown, all ways."""
        return all((key, way) in self._paths for key in keys for way in WAYS)


def claims(
    cells: Sequence[Cell], flights: Flights, studies: Studies | None, store: Store, workers: Workers
) -> list[dict[str, Any]]:
    """Every claim with its verdict; one that cannot be judged is open, and says why."""
    modes: list[Mode] = list(dict.fromkeys(c.mode for c in cells))
    mode: Mode = "points" if "points" in modes or not modes else "images"
    found = Evidence(cells, store, mode)
    out = [judge(found) if found.has(*keys) else _unknown(text) for text, keys, judge in _JUDGES]
    out.insert(2, _noisy_pairs(flights, mode, store, workers))
    out += [_more_data(studies), _target_world(studies), *_inputs(studies)]
    return [{**c.__dict__, "mode": MODES[mode]} for c in out]


def _unknown(claim: str, why: str = "no flights of this kind") -> Claim:
    return Claim(claim, OPEN, why)


def _flat(found: Evidence) -> Claim:
    shares = {}
    for way in WAYS:
        flights = found("4.2-clean", way)
        rest = np.array([b.predicted_m[np.searchsorted(b.t_s, _REST_S)] ** 2 for b in flights])
        end = np.array([b.predicted_m[-1] ** 2 for b in flights])
        shares[way] = float(np.sqrt(rest.mean() / end.mean()))
    held = [way for way, share in shares.items() if share < _FLAT]
    text = ", ".join(f"{way} {100 * share:.2g} %" for way, share in shares.items())
    verdict = HOLDS if len(held) == len(WAYS) else f"holds for {', '.join(held)} alone" if held else FAILS
    return Claim(_JUDGES[0][0], verdict, f"bound at the end of the rest, as a share of the last one: {text}")


def _noise(found: Evidence) -> Claim:
    pairs = {way: (found("4.1-clean", way), found("4.1-noisy", way)) for way in WAYS}
    text, verdicts = [], {}
    for way, (clean, noisy) in pairs.items():
        n = min(len(clean), len(noisy))
        said, real = (_quotient(noisy[:n], clean[:n], of) for of in (_predicted, _final))
        twice = _double_ratio(noisy[:n], clean[:n])
        text.append(f"{way}: stated x{number(said)}, error x{number(real)}")
        verdicts[way] = _above(twice, 1.0)
    return Claim(_JUDGES[1][0], verdicts["recipe"], "; ".join(text) + " (verdict of the recipe)")


def _tighter(found: Evidence) -> Claim:
    pm, tri = found("4.2-noisy", "recipe"), found("4.1-noisy", "recipe")
    narrower = pooled(_predicted(pm), _predicted(tri))
    inside = [float(np.mean([(np.abs(b.error_m) <= 3 * b.sigma_m + 1e-9).mean() for b in way])) for way in (pm, tri)]
    verdict = _above(Pooled(1 / narrower.value, _inverse(narrower.high), _inverse(narrower.low)), 1.0)
    evidence = (
        f"last bound over that of triangulation: {_with(narrower)}; inside 3 sigma: {100 * inside[0]:.0f} % against "
        f"{100 * inside[1]:.0f} % (99.7 % is right): tighter is not better by itself"
    )
    return Claim(_JUDGES[2][0], verdict, evidence)


def _own_bound(found: Evidence) -> Claim:
    text, smaller = [], []
    for key in ("4.3", "4.6"):
        flights = found(key, "recipe")
        at = [int(np.searchsorted(b.t_s, b.t_s[-1] / 4)) for b in flights]
        said = np.sqrt(np.mean([np.trace(b.covariance_m2[-1]) for b in flights]) / np.mean(
            [np.trace(b.covariance_m2[k]) for b, k in zip(flights, at, strict=True)]
        ))  # fmt: skip
        real = np.sqrt(_final(flights).mean() / np.mean([(b.error_m[k] ** 2).sum() for b, k in zip(flights, at)]))
        text.append(
            f"{key}: error grows x{number(real)} from a quarter of the flight to its end, the bound x{number(said)}"
        )
        smaller.append(said < _OWN * real)
    return Claim(_JUDGES[3][0], HOLDS if all(smaller) else FAILS if not any(smaller) else OPEN, "; ".join(text))


_JUDGES: list[tuple[str, tuple[str, ...], Callable[[Evidence], Claim]]] = [
    ("bounds are flat before take-off", ("4.2-clean",), _flat),
    ("noise raises the stated sigma more than the error", ("4.1-clean", "4.1-noisy"), _noise),
    ("sigma_p and sigma_m give tighter bounds in noise", ("4.1-noisy", "4.2-noisy"), _tighter),
    ("the GP's own bound is not the bound of the pose", ("4.3", "4.6"), _own_bound),
]


def _noisy_pairs(flights: Flights, mode: Mode, store: Store, workers: Workers) -> Claim:
    claim = "noisy pairs hardly matter on the moon"
    runs = [flights.runs(name, mode, "fast") for name in ("moon", "moon-clean")]
    if not all(runs):
        return _unknown(claim)
    jobs = [SayingJob(f"pairs-{mode}", Saying("joint", "pointing_matching"), r) for r in runs]
    noisy, clean = (load_bounds(p) for p in workers.map("bounds", say, [(j, store) for j in jobs]))
    n = min(len(noisy), len(clean))
    error, said = (pooled(of(noisy[:n]), of(clean[:n])) for of in (_final, _predicted))
    # Holds where the error surely grows by less than a quarter.
    verdict = {HOLDS: FAILS, FAILS: HOLDS, OPEN: OPEN}[_above(error, _HARDLY)]
    return Claim(
        claim, verdict, f"final error with noisy pairs over that without: {_with(error)}; bound: {_with(said)}"
    )


def _more_data(studies: Studies | None) -> Claim:
    claim = "more training data help"
    if studies is None or min(len(c) for c in studies.curve.values()) < 2:
        return _unknown(claim, "too few training flights for a curve")
    text, verdicts = [], []
    for kind, by_count in studies.curve.items():
        few, many = min(by_count), max(by_count)
        found = gain(by_count[many], by_count[few])
        text.append(f"{kind}: {few} to {many} flights, gain in NLL per axis {found}")
        verdicts.append(_above(Pooled(found.mean, found.low, found.high), 0.0))
    return Claim(claim, verdicts[0] if len(set(verdicts)) == 1 else OPEN, "; ".join(text))


def _target_world(studies: Studies | None) -> Claim:
    claim = "training in the environment of the target helps"
    if studies is None or not studies.curve[SAME]:
        return _unknown(claim)
    n = max(studies.curve[SAME])
    found = gain(studies.curve[SAME][n], studies.curve[OTHER][n])
    verdict = _above(Pooled(found.mean, found.low, found.high), 0.0)
    return Claim(claim, verdict, f"gain in NLL per axis over other worlds, {n} flights each: {found}")


def _inputs(studies: Studies | None) -> list[Claim]:
    out = []
    for what, without in (("the IMU", "without IMU"), ("the geometric covariance", "without geometric covariance")):
        claim = f"{what} as an input helps"
        if studies is None:
            out.append(_unknown(claim))
            continue
        found = gain(studies.ablation["all inputs"], studies.ablation[without])
        verdict = _above(Pooled(found.mean, found.low, found.high), 0.0)
        out.append(Claim(claim, verdict, f"gain in NLL per axis over a model without: {found}"))
    return out


def _above(p: Pooled, level: float) -> str:
    if p.low is None or p.high is None or not np.isfinite(p.low):
        return OPEN
    return HOLDS if p.low > level else FAILS if p.high < level else OPEN


def _inverse(value: float | None) -> float | None:
    return None if value is None else 1.0 / max(value, 1e-300)


def _with(p: Pooled) -> str:
    return with_interval(p.value, None if p.low is None or p.high is None else (p.low, p.high))


def _final(flights: Sequence[Bounds]) -> Array:
    return np.array([(b.error_m[-1] ** 2).sum() for b in flights])


def _predicted(flights: Sequence[Bounds]) -> Array:
    return np.array([b.predicted_m[-1] ** 2 for b in flights])


def _quotient(a: Sequence[Bounds], b: Sequence[Bounds], of: Callable[[Sequence[Bounds]], Array]) -> float:
    return float(np.sqrt(of(a).mean() / of(b).mean()))


def _double_ratio(noisy: Sequence[Bounds], clean: Sequence[Bounds], draws: int = 4000) -> Pooled:
    """Growth of what is stated over growth of the error, with an interval over seeds."""
    parts = [_predicted(noisy), _predicted(clean), _final(noisy), _final(clean)]

    def ratio(means: Sequence[Any]) -> Any:
        return np.sqrt(means[0] / means[1] * means[3] / means[2])

    value = float(ratio([p.mean() for p in parts]))
    if len(noisy) < 3:
        return Pooled(value, None, None)
    pick = np.random.default_rng(0).integers(0, len(noisy), (draws, len(noisy)))
    low, high = np.quantile(ratio([p[pick].mean(1) for p in parts]), [0.025, 0.975])
    return Pooled(value, float(low), float(high))


def lines(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line per claim, for a terminal."""
    return [f"{c['verdict']}: {c['claim']} ({c['evidence']})" for c in found]

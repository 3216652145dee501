"""The whole reproduction: simulate, run odometry, train, state bounds, score; the folder that a person opens; and what
the thesis claims in words (chapters 2, 4 and 5), with what gpvo's flights say about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo import __version__
from gpvo.evaluation.report import number
from gpvo.files import plain, refuse_foreign, write_csv, write_json, write_text
from gpvo.reproduce import models, rows, tables
from gpvo.reproduce.bounds import BoundMethod, Bounds, BoundsJob, load_bounds
from gpvo.reproduce.experiments import ERRATA, OUT_OF_SCOPE, WAYS, Mode, Plan, Way
from gpvo.reproduce.flights import Flights, fly_all
from gpvo.reproduce.models import OTHER, SAME, Studies
from gpvo.reproduce.rows import Cell, Interval, over_seeds, pooled, squared_ends
from gpvo.reproduce.stages import Store, Workers, only_user
from gpvo.reproduce.tables import MODES, with_interval
from gpvo.stats.series import sequence_bootstrap
from gpvo.types import Array

_WRITTEN = {
    "results.json": (b'"out_of_scope"', "results of a reproduction"),
    "tables.md": (b"^# The thesis' experiments, reproduced", "tables of a reproduction"),
    "tables.csv": (b",thesis_", "tables of a reproduction"),
    "report.html": (b"<title>gpvo: the thesis reproduced</title>", "report of a reproduction"),
}


def reproduce(plan: Plan, out: Path, workers: Workers | None = None) -> dict[str, Any]:
    """Every experiment of the list; stages that ``out`` holds are not done again.

    Writes ``results.json`` (the returned document, schema 1), ``tables.md``, ``tables.csv``, ``figures/*.png`` and
    ``report.html`` into ``out``. Raises GpvoError where the folder cannot be written, or the folder of data is missing.
    """
    for name, own in _WRITTEN.items():
        refuse_foreign(out / name, *own)  # before the work, not after it
    with only_user(out):
        result = _computed(plan, out, workers or Workers())
        document = plain(result)
        write_json(out / "results.json", document)
        write_text(out / "tables.md", tables.as_markdown(document))
        every_row = [*document["rows"], *document["sensitivity"], *document["real"]]
        write_csv(out / "tables.csv", tables.as_columns(every_row))
        write_text(out / "report.html", tables.as_page(document, out))
    return result


def _computed(plan: Plan, out: Path, workers: Workers) -> dict[str, Any]:
    store = Store(out)
    flights = fly_all(plan, store, workers)
    real: list[Cell] = []
    refused: list[str] = []
    if plan.data is not None and not plan.only:
        real, refused = rows.real_cells(plan.data, plan.real_frames, store, workers)
    simulated = rows.simulated_cells(plan, flights)
    rows.compute([*simulated, *real], store, workers)
    studied = models.run_studies(plan, flights, store, workers)
    claimed = [] if plan.only else claims(simulated, flights, studied, store, workers)
    main = rows.scored([c for c in simulated if c.experiment.table != "sensitivity"], store)
    if not (plan.recordings("test") and plan.recordings("training")):
        for row in main:
            row["title"] += ", NO RECORDED PATHS: random ones" if row["table"] in ("4.5", "4.6") else ""
    return {
        "schema": 1,
        "gpvo": __version__,
        "plan": {k: str(v) if isinstance(v, Path) else v for k, v in asdict(plan).items()},
        "ways": WAYS,
        "notes": _notes(plan),
        "rows": main,
        "sensitivity": rows.scored([c for c in simulated if c.experiment.table == "sensitivity"], store),
        "real": rows.scored(real, store),
        "targets": rows.targets(main),
        "claims": claimed,
        "studies": models.studies_document(studied),
        "errata": list(ERRATA),
        "out_of_scope": list(OUT_OF_SCOPE),
        "failed": [*flights.failed, *refused],
        "figures": tables.draw([*simulated, *real], studied, store, out),
    }


def _notes(plan: Plan) -> list[str]:
    """What stands for what, in plain words."""
    length = f"{plan.duration_s:g} s" + (", the long straight twice as long" if plan.stretch else "")
    notes = [
        "The thesis' flights are not available; ours stand in for them. Compare ratios, not metres.",
        f"Flights of {length}, {plan.rate_hz:g} Hz. Seeds with images: {plan.seeds}; further seeds in "
        f"points-only mode: {plan.points_seeds} (landmark tracks without images), in rows of their own. "
        f"Each trains apart: on {plan.training['images']} flights with images, on {plan.training['points']} without.",
        "RMSE, final and predicted final error are roots of mean squares over the seeds; brackets are 95 % intervals "
        "of a bootstrap by seed. Predicted: root of the expected squared error, 1 sigma.",
        "Tables 4.1, 4.2: a drawn mine tunnel for the thesis' simulated one; models learned in other tunnels, clean "
        "and noisy. Table 4.3: the same tunnel as in training. Table 4.4: a rover on a drawn moon.",
    ]
    half = plan.recordings("test"), plan.recordings("training")
    if all(half):
        names = [", ".join(p.stem for p in files) for files in half]
        notes.append(
            "Tables 4.5, 4.6: no T265 flight under motion capture is at hand. Images of a T265-like fisheye pair are "
            f"drawn along recorded paths, the calibration off by a draw from the datasheet's tolerance in every "
            f"flight; test paths: {names[0]}; training paths and draws are others: {names[1]}. Points-only rows see "
            "such paths through a rectified pair of the T265's baseline, without a lens."
        )
    else:
        notes.append(
            "Tables 4.5, 4.6: NO RECORDED PATHS at hand (--data FOLDER with flown_paths/): smooth random paths stand "
            "in for them, the calibration off by a draw from the datasheet's tolerance in every flight."
        )
    if plan.data is None:
        notes.append("Real data: none at hand (--data FOLDER, or the variable GPVO_DATA).")
    else:
        cut = "" if plan.real_frames is None else f", of logs the first {plan.real_frames} frames"
        notes.append(
            "Real data: stereo tracks of cars and logs of another odometry stand for real flights; every sequence is "
            f"judged by models of the others{cut}."
        )
    return notes


_REST_S = 2.9
_FLAT, _HARDLY, _OWN = 0.1, 1.25, 0.5
HOLDS, FAILS, OPEN = "holds", "does not hold", "open"
_DENIED = {HOLDS: FAILS, FAILS: HOLDS, OPEN: OPEN}

Evidence = Callable[[str, Way], list[Bounds]]
"""The flights of a row by its key and a way."""


def claims(
    cells: Sequence[Cell], flights: Flights, studies: Studies | None, store: Store, workers: Workers
) -> list[dict[str, Any]]:
    """Every claim with its verdict (holds, does not hold, or open) and one line of evidence, by the mode with more
    flights; one that cannot be judged is open, and says why."""
    modes = {c.mode for c in cells}
    mode: Mode = "points" if "points" in modes or not modes else "images"
    flown = {(c.experiment.key, c.way): c for c in cells if c.mode == mode}

    def found(key: str, way: Way) -> list[Bounds]:
        return flown[key, way].load(store)

    judged = [
        (claim, judge(found) if all((key, way) in flown for key in keys for way in WAYS) else _UNKNOWN)
        for claim, keys, judge in _ROWS
    ]
    judged.insert(2, ("noisy pairs hardly matter on the moon", _noisy_pairs(flights, mode, store, workers)))
    judged.append(("more training data help", _more_data(studies)))
    judged.append(("training in the environment of the target helps", _target_world(studies)))
    for what, lacking in (("the IMU", "without IMU"), ("the geometric covariance", "without geometric covariance")):
        gain = _UNKNOWN if studies is None else _gain("a model without", studies.ablation, "all inputs", lacking)
        judged.append((f"{what} as an input helps", gain))
    return [
        {"claim": claim, "verdict": verdict, "evidence": evidence, "mode": MODES[mode]}
        for claim, (verdict, evidence) in judged
    ]


_UNKNOWN = OPEN, "no flights of this kind"


def _flat(found: Evidence) -> tuple[str, str]:
    shares = {}
    for way in WAYS:
        flights = found("4.2-clean", way)
        rest = np.array([b.predicted_m[np.searchsorted(b.t_s, _REST_S)] ** 2 for b in flights])
        end = np.array([b.predicted_m[-1] ** 2 for b in flights])
        shares[way] = float(np.sqrt(rest.mean() / end.mean()))
    held = [way for way, share in shares.items() if share < _FLAT]
    text = ", ".join(f"{way} {100 * share:.2g} %" for way, share in shares.items())
    verdict = HOLDS if len(held) == len(WAYS) else f"holds for {', '.join(held)} alone" if held else FAILS
    return verdict, f"bound at the end of the rest, as a share of the last one: {text}"


def _noise(found: Evidence) -> tuple[str, str]:
    text, verdicts = [], {}
    for way in WAYS:
        noisy, clean = _paired(found("4.1-noisy", way), found("4.1-clean", way))
        real, stated = (pooled(a, b)[0] for a, b in zip(noisy, clean, strict=True))
        text.append(f"{way}: stated x{number(stated)}, error x{number(real)}")
        verdicts[way] = _above(_double_ratio(noisy, clean), 1.0)
    return verdicts["recipe"], "; ".join(text) + " (verdict of the recipe)"


def _tighter(found: Evidence) -> tuple[str, str]:
    pm, tri = found("4.2-noisy", "recipe"), found("4.1-noisy", "recipe")
    value, interval = pooled(squared_ends(pm)[1], squared_ends(tri)[1])
    inside = [float(np.mean([(np.abs(b.error_m) <= 3 * b.sigma_m + 1e-9).mean() for b in way])) for way in (pm, tri)]
    # Tighter: the quotient lies below one.
    return _DENIED[_above(interval, 1.0)], (
        f"last bound over that of triangulation: {with_interval(value, interval)}; inside 3 sigma: "
        f"{100 * inside[0]:.0f} % against {100 * inside[1]:.0f} % (99.7 % is right): tighter is not better by itself"
    )


def _own_bound(found: Evidence) -> tuple[str, str]:
    text, smaller = [], []
    for key in ("4.3", "4.6"):
        flights = found(key, "recipe")
        at = [int(np.searchsorted(b.t_s, b.t_s[-1] / 4)) for b in flights]
        early, late = (
            np.array([((b.error_m[k] ** 2).sum(), np.trace(b.covariance_m2[k])) for b, k in zip(flights, ends)])
            for ends in (at, [-1] * len(flights))
        )
        real, stated = np.sqrt(late.mean(axis=0) / early.mean(axis=0))
        text.append(
            f"{key}: error grows x{number(real)} from a quarter of the flight to its end, the bound x{number(stated)}"
        )
        smaller.append(stated < _OWN * real)
    return HOLDS if all(smaller) else FAILS if not any(smaller) else OPEN, "; ".join(text)


_ROWS: list[tuple[str, tuple[str, ...], Callable[[Evidence], tuple[str, str]]]] = [
    ("bounds are flat before take-off", ("4.2-clean",), _flat),
    ("noise raises the stated sigma more than the error", ("4.1-clean", "4.1-noisy"), _noise),
    ("sigma_p and sigma_m give tighter bounds in noise", ("4.1-noisy", "4.2-noisy"), _tighter),
    ("the GP's own bound is not the bound of the pose", ("4.3", "4.6"), _own_bound),
]


def _noisy_pairs(flights: Flights, mode: Mode, store: Store, workers: Workers) -> tuple[str, str]:
    runs = [flights.runs(name, mode, "fast") for name in ("moon", "moon-clean")]
    if not all(runs):
        return _UNKNOWN
    jobs = [BoundsJob(f"pairs-{mode}", BoundMethod("joint", "pointing_matching"), r) for r in runs]
    workers.keep("bounds", jobs, store)
    noisy, clean = _paired(*(load_bounds(job.path(store)) for job in jobs))
    error, stated = (pooled(a, b) for a, b in zip(noisy, clean, strict=True))
    # Holds where the error surely grows by less than a quarter.
    return _DENIED[_above(error[1], _HARDLY)], (
        f"final error with noisy pairs over that without: {with_interval(*error)}; bound: {with_interval(*stated)}"
    )


def _more_data(studies: Studies | None) -> tuple[str, str]:
    if studies is None or min(len(c) for c in studies.curve.values()) < 2:
        return OPEN, "too few training flights for a curve"
    text, verdicts = [], []
    for kind, by_count in studies.curve.items():
        few, many = min(by_count), max(by_count)
        verdict, found = _gain("", by_count, many, few)
        text.append(f"{kind}: {few} to {many} flights, {found}")
        verdicts.append(verdict)
    return verdicts[0] if len(set(verdicts)) == 1 else OPEN, "; ".join(text)


def _target_world(studies: Studies | None) -> tuple[str, str]:
    if studies is None or not studies.curve[SAME]:
        return _UNKNOWN
    n = max(studies.curve[SAME])
    return _gain(f"other worlds, {n} flights each", {k: c[n] for k, c in studies.curve.items()}, SAME, OTHER)


def _gain(over: str, nll: Mapping[Any, Array], better: Any, worse: Any) -> tuple[str, str]:
    """Whether one likelihood per axis is better than another, over flights, by a bootstrap in pairs."""
    found = sequence_bootstrap(nll[worse] - nll[better])
    what = f"gain in NLL per axis over {over}:" if over else "gain in NLL per axis"
    return _above((found.low, found.high), 0.0), f"{what} {found}"


def _above(interval: Interval | None, level: float) -> str:
    """Whether a quantity with this interval lies above a level."""
    if interval is None or not np.isfinite(interval[0]):
        return OPEN
    return HOLDS if interval[0] > level else FAILS if interval[1] < level else OPEN


def _paired(a: Sequence[Bounds], b: Sequence[Bounds]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Squared last errors and bounds of two sets of flights, as many of each."""
    n = min(len(a), len(b))
    return squared_ends(a[:n]), squared_ends(b[:n])


def _double_ratio(noisy: tuple[Array, Array], clean: tuple[Array, Array]) -> Interval | None:
    """Interval over seeds of the growth of what is stated over the growth of the error."""

    def drawn(pick: NDArray[np.int64]) -> Array:
        (error, stated), (clean_error, clean_stated) = ([v[pick].mean(1) for v in pair] for pair in (noisy, clean))
        return np.sqrt(stated / clean_stated * clean_error / error)

    return over_seeds(len(noisy[0]), drawn)

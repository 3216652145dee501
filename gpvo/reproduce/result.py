"""From nothing to the folder a person opens: tables, figures, the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gpvo import __version__
from gpvo.io.jsonfile import plain, write_json
from gpvo.reproduce import document, figures, studies, tables
from gpvo.reproduce.bounds import Bounds, load_bounds
from gpvo.reproduce.claims import claims
from gpvo.reproduce.experiments import ERRATA, OUT_OF_SCOPE, SENSITIVITY_PX, WAYS
from gpvo.reproduce.page import render
from gpvo.reproduce.plan import Plan
from gpvo.reproduce.real import RealRow, real_rows
from gpvo.reproduce.run import Cell, Workers, cells, compute, fly_all
from gpvo.reproduce.scores import score
from gpvo.reproduce.store import Store, only_user, write_text
from gpvo.reproduce.studies import Studies


def reproduce(plan: Plan, out: Path, workers: Workers | None = None) -> dict[str, Any]:
    """Every experiment of the list; stages that ``out`` holds are not done again.

    Writes ``results.json`` (the returned document, schema 1), ``tables.md``, ``tables.csv``, ``figures/*.png`` and
    ``report.html`` into ``out``.

    Raises
    ------
    GpvoError
        Where the folder cannot be written, or the folder of data is missing.
    """
    with only_user(out):
        result = _computed(plan, out, workers or Workers())
        _write(plain(result), out)
    return result


def _computed(plan: Plan, out: Path, workers: Workers) -> dict[str, Any]:
    """Every stage, then the document and its figures."""
    store = Store(out)
    flights = fly_all(plan, store, workers)
    table = cells(plan, flights, store)
    compute(table, store, workers)
    studied = studies.run_studies(plan, flights, store, workers)
    claimed = [] if plan.only else claims(table, flights, studied, store, workers)
    wants_real = plan.data is not None and not plan.only
    real, refused = real_rows(plan.data, plan.real_frames, store, workers) if wants_real and plan.data else ([], [])
    scores = document.scores_of(table, store)
    rows = document.rows({c: s for c, s in scores.items() if c.experiment.table != "sensitivity"})
    if not (plan.recordings("test") and plan.recordings("training")):
        for row in rows:
            row["title"] += ", NO RECORDED PATHS: random ones" if row["table"] in ("4.5", "4.6") else ""
    result: dict[str, Any] = {
        "schema": 1,
        "gpvo": __version__,
        "plan": {k: str(v) if isinstance(v, Path) else v for k, v in asdict(plan).items()},
        "ways": WAYS,
        "notes": _notes(plan),
        "rows": rows,
        "sensitivity": document.rows({c: s for c, s in scores.items() if c.experiment.table == "sensitivity"}),
        "real": [_real(row) for row in real],
        "targets": document.targets(rows),
        "claims": claimed,
        "studies": studies.document(studied),
        "errata": list(ERRATA),
        "out_of_scope": list(OUT_OF_SCOPE),
        "failed": [*flights.failed, *refused],
    }
    result["figures"] = _draw(table, real, studied, store, out)
    return result


def _real(row: RealRow) -> dict[str, Any]:
    ways = {w: document.way(score([b for p in paths for b in load_bounds(p)])) for w, paths in row.bounds.items()}
    head = document.head(row.experiment)
    return {**head, "mode": "real", "seeds": max(len(paths) for paths in row.bounds.values()), "ways": ways}


def _notes(plan: Plan) -> list[str]:
    """What stands for what, in plain words."""
    length = f"{plan.duration_s:g} s" + (", the long straight twice as long" if plan.stretch else "")
    notes = [
        "The thesis' flights are not available; ours stand in for them. Compare ratios, not metres.",
        f"Flights of {length}, {plan.rate_hz:g} Hz. Seeds with images: {plan.seeds}; further seeds in "
        f"points-only mode: {plan.points_seeds} (landmark tracks without pictures), in rows of their own. "
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
            "Tables 4.5, 4.6: no T265 flight under motion capture is at hand. Pictures of a T265-like fisheye pair are "
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


def _draw(
    table: Sequence[Cell], real: Sequence[RealRow], studied: Studies | None, store: Store, out: Path
) -> list[dict[str, str]]:
    """Every figure as a file, and what it shows."""
    drawn: list[dict[str, str]] = []

    def save(name: str, title: str, columns: Mapping[str, Bounds]) -> None:
        figures.save(figures.bounds_figure(title, columns), out / "figures" / f"{name}.png")
        drawn.append({"file": f"figures/{name}.png", "title": title})

    for (number, mode), group in _figures(table).items():
        columns = {_column(c): load_bounds(c.job.path(store))[0] for c in group}
        title = group[0].experiment.title if number != "4.9" else "tunnel, clean: sensitivity to sigma_p, sigma_m"
        save(f"{number}-{mode}", f"Figure {number}, {title} ({tables.MODES[mode]}, first seed)", columns)
    for row in real:
        first = {way: load_bounds(paths[0])[0] for way, paths in row.bounds.items()}
        save(row.experiment.key, f"Real: {row.experiment.title} (first sequence)", first)
    if studied is not None and len(next(iter(studied.curve.values()))) > 1:
        figures.save(figures.curve_figure(_curves(studied)), out / "figures" / "learning-curve.png")
        title = f"Learning curve ({tables.MODES[studied.mode]})"
        drawn.append({"file": "figures/learning-curve.png", "title": title})
    return drawn


def _figures(table: Sequence[Cell]) -> dict[tuple[str, str], list[Cell]]:
    """Cells by figure and mode; the last figure shows the pairs of sigmas side by side."""
    out: dict[tuple[str, str], list[Cell]] = {}
    for c in table:
        if c.experiment.table == "sensitivity":
            if c.experiment.flights == "tunnel" and c.way == "recipe":
                out.setdefault(("4.9", c.mode), []).append(c)
        elif c.experiment.figure:
            out.setdefault((c.experiment.figure, c.mode), []).append(c)
    return dict(sorted(out.items(), key=lambda item: (item[0][1], item[0][0])))


def _column(c: Cell) -> str:
    if c.experiment.table != "sensitivity":
        return c.way
    p, m = c.experiment.sigma_px
    assert (p, m) in SENSITIVITY_PX
    return f"recipe, sigma_p {p}, sigma_m {m}"


def _curves(studied: Studies) -> dict[str, tuple[list[int], list[float], list[float], list[float]]]:
    out = {}
    for kind, by_count in studied.curve.items():
        means = [float(v.mean()) for v in by_count.values()]
        spread = [float(1.96 * v.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else 0.0 for v in by_count.values()]
        low = [m - s for m, s in zip(means, spread, strict=True)]
        out[kind] = (list(by_count), means, low, [m + s for m, s in zip(means, spread, strict=True)])
    return out


def _write(result: Mapping[str, Any], out: Path) -> None:
    write_json(out / "results.json", result)
    write_text(out / "tables.md", tables.as_markdown(result))
    write_text(out / "tables.csv", tables.as_csv([*result["rows"], *result["sensitivity"], *result["real"]]))
    write_text(out / "report.html", render(result, out))

"""The whole reproduction: simulate, run odometry, train, state bounds, score; and the folder that a person opens."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from gpvo import __version__
from gpvo.files import plain, refuse_foreign, write_csv, write_json, write_text
from gpvo.reproduce import models, rows, tables
from gpvo.reproduce.claims import claims
from gpvo.reproduce.experiments import ERRATA, OUT_OF_SCOPE, WAYS, Plan
from gpvo.reproduce.flights import fly_all
from gpvo.reproduce.stages import Store, Workers, only_user

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
    """Every stage, then the document and its figures."""
    store = Store(out)
    flights = fly_all(plan, store, workers)
    real: list[rows.Cell] = []
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

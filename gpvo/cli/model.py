"""``gpvo predict, check, forecast, export``: what a trained model does."""

from __future__ import annotations

import sys
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from gpvo.cli.output import Json, answer, print_json, progress, say, show
from gpvo.errors import GpvoError, counted
from gpvo.files import refuse_foreign, write_csv
from gpvo.io.parquet import write_table
from gpvo.io.run import PREDICTIONS, read_run, write_predictions
from gpvo.online.predictor import Predictor
from gpvo.types import Prediction

if TYPE_CHECKING:
    from gpvo.evaluation.forecast import Forecast

_LINES = 11  # of the table of a forecast
_TOLD = ("t_s", "distance_m", "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_m")

Model = Annotated[Path, "Model file."]


def predict(
    model: Model,
    runs: Annotated[list[Path], "Run folders."],
    out: Annotated[Path, "Parquet file to write; for several runs, a folder."],
    json_: Json = False,
) -> None:
    """Predict the error of every motion of a run.

    Example: gpvo predict errors.gpvo runs/flight -o predictions.parquet
    """
    from gpvo.dataset.check import warn_of_misfits
    from gpvo.evaluation.evaluate import distinct

    if len(runs) == 1 and out.suffix.lower() != ".parquet":
        raise GpvoError("does not have the suffix of a Parquet file", where=out, cure="end it in .parquet")
    if len(runs) > 1 and out.is_file():
        raise GpvoError("is a file", where=out, cure="give a folder for the predictions of several runs")
    names = distinct([r.resolve().name for r in runs])
    targets = [out] if len(runs) == 1 else [out / f"{name}.parquet" for name in names]
    for target in targets:
        refuse_foreign(target, *PREDICTIONS)  # before the work, not after it
    predictor, documents = Predictor.load(model), list[dict[str, Any]]()
    with progress("runs", len(runs)) as advance:
        for path, target in zip(runs, targets, strict=True):
            run = read_run(path)
            warn_of_misfits(model, predictor, run)
            predictor.reset(run.log.camera, vehicle=run.log.vehicle)
            documents.append({"run": str(path), "file": str(target)})
            stated = (p for p in map(predictor.step, run.log) if p is not None)
            write_predictions(target, _summary(stated, documents[-1]))
            advance()
    if json_:
        print_json({"schema": 1, **({"runs": documents} if len(runs) > 1 else documents[0])})
        return
    per = "per motion" if predictor.target == "frame" else f"over {predictor.target}"
    for d in documents:
        inside = 100 * (d["in_domain"] or 0)
        print(f"{d['file']}: {counted(d['predictions'], 'prediction')}, {inside:.0f} % inside the training domain")
        length, angle = (1e3 * sum(x**2 for x in sigma) ** 0.5 for sigma in d["median_sigma"].values())
        known = f"median sigma: {length:.3g} mm, {angle:.3g} mrad {per}"
        print("no motion was measured" if d["in_domain"] is None else known)


def _summary(passing: Iterable[Prediction], told: dict[str, Any]) -> Iterator[Prediction]:
    """The same predictions; at their end, ``told`` sums them up."""
    count, sigmas, inside = 0, array("d"), bytearray()
    for p in passing:
        count += 1
        if p.measured:
            sigmas.frombytes(p.sigma.tobytes())
            inside.append(p.in_domain > 0.5)
        yield p
    sigma = np.median(np.reshape(sigmas, (-1, 6)), axis=0) if inside else np.full(6, np.nan)
    told["predictions"], told["in_domain"] = count, float(np.mean(list(inside))) if inside else None
    told["median_sigma"] = {"translation_m": sigma[:3], "rotation_rad": sigma[3:]}


def check(model: Model, run: Annotated[Path, "Run folder."], json_: Json = False) -> None:
    """Check whether a model fits a camera and its conditions.

    Exits with 1 if it does not.

    Example: gpvo check errors.gpvo runs/hover
    """
    from gpvo.dataset.check import check as check_model

    with progress("runs", 1):
        found = check_model(Predictor.load(model), read_run(run))
    if json_:
        print_json({"schema": 1, "fits": found.fits, **asdict(found)})
    else:
        print(
            f"{found.usable} of {found.frames} frames usable, {100 * found.in_domain:.0f} % inside the training domain"
        )
        for name, beyond in (f for f in found.farthest if f[1] >= 0.1):
            print(f"  {name}: {beyond:.2g} standard deviations outside on average")
        for problem in found.problems:
            print(f"problem: {problem}")
        print("fits" if found.fits else "does not fit")
    if not found.fits:
        raise typer.Exit(1)


def export(
    model: Model,
    to: Annotated[str | None, "onnx or c; guessed from the suffix of --out."] = None,
    out: Annotated[Path | None, "File to write; by default beside the model."] = None,
    for_filter: Annotated[bool, typer.Option("--for-filter", hidden=True)] = False,
    prefix: Annotated[str, "Prefix of every C symbol, so that several models fit into one program."] = "gpvo",
) -> None:
    """Export a model to ONNX or to one C header.

    Example: gpvo export errors.gpvo --to c
    """
    from gpvo.publish.export import SUFFIXES, export_model, format_of

    chosen = format_of(to, out)
    if for_filter:
        print("gpvo: --for-filter no longer has any effect: models state no mean error", file=sys.stderr)
    target = out or model.with_name(model.stem + SUFFIXES[chosen])
    export_model(model, target, chosen, prefix=prefix)
    print(f"{target}: {target.stat().st_size} bytes")


def forecast(
    model: Model,
    path: Annotated[Path, "--path", "Planned poses, TUM lines at any spacing."],
    frame: Annotated[str, "Frame of the poses: cam (left camera, z forward) or body (FLU, camera forward)."] = "cam",
    draws: Annotated[
        int, "Simulated flights along the plan, each in different conditions.", {"min": 1, "max": 1000}
    ] = 8,
    seed: Annotated[int, "Random seed.", {"min": 0}] = 0,
    plot: Annotated[Path | None, "Image to write: top view, and sigma over distance."] = None,
    out: Annotated[Path | None, "Every pose, as .parquet or .csv."] = None,
    json_: Json = False,
) -> None:
    """Predict the covariance along a planned path.

    Example: gpvo forecast errors.gpvo --path plan.tum --plot plan.png
    """
    from gpvo.evaluation.forecast import forecast as run_forecast
    from gpvo.evaluation.forecast import read_plan

    if out is not None and out.suffix not in (".parquet", ".csv"):
        raise GpvoError("does not have the suffix of a table", where=out, cure="end it in .parquet or .csv")
    if out is not None:
        refuse_foreign(out, b"cov_5_5", "forecast")
    if plot is not None:
        from gpvo.evaluation import plots

        plots.require_picture(plot)  # before the work, not after it
    predictor = Predictor.load(model).require_motions(model)
    with progress("draws", draws) as advance:
        plan = read_plan(path, predictor.model.dt_s, frame)
        found = run_forecast(predictor, plan, draws=draws, seed=seed, on_draw=advance)
    if out is not None:
        (write_table if out.suffix == ".parquet" else write_csv)(out, _columns(found))
    if plot is not None:
        plots.save(plots.forecast(found, path.name), plot, dpi=110)
    answer(json_, _forecast_document(found, model, path, frame), lambda: _print_forecast(found, path))


def _forecast_document(f: Forecast, model: Path, path: Path, frame: str) -> dict[str, Any]:
    """The result for scripts: SI units, positions in the axes of the plan's world, 1 sigma."""
    return {
        "schema": 1,
        "model": str(model),
        "path": str(path),
        "frame": frame,
        "rate_hz": 1.0 / f.plan.step_s,
        "duration_s": float(f.plan.t_s[-1]),
        "length_m": float(f.plan.distance_m[-1]),
        "draws": f.draws,
        "outside_domain": f.outside_share,
        "outside": [o.__dict__ for o in f.outside],
        "predicted_final_error_m": float(f.sigma_m[-1]),
        "predicted_final_error_independent_m": f.independent_m,
        "final_sigma_m": dict(zip("xyz", f.position_sigma_m[-1].tolist(), strict=True)),
        "final_mean_error_m": dict.fromkeys("xyz", 0.0),  # for scripts that read it: no model states one
        "along": _rows(f),
    }


def _columns(f: Forecast) -> dict[str, Any]:
    """Every pose; its sigma per axis of the plan's world, and the covariance of its error, upper triangle, right
    perturbation in cam."""
    position, sigma = f.plan.T_world_cam[:, :3, 3], f.position_sigma_m
    columns: dict[str, Any] = {"t_s": f.plan.t_s, "distance_m": f.plan.distance_m}
    columns |= {f"{a}_m": position[:, i] for i, a in enumerate("xyz")}
    columns |= {f"sigma_{a}_m": sigma[:, i] for i, a in enumerate("xyz")}
    columns |= {"sigma_m": f.sigma_m, "in_domain": [1.0, *f.in_domain]}
    return columns | {f"cov_{i}_{j}": f.covariance[:, i, j] for i in range(6) for j in range(i, 6)}


def _rows(f: Forecast) -> list[dict[str, float]]:
    """A few poses for a short table, evenly spaced in time and including the last."""
    columns, n = _columns(f), len(f.plan.t_s)
    stops = sorted({int(k) for k in np.linspace(0, n - 1, min(n, _LINES)).round()})
    return [{name: float(columns[name][k]) for name in _TOLD} for k in stops]


def _print_forecast(f: Forecast, path: Path) -> None:
    p, motions = f.plan, counted(len(f.plan.t_s) - 1, "motion")
    say(f"{path}: {p.t_s[-1]:.1f} s, {p.distance_m[-1]:.1f} m, {motions} at {1 / p.step_s:.3g} Hz")
    say(f"{100 * f.outside_share:.3g} % of the plan lies outside the training domain")
    for o in f.outside:
        a, b = o.planned, o.trained
        span = f"planned {a[0]:.3g} to {a[1]:.3g}, trained {b[0]:.3g} to {b[1]:.3g}"
        say(f"  {o.feature}: {span} ({100 * o.share:.3g} % beyond)")
    numbers = (list(row.values()) for row in _rows(f))
    show(
        ("time [s]", "path [m]", "sigma x [m]", "sigma y [m]", "sigma z [m]", "all three [m]"),
        ([f"{t_s:.1f}", f"{path_m:.1f}", *(f"{v:.3g}" for v in sigmas)] for t_s, path_m, *sigmas in numbers),
    )
    say("1 sigma of the position relative to the first pose, in the axes of the plan's world")

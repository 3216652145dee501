"""``gpvo predict, check, export``: what a trained model does."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpvo.cli.output import Json, print_json
from gpvo.errors import GpvoError

if TYPE_CHECKING:
    from gpvo.types import Prediction

Model = Annotated[Path, typer.Argument(help="Model file.")]


def predict(
    model: Model,
    runs: Annotated[list[Path], typer.Argument(help="Run folders.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Parquet file to write; for several runs, a folder.")],
    json_: Json = False,
) -> None:
    """Predict the error of every motion of a run.

    Example: gpvo predict errors.gpvo runs/flight -o predictions.parquet
    """
    from gpvo.evaluation.evaluate import distinct
    from gpvo.io.run import read_run, write_predictions
    from gpvo.online.predictor import Predictor

    if len(runs) == 1 and out.suffix.lower() != ".parquet":
        raise GpvoError("does not have the suffix of a Parquet file", where=out, cure="end it in .parquet")
    predictor, documents = Predictor.load(model), []
    for path, name in zip(runs, distinct([r.resolve().name for r in runs]), strict=True):
        predictions = list(predictor.replay(read_run(path).log).values())
        target = out if len(runs) == 1 else out / f"{name}.parquet"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_predictions(target, predictions)
        documents.append({"run": str(path), "file": str(target), **_summary(predictions)})
    if json_:
        print_json({"schema": 1, **({"runs": documents} if len(runs) > 1 else documents[0])})
        return
    for d in documents:
        inside = 100 * (d["in_domain"] or 0)
        print(f"{d['file']}: {d['predictions']} predictions, {inside:.0f} % inside the training domain")
        length, angle = (1e3 * sum(x**2 for x in sigma) ** 0.5 for sigma in d["median_sigma"].values())
        print(f"median sigma: {length:.3g} mm, {angle:.3g} mrad per motion")


def _summary(predictions: list[Prediction]) -> dict[str, Any]:
    import numpy as np

    moving = [p for p in predictions if p.dt_s > 0 and p.status.severity < 2]
    sigma = np.median([p.sigma for p in moving], axis=0) if moving else np.full(6, np.nan)
    return {
        "predictions": len(predictions),
        "in_domain": float(np.mean([p.in_domain > 0.5 for p in moving])) if moving else None,
        "median_sigma": {"translation_m": sigma[:3], "rotation_rad": sigma[3:]},
    }


def check(model: Model, run: Annotated[Path, typer.Argument(help="Run folder.")], json_: Json = False) -> None:
    """Check whether a model fits a camera and its conditions.

    Exits with 1 if it does not.

    Example: gpvo check errors.gpvo runs/hover
    """
    from dataclasses import asdict

    from gpvo.io.run import read_run
    from gpvo.learning.check import check as check_model
    from gpvo.online.predictor import Predictor

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
    to: Annotated[str | None, typer.Option(help="onnx or c; guessed from the suffix of --out.")] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="File to write; by default beside the model.")] = None,
    for_filter: Annotated[bool, typer.Option("--for-filter", hidden=True)] = False,
    prefix: Annotated[
        str, typer.Option(help="Prefix of every C symbol, so that several models fit into one program.")
    ] = "gpvo",
) -> None:
    """Export a model to ONNX or to one C header.

    Example: gpvo export errors.gpvo --to c
    """
    from gpvo.publish.export import SUFFIXES, export_model, format_of

    chosen = format_of(to, out)
    if for_filter:
        print("gpvo: --for-filter changes nothing any more: a model states no mean of the error", file=sys.stderr)
    target = out or model.with_name(model.stem + SUFFIXES[chosen])
    export_model(model, target, chosen, prefix=prefix)
    print(f"{target}: {target.stat().st_size} bytes")

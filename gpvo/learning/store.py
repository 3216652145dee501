"""A trained model on disk, side by side: the file, its training rows, and its card, what a person should know before
flying it, in Markdown with a picture (their texts are in ``templates``); and training from stored rows: those of a
model with new flights added, and sets larger than memory."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from datetime import datetime, timezone
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

from gpvo.dataset.table import CHUNK_ROWS, StoredSets, read_sets, write_sets
from gpvo.errors import ModelError
from gpvo.files import markdown_table, refuse_foreign, templates, write_text
from gpvo.io.run_read import Run
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import OnFit, TrainedModel, TrainingSet, train_sets, training_digest
from gpvo.online import modelfile


def card_path(model: Path) -> Path:
    """Of the model card."""
    return model.with_name(model.name + ".md")


def picture_path(model: Path) -> Path:
    """Of the card's picture."""
    return model.with_name(model.name + ".svg")


def rows_path(model: Path) -> Path:
    """Of the training rows, which ``--update`` adds to."""
    return model.with_name(model.name + ".rows.parquet")


def folds_path(model: Path) -> Path:
    """Of the folder with the folds of a training under way."""
    return model.with_name(f".{model.name}.folds")


def refuse_foreign_model(path: Path) -> None:
    """Raise OutputError, before any work, where no model, or nothing of what lies beside it, can be written: see
    :func:`gpvo.files.refuse_foreign`."""
    refuse_foreign(path, modelfile.KIND.encode(), "model")
    refuse_foreign(card_path(path), rb"trained on .{10} with gpvo", "model card")
    refuse_foreign(picture_path(path), b'font-family="system-ui, sans-serif" font-size="12"', "model's picture")
    refuse_foreign(rows_path(path), rb"\APAR1", "training rows")


def save_model(trained: TrainedModel, path: str | Path) -> None:
    """``path``, ``path.md`` with its picture ``path.svg``, and ``path.rows.parquet``; each whole or not at all. Kept
    folds are then deleted."""
    path = Path(path)
    refuse_foreign_model(path)
    write_sets(rows_path(path), trained.sets)
    picture = stated_against_actual(trained.table.get("folds", ()))
    if picture is None:
        picture_path(path).unlink(missing_ok=True)
    else:
        write_text(picture_path(path), picture)
    write_text(card_path(path), model_card(trained.header, trained.table, path.name))
    modelfile.save(path, trained.arrays, trained.header)
    shutil.rmtree(folds_path(path), ignore_errors=True)


def training_rows(path: str | Path) -> list[TrainingSet]:
    """The rows a model was trained on. Raises ModelError if they are gone or belong to another model."""
    path = Path(path)
    header = modelfile.load(path)[1]
    if not rows_path(path).is_file():
        cure = "train again from all runs"
        raise ModelError("the training rows are not beside the model", where=rows_path(path), cure=cure)
    sets = read_sets(rows_path(path))
    if training_digest(sets) != header.get("training_digest"):
        raise ModelError("holds rows of another model", where=rows_path(path), cure="train again from all runs")
    return sets


def config_of(path: str | Path) -> TrainConfig:
    """The settings a model was trained with."""
    known = {f.name for f in fields(TrainConfig)}
    return TrainConfig(**{k: v for k, v in modelfile.load(path)[1].get("config", {}).items() if k in known})


def update(
    path: str | Path,
    runs: Iterable[Run | TrainingSet],
    config: TrainConfig,
    *,
    judge: bool = True,
    tell: Callable[[str], None] = lambda _: None,
    on_fit: OnFit = lambda done, total: None,
) -> TrainedModel:
    """The model at ``path``, retrained with more sequences. A run with a known name replaces that sequence, and
    ``tell`` reports it."""
    old = training_rows(path)
    if old[0].target != config.target:
        raise ModelError(f"learns the target '{old[0].target}', not '{config.target}'", where=path)
    new = [config.rows_of(r) for r in runs]
    names = {s.name for s in new}
    for gone in (s.name for s in old if s.name in names):
        tell(f"sequence '{gone}' of {path} is replaced by the run of that name")
    return train_sets([*(s for s in old if s.name not in names), *new], config, judge=judge, on_fit=on_fit)


def train_stored(
    path: str | Path,
    config: TrainConfig,
    *,
    judge: bool = True,
    chunk_rows: int = CHUNK_ROWS,
    on_fit: OnFit = lambda done, total: None,
) -> TrainedModel:
    """Train from a file of training sets; memory never holds more than ``config.max_rows`` rows and a chunk.

    From larger files, blocks of consecutive rows are kept, equally many of each sequence.
    """
    stored = StoredSets(path)
    sets = stored.thinned(config.max_rows, chunk_rows)
    trained = train_sets(sets, config, judge=judge, on_fit=on_fit)
    trained.header["rows"] = {"given": len(stored), "in_memory": sum(len(s) for s in sets)}
    return trained


_PANELS = {"translation_m": "translation [mm]", "rotation_rad": "rotation [mrad]"}
_COLOURS = (
    "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf",
)  # fmt: skip
_SIZE, _LEFT, _TOP, _GAP = 260, 62, 14, 84
_BOTTOM = _TOP + _SIZE
_TRUE = math.sqrt(2.0)
"""Sigma within this factor counts as right, as in the verdict: NEES per degree of freedom from 0.5 to 2."""


def model_card(header: Mapping[str, Any], table: Mapping[str, Any], name: str) -> str:
    """Markdown from a model's header and its table of left-out sequences."""
    camera, c = header["camera"], header.get("calibration") or {}
    keys = ("name", "rows", "lost", "without_truth", "truth_moves_at_rest")
    rows = [[str(s.get(key, 0)) for key in keys] for s in header["sequences"]]
    domain = header["training_domain"]
    speeds = [abs(v) for axis in "xyz" for v in domain.get(f"v_{axis}_mps", ())]
    ranges = [[f"`{n}`", unit, f"{a:.4g}", f"{b:.4g}"] for (n, (a, b)), unit in zip(domain.items(), header["units"])]
    widths = zip(c.get("interval_levels", ()), c.get("interval_sigmas", [[]])[0])
    return _filled(
        "card.md.jinja",
        h=header,
        table=table,
        name=name,
        # Of SOURCE_DATE_EPOCH in the environment, which makes builds reproducible.
        today=_day(os.environ.get("SOURCE_DATE_EPOCH", "")),
        rig="" if camera is None else f"{camera['fx_px']:.1f} px, baseline {camera['baseline_m']:.4f} m",
        fastest=max(speeds, default=None),
        twins=header.get("simulated_truth") or (),
        sequences=_table(("sequence", "rows", "lost", "without truth", "truth moves at rest"), rows),
        each=[(fold["held_out"], fold["methods"]["learned"]) for fold in table.get("folds", ())],
        domain=_table(("feature", "unit", "from", "to"), ranges),
        widths=", ".join(f"{100 * level:.0f} %: {w:.2f}" for level, w in widths),
        ticked=lambda names: ", ".join(f"`{n}`" for n in names),
        numbers=lambda form, values: ", ".join(form % v for v in values),
        rig_of=lambda tolerance: ", ".join(f"{k} {v:g}" for k, v in tolerance.items()),
        scores=_scores,
        difference=partial(with_interval, unit=" nats per axis"),
    )


def _filled(template: str, **values: Any) -> str:
    from jinja2 import StrictUndefined

    environment = templates("gpvo.learning", lstrip_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined)
    return environment.get_template(template).render(values)


def _day(epoch: str) -> str:
    """That of a stamp in seconds; today without one."""
    now = datetime.fromtimestamp(int(epoch), timezone.utc) if epoch.isdecimal() else datetime.now(timezone.utc)
    return now.date().isoformat()


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(markdown_table(head, rows))


def _scores(scores: Iterable[tuple[str, Mapping[str, Any]]]) -> str:
    """A table of scores by name, without those that have no values."""
    rows = []
    for name, s in scores:
        numbers = [s["nees_dof"]["joint"], s["nees_dof_median"]["joint"], s["coverage"]["1"]]
        numbers += [s["nll_per_dim"], s["nll_stated_per_dim"]]
        if any(numbers):
            rows.append([name, *("-" if v is None else f"{v:.3g}" for v in numbers)])
    return _table(("", "NEES/dof", "median", "within 1 sigma", "NLL per axis, Gaussian", "as stated"), rows)


def with_interval(d: Mapping[str, float | None], unit: str = "") -> str:
    """A mean difference with its interval, signed."""
    interval = "(too few for an interval)" if d["low"] is None else f"[{d['low']:+.3f}, {d['high']:+.3f}]"
    return f"{d['mean']:+.3f}{unit} {interval}"


def stated_against_actual(folds: Sequence[Mapping[str, Any]]) -> str | None:
    """The card's picture as SVG: stated against actual error of motions that were left out of training; None where no
    fold has what it shows."""
    drawn = [f for f in folds if f.get("stated_and_actual")]
    if not drawn:
        return None
    return _filled(
        "card.svg.jinja",
        height=_BOTTOM + 52 + 16 * ((len(drawn) + 3) // 4),
        width=2 * (_LEFT + _SIZE) + 40,
        size=_SIZE,
        left=_LEFT,
        top=_TOP,
        bottom=_BOTTOM,
        colours=_COLOURS,
        names=[escape(str(f["held_out"])[:22]) for f in drawn],
        panels=[
            _panel(_LEFT + k * (_SIZE + _GAP), name, [f["stated_and_actual"][kind] for f in drawn])
            for k, (kind, name) in enumerate(_PANELS.items())
        ],
    )


def _panel(left: int, name: str, curves: Sequence[Sequence[tuple[float, float]]]) -> dict[str, Any]:
    """Log-log with equal scales, and the band in which sigma counts as right."""
    values = [1e3 * v for curve in curves for pair in curve for v in pair if v > 0] or [0.1, 10.0]
    low, high = min(values) / 1.3, max(values) * 1.3

    def at(value: float) -> float:
        return _SIZE * math.log(max(value, low) / low) / math.log(high / low)

    def points(pairs: Iterable[tuple[float, float]]) -> str:
        return " ".join(f"{left + at(x):.1f},{_BOTTOM - at(y):.1f}" for x, y in pairs)

    above, below = (low * _TRUE, low), (high, high / _TRUE)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1,) if math.log10(high / low) > 2 else (1, 3)
    ticks = [v for p in decades for m in steps if low <= (v := m * 10.0**p) <= high]
    return {
        "left": left,
        "name": name,
        "band": points((above[::-1], below[::-1], (high, high), below, above, (low, low))),
        "ticks": [(f"{left + at(v):.1f}", _BOTTOM - at(v), f"{v:g}") for v in ticks],
        "curves": [points((1e3 * s, 1e3 * a) for s, a in curve) for curve in curves],
    }

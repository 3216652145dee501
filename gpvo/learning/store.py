"""A trained model on disk: the file, its card and its training rows, side by side; and training from stored rows:
those of a model with new flights added, and sets larger than memory."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path

from gpvo.dataset.table import CHUNK_ROWS, StoredSets, read_sets, write_sets
from gpvo.errors import ModelError
from gpvo.files import refuse_foreign, write_text
from gpvo.io.run_read import Run
from gpvo.learning.card import model_card, stated_against_actual
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

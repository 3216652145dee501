"""Writing a trained model: the file, its card and its training rows, side by side."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from gpvo.dataset.table import read_sets, write_sets
from gpvo.errors import ModelError
from gpvo.io.atomic import write_text
from gpvo.learning.card import model_card
from gpvo.learning.cardplot import stated_against_actual
from gpvo.learning.train import TrainedModel, TrainingSet, training_digest
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


def check_writable(path: Path) -> None:
    """Raise ModelError, before any work, where no model can be written to ``path``."""
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise ModelError("cannot be written: not a file in a folder that is there and may be written", where=path)


def save_model(trained: TrainedModel, path: str | Path) -> None:
    """``path``, ``path.md`` with its picture ``path.svg``, and ``path.rows.parquet``; each whole or not at all. Kept
    folds are done with."""
    path = Path(path)
    check_writable(path)
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
    """The rows a model was trained on. Raises ModelError where they are gone or are another model's."""
    path = Path(path)
    header = modelfile.read_header(path)
    if not rows_path(path).is_file():
        raise ModelError(
            "the training rows are not beside the model", where=rows_path(path), cure="train again from all runs"
        )
    sets = read_sets(rows_path(path))
    if training_digest(sets) != header.get("training_digest"):
        raise ModelError("holds rows of another model", where=rows_path(path), cure="train again from all runs")
    return sets

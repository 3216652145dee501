"""Writing a trained model: the file, its card and its training rows, side by side."""

from __future__ import annotations

from pathlib import Path

from gpvo.dataset.table import read_sets, write_sets
from gpvo.errors import ModelError
from gpvo.io.atomic import write_text
from gpvo.learning.card import model_card
from gpvo.learning.train import TrainedModel, TrainingSet, training_digest
from gpvo.online import modelfile


def card_path(model: Path) -> Path:
    """Of the model card."""
    return model.with_name(model.name + ".md")


def rows_path(model: Path) -> Path:
    """Of the training rows, which ``--update`` adds to."""
    return model.with_name(model.name + ".rows.parquet")


def save_model(trained: TrainedModel, path: str | Path) -> None:
    """``path``, ``path.md`` and ``path.rows.parquet``; each replaced whole or not at all."""
    path = Path(path)
    if path.is_dir() or not path.parent.is_dir():
        raise ModelError("cannot be written: not a file in an existing folder", where=path)
    write_sets(rows_path(path), trained.sets)
    text = model_card(trained.header, trained.table, path.name)
    write_text(card_path(path), text)
    modelfile.save(path, trained.arrays, trained.header)


def training_rows(path: str | Path) -> list[TrainingSet]:
    """The rows a model was trained on. Raises ModelError where they are gone or are another model's."""
    path = Path(path)
    header = modelfile.read_header(path)
    if not rows_path(path).is_file():
        raise ModelError(
            "the training rows are not beside the model", where=rows_path(path), cure="train anew from all runs"
        )
    sets = read_sets(rows_path(path))
    if training_digest(sets) != header.get("training_digest"):
        raise ModelError("holds rows of another model", where=rows_path(path), cure="train anew from all runs")
    return sets

"""Training from rows that were kept: those of a model with one's own flights added, and sets larger than memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

from gpvo.dataset.stored import CHUNK_ROWS, StoredSets
from gpvo.errors import ModelError
from gpvo.io.run_read import Run
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import training_rows
from gpvo.learning.train import TrainedModel, train_sets
from gpvo.online import modelfile


def config_of(path: str | Path) -> TrainConfig:
    """The settings a model was trained with."""
    known = {f.name for f in fields(TrainConfig)}
    return TrainConfig(**{k: v for k, v in modelfile.read_header(path).get("config", {}).items() if k in known})


def update(
    path: str | Path,
    runs: Sequence[Run],
    config: TrainConfig,
    *,
    judge: bool = True,
    tell: Callable[[str], None] = lambda _: None,
) -> TrainedModel:
    """The model at ``path`` with more sequences. A run of a name it knows replaces that sequence; ``tell`` hears so."""
    old = training_rows(path)
    if old[0].target != config.target:
        raise ModelError(f"learns the target '{old[0].target}', not '{config.target}'", where=path)
    new = [config.rows_of(r) for r in runs]
    names = {s.name for s in new}
    for gone in (s.name for s in old if s.name in names):
        tell(f"sequence '{gone}' of {path} is replaced by the run of that name")
    return train_sets([*(s for s in old if s.name not in names), *new], config, judge=judge)


def train_stored(
    path: str | Path, config: TrainConfig, *, judge: bool = True, chunk_rows: int = CHUNK_ROWS
) -> TrainedModel:
    """Train from a file of training sets; in memory are never more than ``config.max_rows`` rows and a chunk.

    Of more rows, blocks of consecutive ones are kept, equally many of each sequence.
    """
    stored = StoredSets(path)
    sets = stored.thinned(config.max_rows, chunk_rows)
    trained = train_sets(sets, config, judge=judge)
    trained.header["rows"] = {"given": len(stored), "in_memory": sum(len(s) for s in sets)}
    return trained

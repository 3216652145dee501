"""Training sets larger than memory: at most so many rows are held, in blocks of every sequence."""

from __future__ import annotations

from pathlib import Path

from gpvo.dataset.stored import CHUNK_ROWS, StoredSets
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import TrainedModel, train_sets


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

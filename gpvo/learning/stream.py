"""Training sets larger than memory: blocks of rows teach the noise, every row the mean.

Base variance, inputs, noise, parts, calibration and the table come from at most ``max_rows`` rows, kept in blocks of
consecutive ones, equally many of each sequence. Where the model uses a mean, its hyperparameters are learnt from
minibatches of all rows (``svgp``; otherwise ``sparse``) and its posterior from one pass over all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.dataset.stored import CHUNK_ROWS, StoredSets
from gpvo.errors import GpvoError
from gpvo.learning.config import TrainConfig
from gpvo.learning.fit import Learned
from gpvo.learning.meanfit import only_inputs, only_outputs
from gpvo.learning.regressors.rows import RawChunk
from gpvo.learning.regressors.sparse import SparseRegressor
from gpvo.learning.regressors.svgp import SvgpRegressor
from gpvo.learning.train import TrainedModel, train_sets
from gpvo.online.basis import SharedBasis

_PRECISION_RANGE = 1e4


def train_stored(
    path: str | Path, config: TrainConfig, *, judge: bool = True, chunk_rows: int = CHUNK_ROWS
) -> TrainedModel:
    """Train from a file of training sets; in memory are never more than ``config.max_rows`` rows and a chunk.

    Raises GpvoError for a regressor that cannot stream, where there are more rows than that.
    """
    stored = StoredSets(path)
    if len(stored) > config.max_rows and config.regressor not in ("auto", "sparse", "svgp"):
        raise GpvoError(
            f"{len(stored)} rows are more than the {config.max_rows} held in memory, and '{config.regressor}' cannot"
            " stream",
            cure="--regressor svgp, or a larger --max-rows",
        )
    sets = stored.thinned(config.max_rows, chunk_rows)
    kept = sum(len(s) for s in sets)
    refine = None if kept == len(stored) else lambda learned: with_streamed_mean(learned, stored, config, chunk_rows)
    trained = train_sets(sets, config, judge=judge, refine=refine)
    trained.header["rows"] = {"given": len(stored), "in_memory": kept}
    return trained


def with_streamed_mean(
    learned: Learned, stored: StoredSets, config: TrainConfig, chunk_rows: int = CHUNK_ROWS
) -> Learned:
    """The same model with its mean learnt from all rows of the file; as it is where it uses no mean."""
    use = np.array(learned.choices["use_mean"], dtype=bool)
    if not use.any():
        return learned
    kind = SvgpRegressor if config.regressor == "svgp" else SparseRegressor
    fitted = kind(inducing=config.inducing).fit_rows(_Rows(stored, learned, use, chunk_rows), seed=config.seed)
    model, old = learned.model, learned.model.basis
    gp = only_inputs(only_outputs(fitted.gp, use), learned.mean_inputs, len(model.inputs))
    basis = SharedBasis(gp, old.noise, old.log_noise_offset)
    model = replace(model, basis=basis)
    return replace(learned, model=model, arrays={**learned.arrays, **model.to_arrays()})


@dataclass(frozen=True)
class _Rows:
    """All rows of a file as the mean sees them, pieces of every sequence in each chunk: a minibatch is of no one flight
    alone."""

    stored: StoredSets
    learned: Learned
    use: NDArray[np.bool_]
    chunk_rows: int

    def __len__(self) -> int:
        return len(self.stored)

    def __iter__(self) -> Iterator[RawChunk]:
        total, lengths = len(self.stored), self.stored.lengths
        shares = [max(1, round(self.chunk_rows * n / total)) for n in lengths]
        open_ = {i: self.stored.chunks(i, share) for i, share in enumerate(shares)}
        while open_:
            pieces = [(i, next(chunks, None)) for i, chunks in open_.items()]
            for i, piece in pieces:
                if piece is None:
                    del open_[i]
            made = [self._chunk(piece, total / (len(lengths) * lengths[i])) for i, piece in pieces if piece is not None]
            if made:
                X, Y, w, count = zip(*made, strict=True)
                yield np.concatenate(X), np.concatenate(Y), np.concatenate(w), np.concatenate(count)

    def _chunk(self, s: TrainingSet, count: float) -> RawChunk:
        """Inputs drawn into the domain, errors, precision by the noise learnt so far; sequences count alike."""
        model = self.learned.model
        X = s.select(model.columns)
        v = model.variances(X, s.dt_s)
        # The scale of a precision is arbitrary; relative to the typical row it keeps its range.
        typical = 0.0 if model.mean_in_sigma[0] else model.level.mean()
        precision = np.exp(typical - np.log(v.total / v.unit**2).mean(axis=1))
        return (
            v.place.inside[:, model.inputs[self.learned.mean_inputs]],
            (s.Y / v.unit)[:, self.use],
            np.clip(precision, 1.0 / _PRECISION_RANGE, _PRECISION_RANGE),
            np.full(len(X), count),
        )

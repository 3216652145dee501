"""The protocol every regressor follows, and what a fit gives back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from gpvo.online.basis import ProjectedGP
from gpvo.types import Array


@dataclass(frozen=True)
class Hyperparameters:
    """Of a squared-exponential kernel shared by D outputs of d inputs, in the units of the data.

    ``lengthscale`` (d,); ``signal_var``, ``noise_var`` (D,). A row of noise weight w has noise variance ``noise_var /
    w``.
    """

    lengthscale: Array
    signal_var: Array
    noise_var: Array


@dataclass(frozen=True)
class FittedGP:
    """A fitted GP: its posterior in projected form, in the units of the data.

    ``gp``: posterior of the latent functions (NumPy, see ``gpvo.online.basis``). ``hyper``: what was learnt.
    ``log_evidence``: log marginal likelihood of the optimised rows, or its lower bound, in nats and in the units of
    the data. ``regressor``: name. ``n_rows``: rows conditioned on.
    """

    gp: ProjectedGP
    hyper: Hyperparameters
    log_evidence: float
    regressor: str
    n_rows: int

    def predict(self, X: Array) -> tuple[Array, Array]:
        """Mean (n, D) and latent variance (n, D) at rows X (n, d); add ``hyper.noise_var / w`` for an observation."""
        return self.gp.evaluate(X)


class Regressor(Protocol):
    """Fits D outputs that share one kernel. Options go to the constructor; the same data gives the same bits."""

    name: str

    def fit(
        self,
        X: Array,
        Y: Array,
        *,
        noise_weight: Array | None = None,
        sample_weight: Array | None = None,
        seed: int = 0,
    ) -> FittedGP:
        """Learn the hyperparameters and the posterior.

        X (n, d) and Y (n, D) finite. ``noise_weight`` (n,): precision of each row relative to ``1 / noise_var``, one
        profile for all outputs. ``sample_weight`` (n,): how often a row counts. Raises ValueError on shapes that do
        not fit.
        """
        ...

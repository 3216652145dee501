"""Several policies over one run at once: as members of one filter they cost little more than one alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.filters.measurement import MotionNoise
from gpvo.filters.policies import Policy
from gpvo.filters.run import Flight, FusedRun, FuseOptions, fuse_flight
from gpvo.types import Prediction, VoRecord

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Stacked:
    """The noises of several policies, one member each, by the records' stamps."""

    noises: Mapping[int, MotionNoise]
    name: str = "side by side"

    def noise(self, record: VoRecord, prediction: Prediction | None) -> MotionNoise | None:
        return self.noises.get(record.t_ns)


def fuse_side_by_side(
    flight: Flight, policies: Mapping[str, Policy], options: FuseOptions | None = None
) -> dict[str, FusedRun]:
    """Filter one run under each policy (of one member); results as if each had filtered alone.

    Members see the same clock and the same records. A policy that has nothing to say about some records, or whose bias
    has other time constants, is filtered by itself.
    """
    stated = {name: _noises(flight, policy) for name, policy in policies.items()}
    together = _alike(stated)
    out: dict[str, FusedRun] = {}
    if len(together) > 1:
        noises = {t: _stack([stated[name][t] for name in together]) for t in stated[together[0]]}
        fused = fuse_flight(flight, _Stacked(noises), options, batch=len(together))
        out = {name: replace(run, policy=name) for name, run in zip(together, fused, strict=True)}
    for name, policy in policies.items():
        if name not in out:
            out[name] = fuse_flight(flight, policy, options)[0]
    return out


def _noises(flight: Flight, policy: Policy) -> dict[int, MotionNoise]:
    usable = (r for r in flight.records if r.usable)
    found = ((r.t_ns, policy.noise(r, flight.predictions.get(r.t_ns))) for r in usable)
    return {t: noise for t, noise in found if noise is not None}


def _alike(stated: Mapping[str, Mapping[int, MotionNoise]]) -> list[str]:
    """Policies that speak for all records that any speaks for, with one set of time constants."""
    everything = {t for noises in stated.values() for t in noises}
    taus: set[bytes] = set()
    names = []
    for name, noises in stated.items():
        own = {n.bias_tau_s.tobytes() for n in noises.values() if n.bias_tau_s is not None}
        if noises.keys() == everything and len(own | taus) <= 1:
            taus |= own
            names.append(name)
    return names


def _stack(noises: Sequence[MotionNoise]) -> MotionNoise:
    def stacked(parts: Sequence[Array | None]) -> Array | None:
        known = [p for p in parts if p is not None]
        return np.concatenate([np.zeros_like(known[0]) if p is None else p for p in parts]) if known else None

    return MotionNoise(
        np.concatenate([n.mean for n in noises]),
        np.concatenate([n.white for n in noises]),
        stacked([n.jitter for n in noises]),
        stacked([n.bias_root for n in noises]),
        next((n.bias_tau_s for n in noises if n.bias_tau_s is not None), None),
    )

"""Several policies over one run at once: as members of one filter they cost little more than one alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gpvo.filters.policies import Policy
from gpvo.filters.run import Flight, FusedRun, FuseOptions, fuse_flight
from gpvo.types import MotionError, Prediction, VoRecord


@dataclass(frozen=True)
class _Stacked:
    """The noises of several policies, one member each, by the records' stamps."""

    noises: Mapping[int, MotionError]
    name: str = "side by side"

    def noise(self, record: VoRecord, prediction: Prediction | None) -> MotionError | None:
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


def _noises(flight: Flight, policy: Policy) -> dict[int, MotionError]:
    usable = (r for r in flight.records if r.usable)
    found = ((r.t_ns, policy.noise(r, flight.predictions.get(r.t_ns))) for r in usable)
    return {t: noise for t, noise in found if noise is not None}


def _alike(stated: Mapping[str, Mapping[int, MotionError]]) -> list[str]:
    """Policies that speak for all records that any speaks for, with one set of time constants and of lost motions."""
    everything = {t for noises in stated.values() for t in noises}
    shared: set[tuple[bytes, frozenset[int]]] = set()
    names = []
    for name, noises in stated.items():
        # What a lost motion does not share is nothing to members whose motions share nothing.
        lost = frozenset(t for t, n in noises.items() if n.lost)
        own = {(n.persistent_tau_s.tobytes(), lost) for n in noises.values() if len(n.persistent_tau_s)}
        if noises.keys() == everything and len(own | shared) <= 1:
            shared |= own
            names.append(name)
    return names


def _stack(noises: Sequence[MotionError]) -> MotionError:
    """One member each; what persists for some has no part in the error of the others."""
    tau_s = next((n.persistent_tau_s for n in noises if len(n.persistent_tau_s)), np.zeros(0))
    roots = (n.persistent_root if len(n.persistent_tau_s) else np.zeros((1, 6, len(tau_s))) for n in noises)
    return MotionError(
        mean=np.concatenate([n.mean for n in noises]),
        jitter=np.concatenate([n.jitter for n in noises]),
        white=np.concatenate([n.white for n in noises]),
        persistent_root=np.concatenate(list(roots)),
        persistent_tau_s=tau_s,
        dt_s=noises[0].dt_s,
        status=max((n.status for n in noises), key=lambda status: status.severity),
    )

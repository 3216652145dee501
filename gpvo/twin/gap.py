"""Which runs are twins, and their gap to reality: how far real errors exceed what twins predict, learned where truth
exists."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from gpvo.errors import SourceError
from gpvo.files import read_json
from gpvo.geometry import se3
from gpvo.types import Array, TruthLog, VoRecord

SPAN = "1 s"
"""The span whose ratios are carried: beyond a frame or two, where the truth's own noise no longer counts."""
_LARGEST = 100.0


@dataclass(frozen=True)
class Gap:
    """Log-normal factors on errors, by axis: ``ratio`` (6) the median, ``spread`` (6) one sigma, as a factor."""

    ratio: tuple[float, ...]
    spread: tuple[float, ...]

    def factors(self, count: int) -> Array:
        """(count, 6) one draw for each replicate: quantiles in its middle of as many equal parts, the same part on all
        axes, as the runs that are off on one axis are off on the others."""
        at = np.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
        return np.asarray(self.ratio) * np.asarray(self.spread) ** at[:, None]


GAPS = {
    # Six KITTI drives with tracks of one front end, eight twins each, 30 November 2026 (docs/concepts/twins.rst).
    "drives": Gap((1.10, 1.13, 1.28, 1.05, 1.31, 1.36), (1.71, 1.35, 1.66, 1.57, 1.43, 1.43)),
}
"""By name."""


def pooled(ratios: Array) -> tuple[Array, Array]:
    """Geometric mean (...) of ratios (R, ...) over runs, and the factor by which they spread about it: 1 for one run;
    NaN where no run is long enough."""
    logs = np.log(ratios)
    known = np.isfinite(logs)
    count = known.sum(axis=0)
    with np.errstate(invalid="ignore"):
        mean = np.where(known, logs, 0.0).sum(axis=0) / np.where(count > 0, count, np.nan)
    variance = np.where(known, (logs - mean) ** 2, 0.0).sum(axis=0) / np.maximum(count - 1, 1)
    return np.exp(mean), np.exp(np.sqrt(variance))


def read_gap(text: str) -> Gap:
    """A named gap, or that of a file of what ``gpvo twin --against --json`` prints. Raises SourceError where the file
    holds none."""
    if text in GAPS:
        return GAPS[text]
    path = Path(text)
    try:
        found = read_json(path)["pooled"][SPAN]
        gap = Gap(*(tuple(float(v) for v in found[key]) for key in ("ratio", "spread")))
    except (KeyError, TypeError, ValueError):
        gap = Gap((), ())
    values = np.array([*gap.ratio, *gap.spread])
    if values.shape != (12,) or not ((values > 1 / _LARGEST) & (values < _LARGEST)).all():
        raise SourceError("is not the output of gpvo twin --against --json", where=path, cure="give that, or drives")
    return gap


def restated(
    record: VoRecord, truth: TruthLog, factor: Sequence[float] | Array = (1.0,) * 6, onto: TruthLog | None = None
) -> VoRecord:
    """A record whose error is ``factor`` (6,) times as large, of a vehicle that flew ``onto`` in place of ``truth``;
    these hold its two stamps."""
    if not record.usable:
        return record
    T_true, T_onto = (_motion(record, t) for t in (truth, onto or truth))
    xi = se3.log(se3.inverse(T_true) @ record.T_prev_cur)
    return replace(record, T_prev_cur=T_onto @ se3.exp(np.asarray(factor) * xi))


def _motion(record: VoRecord, truth: TruthLog) -> Array:
    i, j = np.searchsorted(truth.t_ns, [record.t_prev_ns, record.t_ns])
    return se3.inverse(truth.T_world_cam[i]) @ truth.T_world_cam[j]


def simulated_truth(metas: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Which of some runs, by their ``run.json``, are twins: of what, how many, with which tolerance."""
    found: dict[str, dict[str, Any]] = {}
    for about in (m["twin"] for m in metas if m.get("twin")):
        kept = {k: about.get(k) for k in ("of", "tolerance_name", "tolerance", "gap")}
        key = json.dumps(kept)
        kept["seed"] = about["seed"]
        found.setdefault(key, {**kept, "twins": 0})["twins"] += 1
    return list(found.values())

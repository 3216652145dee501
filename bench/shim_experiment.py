"""How honest the shim is on anyone's odometry: each sequence left out, and each system left out.

``python -m bench.shim_experiment FOLDER -o DIR [--only within,across] [--systems A,B,C] [--features NAMES]``

``FOLDER`` holds ``SEQUENCE/SYSTEM.tum``, poses of a body by some systems on some sequences, and
``SEQUENCE/truth.tum``. ``within``: a model of one system's other sequences. ``across``: a model of all sequences of the
other systems, with the verdict of its guard; truth and vehicle of a sequence are then known from them, the system is
not. NEES is per degree of freedom, NLL in nats per axis.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gpvo.cli.files import import_log
from gpvo.dataset.build import TrainingSet
from gpvo.dataset.check import check
from gpvo.files import write_json
from gpvo.io.foreign import read_foreign
from gpvo.io.run import is_finished, read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.methods import method_arrays, score
from gpvo.learning.train import TrainedModel, estimate_set, train_sets

FEATURES = "velocity,rotation,agility"


def run(
    folder: Path, out: Path, only: Sequence[str], systems: Sequence[str] | None = None, features: str = FEATURES
) -> dict[str, Any]:
    """The document of both experiments; ``shim.json`` in ``out``. Raises SourceError where a log cannot be read."""
    config = TrainConfig(features=features)
    names = systems or sorted({p.stem for p in folder.glob("*/*.tum")} - {"truth"})
    runs = {s: [imported(p, out / "runs") for p in sorted(folder.glob(f"*/{s}.tum"))] for s in names}
    sets = {s: [replace(config.rows_of(read_run(p)), name=p.name) for p in paths] for s, paths in runs.items()}
    found: dict[str, Any] = {}
    for system in names:
        if "within" in only:
            keep = out / "folds"
            keep.mkdir(parents=True, exist_ok=True)
            trained = train_sets(sets[system], replace(config, keep=str(keep)))
            rows = [_row(f["held_out"], f["methods"], f["in_domain"]) for f in trained.table["folds"]]
            found.setdefault("within", {})[system] = _told(f"{system}, other sequences", rows)
        if "across" in only and len(names) > 1:
            others = [replace(s, name=f"{o}/{s.name}") for o in names if o != system for s in sets[o]]
            rows = _judged(train_sets(others, config, judge=False), others, sets[system], runs[system])
            found.setdefault("across", {})[system] = _told(f"{system}, other systems", rows)
        write_json(out / "shim.json", found)
    return found


def imported(log: Path, runs: Path) -> Path:
    """The run of a log against the truth beside it, made unless it is there."""
    out = runs / log.stem / log.parent.name
    if not is_finished(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        truth = read_foreign(log.parent / "truth.tum", complete=True)
        summary = import_log(read_foreign(log), truth, out, frame="body", align="transform")
        print(f"{log.stem} {log.parent.name}: {summary}")
    return out


def _judged(
    trained: TrainedModel, others: Sequence[TrainingSet], sets: Sequence[TrainingSet], runs: Sequence[Path]
) -> list[dict[str, Any]]:
    """A row for each sequence of a system that the model has not seen."""
    predictor, constant, rows = trained.predictor(), method_arrays(others)["method.constant"], []
    for s, path in zip(sets, runs, strict=True):
        e = estimate_set(predictor.model, s)
        none = np.zeros((len(s), 6))
        methods = {
            "learned": score(s.Y, e.mean, e.covariance, e.nu),
            "constant": score(s.Y, none, np.broadcast_to(constant, (len(s), 6, 6))),
        }
        verdict = check(predictor, read_run(path))
        rows.append(_row(s.name, methods, verdict.in_domain) | {"fits": verdict.fits, "problems": verdict.problems})
    return rows


def _row(sequence: str, methods: dict[str, Any], in_domain: float) -> dict[str, Any]:
    kept = ("nees_dof", "nees_dof_median", "nees_dof_median_stated", "nll_per_dim", "nll_stated_per_dim")
    scored: dict[str, Any] = {
        m: {k: methods[m][k] for k in kept} for m in ("learned", "base", "constant") if m in methods
    }
    return {"sequence": sequence, "in_domain": in_domain, **scored}


def _told(title: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    print(f"{title}: NEES (translation, rotation), median, NLL, as stated, of the constant; in domain")
    for r in rows:
        of, constant = r["learned"], r["constant"]["nll_per_dim"]
        nees, fits = of["nees_dof"], {True: ", fits", False: ", DOES NOT FIT", None: ""}[r.get("fits")]
        print(
            f"  {r['sequence']}: {nees['joint']:.2f} ({nees['translation']:.2f}, {nees['rotation']:.2f}),"
            f" {of['nees_dof_median']['joint']:.2f}, {of['nll_per_dim']:.2f}, {of['nll_stated_per_dim']:.2f},"
            f" {constant:.2f}; {100 * r['in_domain']:.0f} %{fits}",
            flush=True,
        )
    joint = np.array([r["learned"]["nees_dof"]["joint"] for r in rows])
    less = np.mean([r["learned"]["nll_per_dim"] < r["constant"]["nll_per_dim"] for r in rows]) * len(rows)
    inside = int(((joint >= 0.5) & (joint <= 2.0)).sum())
    print(f"  NEES within 0.5 to 2 on {inside} of {len(rows)}, NLL below the constant's on {less:.0f}", flush=True)
    return rows


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", default="within,across")
    parser.add_argument("--systems")
    parser.add_argument("--features", default=FEATURES)
    given = parser.parse_args()
    systems = given.systems.split(",") if given.systems else None
    run(given.folder, given.out, given.only.split(","), systems, given.features)


if __name__ == "__main__":
    main()

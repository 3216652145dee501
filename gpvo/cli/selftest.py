"""``gpvo selftest``: does everything work on this machine? From simulated tracks to a filter, in fifteen seconds."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from gpvo.errors import EXTRA_OF, GpvoError
from gpvo.io.run import read_run
from gpvo.io.source import open_source
from gpvo.online.predictor import Predictor

_FLIGHTS = 3
_LAST, _MODEL = f"run{_FLIGHTS - 1}", "model.gpvo"
_SECONDS, _RATE_HZ = 15.0, 10.0


class _Wrong(Exception):
    """A part ran, but its result is not what it should be."""


def selftest() -> None:
    """Test this installation, in about fifteen seconds.

    Simulates, runs odometry, evaluates, trains, predicts and fuses: [PASS], [FAIL] or [SKIP] for each.

    Example: gpvo selftest
    """
    parts = (
        ("simulate", _simulate), ("odometry", _odometry), ("evaluate", _evaluate), ("train", _train),
        ("predict", _predict), ("filter", _filter), ("messages", _messages),
    )  # fmt: skip
    failed, missing = [], ""
    with tempfile.TemporaryDirectory(prefix="gpvo-selftest-") as folder:
        for name, part in parts:
            began = time.monotonic()
            if missing:
                print(f"[SKIP] {name}: needs {missing}")
                continue
            verdict, said = _try(part, Path(folder))
            print(f"[{verdict}] {name}: {said} ({time.monotonic() - began:.1f} s)", flush=True)
            if verdict != "PASS":
                missing = name
            if verdict == "FAIL":
                failed.append(name)
    if failed:
        raise GpvoError(f"{', '.join(failed)} failed", cure="reinstall gpvo; if that does not help, report these lines")


def _try(part: Callable[[Path], str], folder: Path) -> tuple[str, str]:
    try:
        return "PASS", part(folder)
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRA_OF:
            return "FAIL", str(error)
        return "SKIP", f"package '{package}' is not installed (pip install 'gpvo[{EXTRA_OF[package]}]')"
    except Exception as error:  # whatever breaks is this command's finding
        return "FAIL", f"{type(error).__name__}: {error}"


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise _Wrong(what)


def _simulate(folder: Path) -> str:
    from gpvo.sim.points import simulate_points

    for seed in range(_FLIGHTS):
        flight = simulate_points("tunnel-bursts", seed, duration_s=_SECONDS, rate_hz=_RATE_HZ)
        flight.save(folder / f"flight{seed}.npz")
    return f"{_FLIGHTS} flights of {_SECONDS:g} s"


def _odometry(folder: Path) -> str:
    from gpvo import runner

    said = []
    for seed in range(_FLIGHTS):
        summary = runner.run(open_source(folder / f"flight{seed}.npz"), folder / f"run{seed}")
        moved = summary.status.get("ok", 0) + summary.status.get("degraded", 0)
        _require(moved >= 0.8 * summary.frames, f"only {moved} of {summary.frames} frames have a motion")
        said.append(summary.frames_per_s)
    return f"{sum(said) / len(said):.0f} frames/s"


def _evaluate(folder: Path) -> str:
    from gpvo.evaluation.evaluate import evaluate_run

    t = evaluate_run(read_run(folder / _LAST)).trajectory
    _require(t.ate_rmse_m < 0.05 * t.path_length_m, f"ATE of {t.ate_rmse_m:.2g} m over {t.path_length_m:.3g} m")
    return f"ATE {t.ate_rmse_m:.3f} m over {t.path_length_m:.0f} m"


def _train(folder: Path) -> str:
    from gpvo.learning.config import TrainConfig
    from gpvo.learning.store import save_model
    from gpvo.learning.train import train_sets

    config = TrainConfig()
    sets = [config.rows_of(read_run(folder / f"run{seed}")) for seed in range(_FLIGHTS - 1)]
    save_model(train_sets(sets, config, judge=False), folder / _MODEL)
    return f"a model of {sum(map(len, sets))} motions, {(folder / _MODEL).stat().st_size / 1e3:.0f} kB"


def _predict(folder: Path) -> str:
    from gpvo.evaluation.evaluate import evaluate_run

    learned = evaluate_run(read_run(folder / _LAST), Predictor.load(folder / _MODEL)).consistency["learned"]
    nees = learned.nees_dof["joint"]
    _require(nees is not None and 0.2 < nees.mean < 5.0, f"NEES/dof {nees} on a flight left out")
    return f"NEES/dof {nees} on a flight left out (1 is right)"


def _filter(folder: Path) -> str:
    from gpvo.evaluation.fusion import FusionSettings, fuse_runs

    report = fuse_runs([folder / _LAST], FusionSettings(model=folder / _MODEL, policies=("learned",)))
    score = report.study.scores["learned"][0]
    _require(score is not None and not score.diverged, "the filter diverged")
    assert score is not None
    return f"ATE {score.ate_rmse_m:.3f} m with an IMU"


def _messages(folder: Path) -> str:
    from gpvo.publish.odometry import OdometryBuilder

    run = read_run(folder / _LAST)
    predictor, builder = Predictor.load(folder / _MODEL), OdometryBuilder(run.mounting.T_body_cam)
    predictor.reset(run.log.camera)
    messages = [builder.step(record, predictor.step(record)) for record in run.log]
    return f"{len(messages)} odometry messages"

"""The verdict says in words what the numbers say: true, overconfident, too cautious, outside the domain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from evaluation_runs import make_run
from gpvo.dataset.hand_eye import FixedRotation
from gpvo.evaluation.evaluate import Evaluation, evaluate_run
from gpvo.evaluation.verdict import verdict
from gpvo.io.run_read import Run
from gpvo.types import Mounting, VoLog


def evaluated(factors: dict[str, float]) -> Evaluation:
    """A run whose methods state the true covariance times a factor each."""
    log, truth = make_run(600)
    records = [
        replace(r, v_t={}, covariances={m: f * r.covariances["triangulation"] for m, f in factors.items()})
        if r.usable
        else r
        for r in log
    ]
    return evaluate_run(Run(Path("hall"), "hall", VoLog(records, log.camera), truth, None, Mounting(), []))


@pytest.mark.parametrize(
    "factor,colour,word", [(1.0, "green", "is honest"), (0.1, "red", "overconfident"), (10.0, "amber", "too cautious")]
)
def test_one_method(factor: float, colour: str, word: str) -> None:
    found = verdict(evaluated({"triangulation": factor}))
    assert found.colour == colour
    assert word in found.headline
    if factor != 1.0:
        assert "by a factor of 3." in found.lines[0]


def test_the_method_that_is_true_is_named() -> None:
    found = verdict(evaluated({"triangulation": 0.05, "pointing_matching": 1.0}))
    assert found.colour == "green"
    assert "pointing_matching" in found.headline
    assert any(line.startswith("triangulation: overconfident") for line in found.lines)


def test_outside_the_domain_is_never_green() -> None:
    found = verdict(replace(evaluated({"triangulation": 1.0}), in_domain=0.1))
    assert found.colour == "red"
    assert "does not know these conditions" in found.headline
    assert any(line.startswith("10 % of the frames") for line in found.lines)


@pytest.mark.parametrize(("angle_deg", "asks"), [(2.0, False), (89.0, False), (120.0, True), (179.5, True)])
def test_a_rotation_that_no_mounting_has_is_asked_about(angle_deg: float, asks: bool) -> None:
    found = verdict(replace(evaluated({"triangulation": 1.0}), turned=FixedRotation(angle_deg, (0.0, 0.0, 0.0), -0.5)))
    [line] = [line for line in found.lines if f"fixed rotation of {angle_deg:.2f} deg (mounting or calibration" in line]
    assert ("quaternion's order" in line) is asks
    assert ("--frame" in line) is asks
    assert "50 % smaller" in line


def test_nothing_stated_is_said() -> None:
    assert "nothing can be judged" in verdict(evaluated({})).headline

"""The declared list: the thesis' figures as printed, every row with flights and models."""

import pytest
from gpvo.reproduce.bounds import method_of
from gpvo.reproduce.experiments import (
    EXPERIMENTS,
    FLIGHTS,
    SENSITIVITY,
    SENSITIVITY_PX,
    WAYS,
    printed,
    sigma_pairs,
)

# Table, RMSE, final and predicted final error [m], residual of the GP.
PRINTED = [
    ("4.1", 2.03, 2.47, 3.32, None),
    ("4.1", 2.79, 3.32, 7.01, None),
    ("4.2", 1.92, 1.49, 3.21, None),
    ("4.2", 2.79, 2.98, 4.90, None),
    ("4.3", 1.81, 1.03, 2.11, 1.94),
    ("4.4", 3.01, 1.79, 4.36, None),
    ("4.5", 1.57, 1.41, 1.92, None),
    ("4.6", 1.57, 1.41, 2.99, 2.49),
]


def test_every_row_of_the_thesis_is_there():
    found = [
        (e.table, p["rmse_m"], p["final_error_m"], p["predicted_final_error_m"], p["residual_m"])
        for e in EXPERIMENTS
        if (p := e.thesis) is not None
    ]
    assert found == PRINTED
    assert len({e.key for e in (*EXPERIMENTS, *SENSITIVITY)}) == len(EXPERIMENTS) + len(SENSITIVITY)


def test_the_ratios_of_the_thesis_are_as_the_thesis_has_them():
    ratios = [e.thesis["ratio"] for e in EXPERIMENTS if e.thesis]
    assert min(ratios) == pytest.approx(1.3, abs=0.06)
    assert max(ratios) == pytest.approx(2.4, abs=0.05)
    gp = [e.thesis["residual_over_rmse"] for e in EXPERIMENTS if e.thesis]
    assert all(r > 1.0 for r in gp if r is not None)


def test_every_row_flies_and_learns_from_other_flights():
    for e in (*EXPERIMENTS, *SENSITIVITY):
        assert not FLIGHTS[e.flights].is_training
        assert FLIGHTS[e.training].is_training


def test_figures_one_to_nine():
    figures = sorted(e.figure for e in (*EXPERIMENTS, *SENSITIVITY) if e.figure)
    assert list(dict.fromkeys(figures)) == [f"4.{k}" for k in range(1, 10)]
    assert SENSITIVITY_PX == ((0.1, 0.1), (0.1, 0.5), (0.1, 1.0))


def test_what_is_printed_without_a_square_is_kept_in_the_recipe_alone():
    row = next(e for e in EXPERIMENTS if e.key == "4.2-clean")
    assert printed((0.1, 0.5))[0] ** 2 == pytest.approx(0.1)
    assert printed((0.1, 0.5)) in sigma_pairs(row.flights, "thesis")
    assert row.sigma_px in sigma_pairs(row.flights, "fast")
    assert method_of(row, "recipe").kind == "v_t"
    assert method_of(row, "recipe").name != method_of(row, "corrected").name
    assert method_of(row, "recipe").preset == "thesis"


@pytest.mark.parametrize("way", WAYS)
def test_ways_of_a_gp_row(way):
    row = next(e for e in EXPERIMENTS if e.key == "4.3")
    assert method_of(row, way).kind == {"recipe": "position", "corrected": "motion", "full": "learned"}[way]

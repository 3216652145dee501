"""Fixtures for every test."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# What is imported stays, so nothing is gained by searching it for garbage, again and again, until it is all there.
gc.disable()

# The same examples in every run; explore with `pytest --hypothesis-profile=explore`.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile("same")

# Helper modules lie beside the tests that use them; `bench` at the root.
for folder in {Path(__file__).parents[1], *(p.parent for p in Path(__file__).parent.rglob("*.py"))}:
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


LONGEST = (
    "test_no_mutated_input_of_many_breaks_anything",
    "test_learned_covariance_beats_the_best_constant_where_vo_fails_for_seconds",
    "test_everything_without_pictures",
    "test_memory_stays_flat_over_ten_thousand_frames",
    "test_the_learned_covariance_is_true_on_flights_not_seen",
    "test_forecast_along_unseen_simulated_flights",
    "test_the_stress_list_on_a_drive",
    "test_the_stress_list",
    "test_every_command_runs",
    "test_thousands_of_frames",
)
"""Tests of a minute or more of processor time, the longest first."""


@pytest.hookimpl(trylast=True)  # of those that are left
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of two workers, the first begins with the kills, which wait more than they compute, and the second, which has the
    latter half, with the longest: at the end of each half are short ones, so that both end together."""
    kills, longest, others = [], [], []
    for item in items:
        name = item.name.partition("[")[0]
        (kills if "kills" in item.path.parts else longest if name in LONGEST else others).append(item)
    longest.sort(key=lambda item: LONGEST.index(item.name.partition("[")[0]))
    middle = max(len(items) // 2 - len(kills), 0)
    items[:] = [*kills, *others[:middle], *longest, *others[middle:]]


def pytest_collection_finish() -> None:
    """Only what the tests make is searched for garbage."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real sequences named by GPVO_DATA; the test is skipped where it is unset."""
    folder = os.environ.get("GPVO_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("set GPVO_DATA to the folder of real sequences to run this test")
    return Path(folder)

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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Kills come first: they wait more than they compute, and at the end nothing would be left to run beside them."""
    items.sort(key=lambda item: "kills" not in item.path.parts)


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

"""Twins of one run by equal settings are made once."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from gpvo.twin import replicate
from gpvo.twin.replicate import Original, TwinSettings


@pytest.fixture(scope="module", autouse=True)
def each_twin_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is the subject of another test is copied where it was made before: runs of this module stay as they are."""
    made: dict[tuple[Path, TwinSettings, int], Path] = {}
    make = replicate._make_twin

    def once(original: Original, settings: TwinSettings, k: int, out: Path, of: str) -> Path:
        key = (original.run.path, settings, k)
        if key not in made:
            made[key] = make(original, settings, k, tmp_path_factory.mktemp("made"), of)
        return Path(shutil.copytree(made[key], out / made[key].name, dirs_exist_ok=True))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replicate, "_make_twin", once)
        patch.setattr(replicate, "estimate", cache(replicate.estimate))
        yield

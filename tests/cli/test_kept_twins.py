"""Twins that a command makes for itself outlive its death, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from gpvo.cli import twin
from gpvo.errors import GpvoError
from gpvo.twin.replicate import TwinSettings

SETTINGS = TwinSettings(replicates=2)


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[bool]]:
    """Whether a twin of an earlier attempt lies there, for each of the next ones, which end by the given errors."""
    monkeypatch.setattr(twin, "gettempdir", lambda: str(tmp_path))

    def make(runs: list[Path], folder: Path, settings: TwinSettings, jobs: int) -> list[Path]:
        found.append((folder / "a").is_file())
        (folder / "a").touch()
        return [folder / "a"]

    def attempts(*errors: BaseException | None, settings: TwinSettings = SETTINGS) -> list[bool]:
        found.clear()
        for error in errors:
            try:
                with twin.twins_of([tmp_path / "run"], settings):
                    if error is not None:
                        raise error
            except (GpvoError, KeyboardInterrupt):
                pass
        return list(found)

    found: list[bool] = []
    monkeypatch.setattr(twin, "make_all", make)
    return attempts


def test_an_interrupted_command_goes_on_with_its_twins(places: Callable[..., list[bool]], tmp_path: Path) -> None:
    assert places(KeyboardInterrupt(), KeyboardInterrupt(), None, None) == [False, True, True, False]
    assert places(GpvoError("a run without tracks"), None) == [False, False]
    assert not list(tmp_path.iterdir())
    places(KeyboardInterrupt())
    assert places(None, settings=TwinSettings(replicates=3)) == [False]


def test_two_commands_and_other_users_have_twins_of_their_own(
    places: Callable[..., list[bool]], tmp_path: Path
) -> None:
    with twin.twins_of([tmp_path / "run"], SETTINGS) as made:
        assert places(None) == [False]
        assert made[0].is_file()
    places(KeyboardInterrupt())
    [folder] = tmp_path.iterdir()
    elsewhere = folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(elsewhere)
    assert places(None) == [False]
    assert (elsewhere / "a").is_file()

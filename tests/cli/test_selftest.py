"""``gpvo selftest`` on this machine, and on one without the training stack."""

from __future__ import annotations

import pytest
from gpvo import cli
from gpvo.errors import GpvoError


@pytest.mark.slow
def test_every_part_passes(capsys) -> None:
    cli.app(["selftest"], standalone_mode=False)
    out = capsys.readouterr().out
    assert out.count("[PASS]") == 7, out


def test_a_broken_part_is_named_and_those_behind_it_are_skipped(monkeypatch, capsys) -> None:
    def broken(bench: object) -> str:
        raise ValueError("no such thing")

    def absent(bench: object) -> str:
        raise ModuleNotFoundError("no torch", name="torch")

    monkeypatch.setattr("gpvo.cli.selftest._simulate", lambda bench: "flown")
    monkeypatch.setattr("gpvo.cli.selftest._odometry", broken)
    with pytest.raises(GpvoError, match="odometry failed"):
        cli.app(["selftest"], standalone_mode=False)
    out = capsys.readouterr().out
    assert "[PASS] simulate" in out
    assert "[FAIL] odometry: ValueError: no such thing" in out
    assert "[SKIP] filter: needs odometry" in out
    monkeypatch.setattr("gpvo.cli.selftest._odometry", absent)
    cli.app(["selftest"], standalone_mode=False)
    assert "[SKIP] odometry: package 'torch' is not installed (pip install 'gpvo[train]')" in capsys.readouterr().out

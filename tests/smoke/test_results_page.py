"""Every section of docs/results.rst names its command, its date, its commit, and a test that runs a small version."""

from __future__ import annotations

import ast
import importlib.util
import re
from datetime import datetime
from pathlib import Path

import pytest
from gpvo import cli
from typer.testing import CliRunner

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "results.rst").read_text()


def sections() -> dict[str, str]:
    """Text by title, without the page's own."""
    parts = re.split(r"^(.+)\n-{4,}\n", PAGE, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


MEASURED = {title: text for title, text in sections().items() if ":doc:" not in text.split("\n")[1]}


def field(text: str, name: str) -> str:
    (found,) = re.findall(rf"^:{name}: (.+)$", text, flags=re.MULTILINE)
    return found.strip("`")


def test_no_measured_section_is_left_out() -> None:
    assert len(MEASURED) >= 8
    for title, text in sections().items():
        assert title in MEASURED or "list-table" not in text


@pytest.mark.parametrize("title", MEASURED)
def test_it_says_when_it_was_made(title: str) -> None:
    date, commit = field(MEASURED[title], "Made").split(", commit ")
    datetime.strptime(date, "%d %B %Y")
    assert re.fullmatch(r"[0-9a-f]{7,40}", commit)


@pytest.mark.parametrize("title", MEASURED)
def test_its_command_is_there(title: str) -> None:
    words = field(MEASURED[title], "Command").split()
    if words[0] == "gpvo":
        told = CliRunner().invoke(cli.app, [words[1], "--help"]).output
        assert all(option in told for option in words if option.startswith("--"))
    elif "pytest" in words[:2]:
        assert (ROOT / words[-1]).is_file()
    else:
        assert words[:2] == ["python", "-m"]
        assert importlib.util.find_spec(words[2]) is not None


@pytest.mark.parametrize("title", MEASURED)
def test_its_small_version_is_a_test(title: str) -> None:
    path, name = field(MEASURED[title], "Small version").split("::")
    tree = ast.parse((ROOT / path).read_text())
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_the_paper_states_the_same_figures() -> None:
    paper = (ROOT / "docs" / "paper.md").read_text()
    (measured,) = re.findall(r"^# What was measured\n(.+?)^# ", paper, flags=re.MULTILINE | re.DOTALL)
    stated = re.findall(r"-?\d+\.\d+", measured)
    assert len(stated) >= 5
    assert set(stated) <= set(re.findall(r"-?\d+\.\d+", PAGE))

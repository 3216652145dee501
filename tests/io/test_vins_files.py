"""Files without a header: the result files of VINS-Mono and VINS-Fusion are known, all others get a cure."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from gpvo import cli
from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.io.foreign import guess_format, read_foreign
from gpvo.io.run import read_run
from gpvo.io.stated import to_records
from gpvo.io.trajectory import read_tum, write_tum
from typer.testing import CliRunner

N = 25
T_NS = np.array([1_403_636_579_763_555_584 + k * 50_000_000 for k in range(N)])
POSES = se3.exp(np.outer(np.arange(N), [0.02, 0.01, 0.1, 0.01, 0.02, -0.01]))


def _rows(unit_ns: int = 1, *, w_first: bool = True, velocity: bool = False) -> list[list[str]]:
    out = []
    for t, T in zip(T_NS, POSES, strict=True):
        q = np.roll(se3.rotation_to_quaternion_xyzw(T[:3, :3]), 1 if w_first else 0)
        more = [2.0, 3.0, 4.0] if velocity else []
        out.append([str(int(t) // unit_ns), *(f"{v:.9f}" for v in (*T[:3, 3], *q, *more))])
    return out


def _write(path: Path, rows: list[list[str]], end: str = "", separator: str = ",") -> Path:
    path.write_text("".join(separator.join(row) + end + "\n" for row in rows))
    return path


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("end", ["", ",", ", "])
def test_result_files_of_vins(velocity: bool, end: str, tmp_path: Path) -> None:
    path = _write(tmp_path / "vio.csv", _rows(velocity=velocity), end)
    assert guess_format(path) == "csv"
    log = read_foreign(path)
    np.testing.assert_array_equal(log.t_ns, T_NS)
    np.testing.assert_allclose(log.trajectory.T_world_body, POSES, atol=1e-7)
    assert log.covariance is None
    [note] = to_records(log)[1]
    assert "w first" in note
    assert "no header" in note
    assert read_foreign(path, complete=True).notes == log.notes


def test_a_header_on_top_goes_before_the_layout_of_vins(tmp_path: Path) -> None:
    rows = [["t_ns", "p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w"], *_rows(w_first=False)]
    log = read_foreign(_write(tmp_path / "a.csv", rows))
    np.testing.assert_allclose(log.trajectory.T_world_body, POSES, atol=1e-7)
    assert log.notes == ()


def test_the_layout_assumed_of_a_truth_is_said_too(tmp_path: Path) -> None:
    write_tum(tmp_path / "log.tum", T_NS, POSES)
    truth = _write(tmp_path / "vio.csv", _rows(velocity=True), ",")
    words = ["import", tmp_path / "log.tum", "--truth", truth, "-o", tmp_path / "run"]
    result = CliRunner().invoke(cli.app, [str(w) for w in words], catch_exceptions=False)
    assert result.exit_code == 0
    assert "vio.csv: it has no header" in result.stdout
    run = read_run(tmp_path / "run")
    assert run.truth is not None
    np.testing.assert_allclose(run.truth.T_world_cam, POSES, atol=1e-7)


@pytest.mark.parametrize(
    ("rows", "unit", "separator"),
    [
        (_rows(10**3), "us", ","),  # an epoch of microseconds has 16 digits, and is none of nanoseconds
        (_rows(10**6), "ms", ","),
        ([[f"{k * 0.1:.1f}", *row[1:]] for k, row in enumerate(_rows())], "s", ","),
        ([[*row, "1"] for row in _rows()], "ns", ","),  # nine columns
        ([row[:7] for row in _rows()], "ns", ","),
        (_rows(), "ns", ";"),
        ([[*row[:7], "x"] for row in _rows()], "ns", ","),
    ],
)
def test_other_files_without_a_header_are_refused_with_the_header(
    rows: list[list[str]], unit: str, separator: str, tmp_path: Path
) -> None:
    path = _write(tmp_path / "a.csv", rows, separator=separator)
    with pytest.raises(SourceError, match="has no header line") as caught:
        read_foreign(path)
    quoted = re.search(r"'(t_.*?)'", str(caught.value))
    assert quoted is not None
    header = quoted[1]
    more = [f"column_{k}" for k in range(9, len(rows[0]) + 1)]
    assert header == separator.join([f"t_{unit}", "p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w", *more])


def test_the_header_of_the_cure_cures(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.csv", [[*row, "7.5"] for row in _rows(10**3, w_first=False)])
    with pytest.raises(SourceError) as caught:
        read_foreign(path)
    header = re.search(r"'(t_.*?)'", str(caught.value))
    assert header is not None
    path.write_text(f"{header[1]}\n{path.read_text()}")
    log = read_foreign(path)
    np.testing.assert_array_equal(log.t_ns, T_NS // 1000 * 1000)
    np.testing.assert_allclose(log.trajectory.T_world_body, POSES, atol=1e-7)


@pytest.mark.parametrize(("unit", "unit_ns"), [("ns", 1), ("us", 10**3), ("ms", 10**6)])
def test_a_tum_file_in_another_unit_gets_a_cure_that_cures(unit: str, unit_ns: int, tmp_path: Path) -> None:
    path = _write(tmp_path / "a.tum", _rows(unit_ns, w_first=False), separator=" ")
    with pytest.raises(SourceError, match="line 1: .* is not a stamp in seconds") as caught:
        read_tum(path)
    assert f"divide them by {10**9 // unit_ns:,}" in str(caught.value)
    header = re.search(r"'(t_.*?)'", str(caught.value))
    assert header is not None
    path.write_text(f"{header[1]}\n{path.read_text()}")
    log = read_foreign(path)
    np.testing.assert_array_equal(log.t_ns, T_NS // unit_ns * unit_ns)
    np.testing.assert_allclose(log.trajectory.T_world_body, POSES, atol=1e-7)


def test_what_is_no_stamp_in_any_unit_gets_no_cure_of_units(tmp_path: Path) -> None:
    for text in ("abc", "nan", "inf"):
        (tmp_path / "a.tum").write_text(f"{text} 0 0 0 0 0 0 1\n")
        with pytest.raises(SourceError) as caught:
            read_tum(tmp_path / "a.tum")
        assert caught.value.cure is None


def test_an_orientation_by_its_short_name(tmp_path: Path) -> None:
    rows = [["stamp", "pos_x", "pos_y", "pos_z", "ori_x", "ori_y", "ori_z", "ori_w"], *_rows(w_first=False)]
    log = read_foreign(_write(tmp_path / "a.csv", rows))
    np.testing.assert_allclose(log.trajectory.T_world_body, POSES, atol=1e-7)

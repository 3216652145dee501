"""The scoreboard: files alone give what ``gpvo evaluate`` gives, and anybody's file is scored in one command."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from docs.baselines import baselines, rtabmap_covariance
from evaluation_runs import CAMERA, make_run, stated_covariance
from gpvo import cli
from gpvo.dataset.build import build_run
from gpvo.dataset.errors import motion_errors
from gpvo.errors import GpvoError, SourceError
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.score import board, on_other_axes, score, score_folder, score_sequence, write_statements
from gpvo.geometry import se3
from gpvo.io.run import write_run
from gpvo.io.run_read import Run, read_run
from gpvo.io.stated import HEADER, read_stated, write_stated
from gpvo.io.trajectory import read_tum, tum_line, write_tum
from gpvo.types import Mounting, Status, StereoTracks, StoredRecords, VoLog, VoRecord
from synthetic_runs import make_run as synthetic_run

ROOT = Path(__file__).parents[2]
N = 300


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[Path, object]:
    """The statements of a run of which two frames are lost, as files."""
    log, truth = make_run(N, lost={40, 41})
    evaluation = evaluate_run(Run(Path("hall"), "hall", log, truth, None, Mounting(), []))
    folder = tmp_path_factory.mktemp("stated")
    write_statements(evaluation, folder, "hall")
    return folder, evaluation


def test_files_alone_give_the_scores_of_evaluate(written) -> None:
    folder, evaluation = written
    found = score_sequence(folder / "triangulation" / "hall.txt", folder / "truth" / "hall.txt")
    of_run = evaluation.consistency["triangulation"]
    assert (found["motions"], found["lost"]) == (N - 2, 2)
    assert isinstance(read_stated(folder / "triangulation" / "hall.txt").records, StoredRecords)
    # Nine decimals of a file stand for motions of sigma 0.2 to 2e-3.
    assert found["nees_dof"] == pytest.approx(of_run.nees_dof["joint"].mean, rel=1e-4)
    assert found["nll_per_dim"] == pytest.approx(of_run.nll_per_dim, abs=1e-4)
    assert found["correlation_gain_nats"] == pytest.approx(of_run.correlation_gain_nats, abs=1e-4)
    assert found["nees_dof_by_difficulty"] == pytest.approx(of_run.by_difficulty["nees_dof"], rel=1e-3)
    assert found["coverage_by_difficulty"] == pytest.approx(of_run.by_difficulty["coverage"], abs=0.02)
    assert found["nees_dof_over"]["1m"] == pytest.approx(of_run.horizons[0].nees_dof, rel=1e-4)
    assert found["ate_rmse_m"] == pytest.approx(evaluation.trajectory.ate_rmse_m, rel=1e-4)


def test_a_lost_motion_is_charged_with_its_length(written) -> None:
    folder, evaluation = written
    found = score_sequence(folder / "triangulation" / "hall.txt", folder / "truth" / "hall.txt")
    T = evaluation.T_true
    lost = [se3.log(se3.inverse(T[39]) @ T[k]) for k in (40, 41)]
    of_run = evaluation.consistency["triangulation"].energy["translation_m"]
    expected = (of_run * (N - 2) + sum(float(np.linalg.norm(xi[:3])) for xi in lost)) / N
    assert found["energy_translation_m"] == pytest.approx(expected, rel=1e-4)


def test_honest_beats_timid_and_bold(tmp_path: Path) -> None:
    log, truth = make_run(N)
    write_tum(tmp_path / "truth.txt", truth.t_ns, truth.T_world_cam)
    energy, nll = {}, {}
    for factor in (0.05, 1.0, 20.0):
        C = np.full((len(log), 6, 6), np.nan)
        C[1:] = factor * stated_covariance()
        write_stated(tmp_path / "stated.txt", log, log.trajectory(), C)
        s = score_sequence(tmp_path / "stated.txt", tmp_path / "truth.txt")
        energy[factor], nll[factor] = s["energy_translation_m"], s["nll_per_dim"]
    assert min(energy, key=energy.__getitem__) == min(nll, key=nll.__getitem__) == 1.0


def test_somebody_elses_file_of_29_columns(tmp_path: Path, capsys) -> None:
    rng = np.random.default_rng(1)
    T = se3.exp(np.cumsum(rng.normal(0, 0.01, (60, 6)), axis=0))
    t_ns = 50_000_000 * np.arange(1, 61)
    upper = " ".join(f"{1e-6 * (i == j)}" for i in range(6) for j in range(i, 6))
    for name in ("a", "b"):
        lines = [f"{tum_line(int(t), X)} {upper}" for t, X in zip(t_ns, T)]
        (tmp_path / f"{name}.txt").write_text("\n".join([HEADER, *lines]) + "\n")
    write_tum(tmp_path / "gt.txt", t_ns, T)
    words = [str(tmp_path / "a.txt"), str(tmp_path / "b.txt"), *(2 * ["--truth", str(tmp_path / "gt.txt")])]
    cli.app(["score", *words, "--json"], standalone_mode=False)
    found = json.loads(capsys.readouterr().out)
    assert found["pooled"]["motions"] == 2 * 59
    assert found["pooled"]["nees_dof"]["mean"] < 1e-3
    cli.app(["score", *words], standalone_mode=False)
    assert "With fewer than three sequences there is no mean" in capsys.readouterr().out


@pytest.mark.parametrize(
    "line,says",
    [
        ("0.2 0 0 0 0 0 0 1 " + " ".join(["0"] * 21), "not positive definite"),
        ("0.2 0 0 0 0 0 0 1 " + " ".join(["x"] * 21), "holds no numbers"),
        ("0.2 0 0 0 0 0 0 1 1 2 3", "expected 29"),
        ("0.2 0 0 0 0 0 0 1 " + " ".join(["1"] + ["nan"] * 20), "not positive definite"),
    ],
)
def test_a_malformed_file_is_refused_by_name(tmp_path: Path, line: str, says: str) -> None:
    first = "0.1 0 0 0 0 0 0 1 " + " ".join(["nan"] * 21)
    path = tmp_path / "stated.txt"
    path.write_text("\n".join([HEADER, first, line]) + "\n")
    with pytest.raises(SourceError, match=says) as refused:
        read_stated(path)
    assert "stated.txt" in str(refused.value)


def test_a_file_without_the_header_is_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match="gpvo-stated"):
        score([(tmp_path / "poses.txt", tmp_path / "poses.txt")])


def _call(capsys, *words: object) -> str:
    cli.app(["score", *map(str, words)], standalone_mode=False)
    return capsys.readouterr().out


def test_a_folder_of_methods_is_scored_in_one_command(written, tmp_path: Path, capsys) -> None:
    folder, evaluation = written
    out = tmp_path / "board"
    told = _call(capsys, folder, "-o", out)
    assert told.splitlines()[1].startswith("triangulation")
    results = json.loads((out / "triangulation.json").read_text())
    assert results["pooled"]["nll_per_dim"]["mean"] == pytest.approx(
        evaluation.consistency["triangulation"].nll_per_dim, abs=1e-4
    )
    assert (out / "board.csv").read_text().splitlines()[0].startswith("method,energy [mm]")


def test_a_method_that_moves_in_a_plane_is_not_compared_with_others(tmp_path: Path, capsys) -> None:
    """The camera's x, z and turn about y err in both; only one of the methods lets it rise and roll."""
    rng = np.random.default_rng(0)
    t_ns, xi = np.arange(201) * 10**8, np.zeros((201, 6))
    xi[1:, 2], xi[1:, 4] = 0.1, 0.01 * np.sin(np.arange(200) / 9)
    truth = np.array([T := np.eye(4), *(T := T @ se3.exp(x) for x in xi[1:])])
    (tmp_path / "truth").mkdir()
    write_tum(tmp_path / "truth" / "a.txt", t_ns, truth)
    for method, free in (("flat", [0, 2, 4]), ("free", range(6))):
        error = np.zeros((201, 6))
        error[1:, free] = 0.01 * rng.standard_normal((200, len(free)))
        motions = [np.eye(4), *(se3.exp(x) @ se3.exp(e) for x, e in zip(xi[1:], error[1:], strict=True))]
        log = VoLog([VoRecord(t, t - 10**8 * (k > 0), Status.OK if k else Status.START, motions[k], {})
                     for k, t in enumerate(t_ns.tolist())])  # fmt: skip
        (tmp_path / method).mkdir()
        write_stated(tmp_path / method / "a.txt", log, log.trajectory(), np.tile(1e-4 * np.eye(6), (201, 1, 1)))
    told = _call(capsys, tmp_path)
    assert "flat: NLL and NEES are of x, z, ry alone: not comparable with those of others." in told
    assert "free: NLL" not in told


def test_axes_are_compared_sequence_by_sequence() -> None:
    def of(*axes: str) -> dict[str, list[dict[str, object]]]:
        return {"sequences": [{"sequence": str(k), "axes": tuple(a)} for k, a in enumerate(axes)]}

    assert on_other_axes({"a": of("xyz", "xy"), "b": of("xyz", "xy")}) == {}
    assert on_other_axes({"a": of("xyz", "xy"), "b": of("xy", "xy")}) == {"b": ("x", "y")}
    assert on_other_axes({"a": of("xy", "xyz"), "b": of("xyz", "z")}) == {"a": ("x", "y"), "b": ("z",)}


def test_a_method_that_breaks_off_is_not_compared_with_others(written, tmp_path: Path, capsys) -> None:
    """It is charged for lost motions, but not for those that its file says nothing of: the easy ones alone are left."""
    shutil.copytree(written[0], tmp_path / "board")
    file = tmp_path / "board" / "triangulation" / "hall.txt"
    shutil.copytree(file.parent, tmp_path / "board" / "whole")
    (tmp_path / "board" / ".checkpoints").mkdir()
    assert "not comparable" not in _call(capsys, tmp_path / "board")
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[: len(lines) // 2]))
    said = f"triangulation: states {len(lines) // 2 - 5} motions of hall, others {N}: not comparable"
    assert said in _call(capsys, tmp_path / "board")


def test_scores_are_not_written_where_the_next_call_takes_them_for_a_method(written, capsys) -> None:
    with pytest.raises(GpvoError, match="results: lies where a method would"):
        _call(capsys, written[0], "-o", written[0] / "results")


def test_a_folder_without_methods_is_refused(written, tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "a.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 1 0 0 0 1\n")
    with pytest.raises(SourceError, match="holds no method beside truth"):
        score_folder(tmp_path)


def test_somebody_elses_csv_is_scored_in_one_command(written, tmp_path: Path, capsys) -> None:
    folder, evaluation = written
    T, log = evaluation.T_est, evaluation.run.log
    q = se3.rotation_to_quaternion_xyzw(T[:, :3, :3])
    names = [f"cov_{i}{j}" for i in range(6) for j in range(6)]
    lines = ["t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(names)]
    for k, r in enumerate(log):
        numbers = [*T[k, :3, 3], *q[k], *stated_covariance().ravel()]
        if r.status.value != "lost":
            lines.append(",".join([str(r.t_ns), *(f"{x:.12g}" for x in numbers)]))
    path = tmp_path / "theirs.csv"
    path.write_text("\n".join(lines) + "\n")
    found = json.loads(_call(capsys, path, "--truth", folder / "truth" / "hall.txt", "--json"))
    assert 0.9 < found["sequences"][0]["nees_dof"] < 1.1
    # What it does not state is lost, and charged; what cannot be a covariance is refused.
    sparse, zero = tmp_path / "sparse.csv", tmp_path / "zero.csv"
    poses = [line.split(",")[:8] for line in lines]
    rows = [",".join([*p, *["nan"] * 36]) if k % 3 == 2 else line for k, (p, line) in enumerate(zip(poses, lines))]
    sparse.write_text("\n".join(rows))
    zero.write_text("\n".join([*lines[:5], ",".join([*poses[5], *["0"] * 36]), *lines[6:]]))
    (less,) = json.loads(_call(capsys, sparse, "--truth", folder / "truth" / "hall.txt", "--json"))["sequences"]
    (all_,) = found["sequences"]
    assert less["lost"] > len(lines) // 3 - 2
    assert less["motions"] + less["lost"] == all_["motions"] + all_["lost"]
    assert less["energy_translation_m"] > 2 * all_["energy_translation_m"]
    with pytest.raises(SourceError, match=r"zero.csv: the covariance at .* s is not positive definite"):
        score_sequence(zero, folder / "truth" / "hall.txt")
    # Beside ours, in the same folder.
    board = tmp_path / "all"
    shutil.copytree(folder, board)
    (board / "theirs").mkdir()
    shutil.copy(path, board / "theirs" / "hall.csv")
    assert "\ntheirs " in _call(capsys, board)


def test_a_method_that_leaves_a_sequence_out_is_refused(written, tmp_path: Path) -> None:
    folder, _ = written
    shutil.copytree(folder, tmp_path / "all")
    shutil.copy(tmp_path / "all" / "truth" / "hall.txt", tmp_path / "all" / "truth" / "other.txt")
    with pytest.raises(SourceError, match="states nothing for the sequence other"):
        score_folder(tmp_path / "all")
    with pytest.raises(SourceError, match="holds no truth"):
        score_folder(tmp_path / "all" / "triangulation")


@pytest.mark.parametrize(("count", "parts"), [(2, 24), (3, 2)])
def test_the_table_of_a_training_is_scored_again_from_files_alone(
    tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch, count: int, parts: int
) -> None:
    """Each run left out, in turn or in parts: what was stated of it goes into files, which hold all that the table
    shows."""
    monkeypatch.setattr("gpvo.learning.train.MOST_FOLDS", parts)
    runs = [tmp_path / f"run{k}" for k in range(count)]
    for seed, path in enumerate(runs):
        log, truth = synthetic_run(seed, n=80)
        write_run(path, log, truth=truth)
    command = ["train", *map(str, runs), "--features", "n_inliers", "-o", str(tmp_path / "m.gpvo"), "--json"]
    stated = tmp_path / "stated"
    cli.app([*command, "--statements", str(stated)], standalone_mode=False)
    folds = json.loads(capsys.readouterr().out)["folds"]
    for method in ("constant", "pointing_matching_scaled", "gp_thesis", "base", "learned"):
        for fold in folds:
            sequence, of_table = f"{fold['held_out']}.txt", fold["methods"][method]
            found = score_sequence(stated / method / sequence, stated / "truth" / sequence)
            assert found["motions"] == fold["rows"], method
            assert found["nees_dof"] == pytest.approx(of_table["nees_dof"]["joint"], rel=1e-3), method
            assert found["nll_per_dim"] == pytest.approx(of_table["nll_per_dim"], abs=1e-3), method


def test_statements_of_a_run_that_nothing_was_left_out_for_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with pytest.raises(GpvoError, match="two or more run folders"):
        cli.app(
            ["train", str(tmp_path / "run"), "-o", str(tmp_path / "m.gpvo"), "--statements", str(tmp_path / "stated")],
            standalone_mode=False,
        )


SHOWN = ROOT / "docs" / "scoreboard"


def test_the_table_of_the_documentation_is_made_of_its_scores() -> None:
    """Every baseline has a line, and the line holds what its JSON says."""
    shown = {path.stem: json.loads(path.read_text()) for path in SHOWN.glob("*.json")}
    lines = {row["method"]: row for row in csv.DictReader((SHOWN / "board.csv").open())}
    assert set(shown) == set(lines) == {path.name for path in (SHOWN / "stated").iterdir()} - {"truth"}
    assert set(lines) >= {
        "constant", "constant_hindsight", "rtabmap", "scatter", "nearest", "triangulation", "pointing_matching",
        "gp_thesis", "learned", "twin",
    }  # fmt: skip
    again = board(shown)
    for k, method in enumerate(again["method"]):
        for name in ("energy [mm]", "NLL", "NEES", "NEES 1s", "easy", "hard"):
            assert float(lines[method][name]) == again[name][k]


@pytest.mark.parametrize("method", ["learned", "rtabmap"])
def test_files_alone_give_the_scores_of_the_documentation(method: str) -> None:
    truths = sorted((SHOWN / "stated" / "truth").glob("*.txt"))
    found = score([(SHOWN / "stated" / method / truth.name, truth) for truth in truths])
    shown = json.loads((SHOWN / f"{method}.json").read_text())
    for name, of_all in found["pooled"].items():
        if isinstance(of_all, dict):
            assert of_all["mean"] == pytest.approx(shown["pooled"][name]["mean"], rel=1e-6), name


def test_the_rule_of_rtabmap_is_the_scatter_of_the_points() -> None:
    """Points that the motion carries 3 cm off have 2.1981 times its square, however many they are."""
    rng = np.random.default_rng(0)
    P = rng.uniform([-2, -1, 4], [2, 1, 8], (80, 3))
    T = se3.exp(np.array([0.1, 0.0, 0.3, 0.0, 0.02, 0.0]))
    carried = se3.transform(se3.inverse(T), P)
    off = 0.03 * np.array([1.0, 0.0, 0.0])
    records = [VoRecord(0, 0, Status.START, np.eye(4)), VoRecord(100, 0, Status.OK, T, n_inliers=40)]
    for n in (40, 80):
        uvd = [_measured(P[:n]), _measured(carried[:n] + off)]
        tracks = StereoTracks(
            np.repeat([0, 100], n), np.tile(np.arange(n), 2), np.concatenate(uvd), np.ones(2 * n, bool)
        )
        C = rtabmap_covariance(VoLog(records, CAMERA), tracks)
        assert np.isnan(C[0]).all()
        np.testing.assert_allclose(np.diag(C[1])[:3], 2.1981 * 0.03**2 + 1e-6, rtol=1e-6)
        assert 1e-6 < C[1, 3, 3] < 2.1981 * (0.03 / 3) ** 2


def _measured(P: np.ndarray) -> np.ndarray:
    """(N, 3) left column, row and disparity of points in the camera."""
    f, b = CAMERA.fx_px, CAMERA.baseline_m
    return np.stack(
        [CAMERA.cx_px + f * P[:, 0] / P[:, 2], CAMERA.cy_px + f * P[:, 1] / P[:, 2], f * b / P[:, 2]], axis=1
    )


@pytest.mark.slow
def test_the_scoreboard_of_the_documentation_comes_from_its_files(tmp_path: Path) -> None:
    """What needs no model, from the flights again: files are stated, scored alone, and give the numbers shown."""
    runs = {name: read_run(ROOT / "data" / name) for name in ("tunnel-1", "tunnel-2", "tunnel-3", "tunnel-4", "unseen")}
    for name, run in runs.items():
        training = [build_run(other) for n, other in runs.items() if n != name]
        further = baselines(run.log, motion_errors(run.log, run.truth), training)
        write_statements(evaluate_run(run, further=further), tmp_path, name)
    for method, scores in score_folder(tmp_path).items():
        shown = json.loads((ROOT / "docs" / "scoreboard" / f"{method}.json").read_text())
        for name in ("nll_per_dim", "nees_dof", "energy_translation_m"):
            assert scores["pooled"][name]["mean"] == pytest.approx(shown["pooled"][name]["mean"], rel=1e-3), method


def test_that_the_truth_is_taken_as_exact_is_said(written, capsys) -> None:
    folder = written[0]
    of_one = [str(folder / "triangulation" / "hall.txt"), "--truth", str(folder / "truth" / "hall.txt")]
    for words in ([str(folder)], of_one):
        for given, said in (([], True), (["--truth-sigma", "0"], False)):
            cli.app(["score", *words, *given], standalone_mode=False)
            assert ("The truth is taken as exact" in capsys.readouterr().out) == said


def test_a_truth_of_another_clock_is_refused_without_an_option_that_is_not_there(written, tmp_path: Path) -> None:
    stated, truth = (written[0] / of / "hall.txt" for of in ("triangulation", "truth"))
    poses = read_tum(truth)
    write_tum(tmp_path / "later.txt", poses.t_ns + 10**13, poses.T_world_body)
    with pytest.raises(SourceError, match=r"later\.txt: the ground truth .* does not overlap") as refused:
        score_sequence(stated, tmp_path / "later.txt")
    assert "--time-offset" not in str(refused.value)

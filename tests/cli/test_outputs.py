"""One rule for every output: missing folders are made; an earlier output of the kind is replaced, nothing else is."""

from __future__ import annotations

from pathlib import Path

import pytest
from gpvo import cli
from gpvo.errors import OutputError
from gpvo.files import refuse_foreign, replacing, write_text
from gpvo.io.run import write_run
from gpvo.io.trajectory import write_tum
from gpvo.learning.store import card_path, picture_path, rows_path
from synthetic_runs import make_run

ROOT = Path(__file__).parents[2]
RUN, MODEL = str(ROOT / "data" / "tunnel-1"), str(ROOT / "models" / "tunnel.gpvo")

OUTPUTS = {
    "predictions.parquet": ["predict", MODEL, "{run}", "-o", "{file}"],
    "camchain.yaml": ["calibration", RUN, "-o", "{file}"],
    "flight.tlog": ["publish", "{run}", "-o", "{file}"],
    "flight_robot_localization.yaml": ["publish", "{run}", "-o", "{folder}/flight.bag"],
    "tracks.npz": ["simulate", "tunnel-bursts", "--points", "--duration", "4", "--rate", "5", "-o", "{file}"],
    "plan.jpg": ["forecast", MODEL, "--path", "{plan}", "--draws", "1", "--plot", "{file}"],
    "run_est.tum": ["evaluate", "{run}", "--tables", "{folder}"],
    "run_motions.csv": ["evaluate", "{run}", "--tables", "{folder}"],
    "run_methods.tex": ["evaluate", "{run}", "--tables", "{folder}"],
    "truth/run.txt": ["evaluate", "{run}", "--stated", "{folder}"],
    "pointing_matching/run.txt": ["evaluate", "{run}", "--stated", "{folder}"],
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A run, and a plan to fly."""
    folder = tmp_path_factory.mktemp("made")
    log, truth = make_run(60)
    write_run(folder / "run", log, truth=truth, meta={"source": "made"})
    write_tum(folder / "plan.tum", log.t_ns, log.trajectory())
    return {"run": str(folder / "run"), "plan": str(folder / "plan.tum")}


def main(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: object) -> tuple[int, list[str]]:
    """The exit code, and the lines of standard error but for those of other people's libraries."""
    monkeypatch.setattr("sys.argv", ["gpvo", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0), [x for x in capsys.readouterr().err.splitlines() if x.startswith("gpvo: ")]


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_output_replaces_its_own_kind_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, made: dict[str, str], name: str
) -> None:
    for package in {"flight.tlog": ["pymavlink"], "flight_robot_localization.yaml": ["rosbags"]}.get(name, []):
        pytest.importorskip(package)
    folder = tmp_path / "not" / "made" / "yet"
    file = folder / name
    words = [word.format(file=file, folder=folder, **made) for word in OUTPUTS[name]]
    for time in ("first", "second"):
        assert main(capsys, monkeypatch, *words)[0] == 0, time
    assert file.stat().st_size > 0
    file.write_bytes(b"my own notes\n")
    code, said = main(capsys, monkeypatch, *words)
    assert (code, file.read_bytes()) == (2, b"my own notes\n")
    assert f"{file}: is another file, not an earlier" in said[-1]
    assert "choose another name" in said[-1]
    file.unlink()
    file.symlink_to("/dev/null")
    assert main(capsys, monkeypatch, *words)[0] == 2
    assert file.is_symlink()
    file.unlink()
    (file / "inside").mkdir(parents=True)
    code, said = main(capsys, monkeypatch, *words)
    assert (code, (file / "inside").is_dir()) == (2, True)
    assert f"{file}: is a folder (name a file)" in said[-1]
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("beside", [card_path, picture_path, rows_path])
def test_training_replaces_nothing_beside_its_model_that_is_not_its_own(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, beside
) -> None:
    """``gpvo train -o notes`` had replaced ``notes.md``. The models that come with gpvo are its own."""
    theirs = beside(tmp_path / "notes")
    theirs.write_text("what I learned\n")
    code, said = main(capsys, monkeypatch, "train", RUN, "-o", tmp_path / "notes")
    assert (code, theirs.read_text()) == (2, "what I learned\n")
    assert f"{theirs}: is another file, not an earlier" in said[-1]
    if beside is not rows_path:  # which none comes with
        theirs.write_bytes(beside(Path(MODEL)).read_bytes())
        code, said = main(capsys, monkeypatch, "train", tmp_path / "no run", "-o", tmp_path / "notes")
        assert "no such run folder" in said[-1]


def test_what_a_killed_process_left_is_taken_over_and_no_two_writers_share_it(tmp_path: Path) -> None:
    path, left = tmp_path / "notes", tmp_path / ".notes.part"
    left.write_text("half of what was to be written")
    with replacing(path) as one:
        assert (one, one.read_bytes()) == (left, b"")
        one.write_text("one")
        with replacing(path) as other:
            assert other != one
            other.write_text("other")
        assert path.read_text() == "other"
    assert path.read_text() == "one"
    left.symlink_to(path)
    with replacing(path) as one:
        assert path.read_text() == "one"
    assert [p.name for p in tmp_path.iterdir() if p != left] == ["notes"]


def test_what_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"file is no folder \(name a file in a writable folder\)"):
        refuse_foreign(tmp_path / "file" / "below" / "report.html", b"gpvo", "report")
    assert not (tmp_path / "file").is_dir()


def test_an_empty_file_is_nobodys(tmp_path: Path) -> None:
    """As ``mktemp`` makes one; and one that cannot be told from another kind is refused with its bytes."""
    (tmp_path / "empty").write_text("\n")
    write_text(tmp_path / "empty", "gpvo: mine", own=(b"^gpvo", "text"))
    write_text(tmp_path / "empty", "gpvo: again", own=(b"^gpvo", "text"))
    with pytest.raises(OutputError, match="not an earlier page"):
        write_text(tmp_path / "empty", "<html>", own=(b"<html>", "page"))
    assert (tmp_path / "empty").read_text() == "gpvo: again"


def test_a_current_folder_that_is_gone_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, made: dict[str, str]
) -> None:
    """As of a shell whose folder another one has removed."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    code, said = main(capsys, monkeypatch, "import", made["plan"], "-o", "run")
    assert (code, said) == (2, ["gpvo: the current folder: No such file or directory"])
    assert main(capsys, monkeypatch, "import", made["plan"], "-o", tmp_path / "run") == (0, [])


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "nowhere", "--tables"],
        ["evaluate", "nowhere", "--plots"],
        ["evaluate", "nowhere", "--stated"],
        ["fuse", "nowhere", "--log"],
        ["train", "nowhere", "nowhere-else", "-o", "{free}", "--statements"],
        ["score", str(ROOT / "docs" / "scoreboard"), "-o"],
    ],
)
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: list[str]
) -> None:
    """Which may take minutes, and was lost: here the inputs, looked at first of all work, are not there either."""
    (tmp_path / "file").write_text("of somebody")
    asked = [word.format(free=tmp_path / "m.gpvo") for word in words]
    code, [told] = main(capsys, monkeypatch, *asked, tmp_path / "file" / "deep" / "er")
    assert code == 2
    assert f"{tmp_path / 'file'} is no folder" in told


def test_score_says_that_files_have_no_board(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """``-o`` was ignored beside files."""
    stated = ROOT / "docs" / "scoreboard" / "stated"
    words = ["score", stated / "learned" / "unseen.txt", "--truth", stated / "truth" / "unseen.txt"]
    code, [told] = main(capsys, monkeypatch, *words, "-o", tmp_path / "results")
    assert code == 2
    assert "-o has no effect on files" in told

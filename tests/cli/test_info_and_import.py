"""``gpvo info`` and ``gpvo import`` as a user runs them, in one process."""

from __future__ import annotations

import errno
import json
import subprocess
import sys

import numpy as np
import pytest
import sequences as seq
from bag_maker import stereo_bag
from foreign_trajectories import write_euroc_csv, write_kitti_poses
from gpvo.cameras.models import PinholeRadtan
from gpvo.errors import SourceError
from gpvo.files import write_json
from gpvo.geometry import se3
from gpvo.io.run import read_run, write_run
from gpvo.io.trajectory import write_tum
from gpvo.types import Status, StereoCamera, Vehicle, VoLog, VoRecord
from gpvo.vo.rig_error import N_COEFFICIENTS, RigState
from gpvo.vo.rig_findings import document

from command_line import gpvo

N = 400
T_NS = np.array([1_403_636_579_763_555_584 + k * 50_000_000 for k in range(N)])


def _poses(n: int = N) -> np.ndarray:
    """A camera on a winding path, smooth and exciting enough for every alignment."""
    s = np.arange(n) * 0.05
    t = np.stack([2 * np.sin(0.7 * s), 0.5 * np.sin(1.3 * s), s + 0.5 * np.cos(0.9 * s)], axis=1)
    phi = np.stack([0.3 * np.sin(1.1 * s), 0.5 * np.sin(0.8 * s + 1), 0.2 * np.sin(1.7 * s)], axis=1)
    return se3.from_rt(se3.so3_exp(phi), t)


@pytest.mark.parametrize(
    ("make", "what", "fmt"),
    [
        (seq.write_euroc, "sequence", "euroc"),
        (seq.write_kitti, "sequence", "kitti"),
        (seq.write_folder, "sequence", "folder"),
    ],
)
def test_info_of_sequences(tmp_path, make, what, fmt):
    path = make(tmp_path / "s")
    code, out, _ = gpvo("info", path, "--json")
    document = json.loads(out)
    assert code == 0
    assert (document["schema"], document["what"], document["format"]) == (1, what, fmt)
    assert document["frames"] == 12
    assert document["camera"]["baseline_m"] == pytest.approx(0.1)
    code, out, _ = gpvo("info", path)
    assert code == 0
    assert "frames: 12" in out


def test_info_of_other_files(tmp_path):
    poses = _poses()
    write_tum(tmp_path / "a.txt", T_NS, poses)
    write_kitti_poses(tmp_path / "b.txt", poses)
    write_euroc_csv(tmp_path / "c.csv", T_NS, poses)
    (tmp_path / "camchain.yaml").write_text(seq.camchain_yaml())
    seq.write_kitti(tmp_path / "s", 1)
    records = [VoRecord(0, 0, Status.START, np.eye(4)), VoRecord(10, 0, Status.OK, np.eye(4))]
    write_run(tmp_path / "run", VoLog(records))
    for name, what in (
        ("a.txt", "trajectory"),
        ("b.txt", "trajectory"),
        ("c.csv", "trajectory"),
        ("camchain.yaml", "calibration"),
        ("s/calib.txt", "calibration"),
        ("run", "run"),
        ("run/vo_log.parquet", "table"),
    ):
        code, out, _ = gpvo("info", tmp_path / name, "--json")
        assert code == 0
        assert json.loads(out)["what"] == what
    table = json.loads(gpvo("info", tmp_path / "run" / "vo_log.parquet", "--json")[1])
    assert table["rows"] == 2
    assert table["columns"][:2] == ["t_ns", "t_prev_ns"]
    assert "baseline_m: P0 P1 0.1, P2 P3 0.1" in gpvo("info", tmp_path / "s" / "calib.txt")[1]


def test_info_of_a_bag(tmp_path):
    from bag_maker import BagMaker, stereo_bag

    code, out, _ = gpvo("info", stereo_bag(True).write(tmp_path / "a.bag"), "--json")
    assert code == 0
    assert json.loads(out)["sequence"]["frames"] == 12
    maker = BagMaker(False)
    maker.imu("/imu0", seq.START_NS)
    code, out, _ = gpvo("info", maker.write(tmp_path / "b"), "--json")
    document = json.loads(out)
    assert code == 0
    assert document["sequence"] is None
    assert "/imu0" in document["topics"]
    assert "notes" not in document  # of images that no one looks for
    assert "    /imu0: type sensor_msgs/msg/Imu, messages 1\n" in gpvo("info", tmp_path / "b")[1]


@pytest.mark.parametrize(
    "what", ["nothing", "empty", "rubbish.txt", "rubbish.bag", "rubbish.npz", "rubbish.yaml", "a.parquet"]
)
def test_info_of_what_is_not_known(tmp_path, what):
    path = tmp_path / what
    if what == "empty":
        path.mkdir()
    elif what != "nothing":
        path.write_bytes(b"\x00\x01rubbish\n" * 40)
    code, out, err = gpvo("info", path)
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1
    assert str(path) in err


def test_import_of_a_perfect_log(tmp_path):
    poses = _poses()
    write_tum(tmp_path / "est.txt", T_NS, poses)
    write_euroc_csv(tmp_path / "gt.csv", T_NS, poses)
    code, out, err = gpvo(
        "import", tmp_path / "est.txt", "--truth", tmp_path / "gt.csv", "-o", tmp_path / "run", "--json"
    )
    assert (code, err) == (0, "")
    assert json.loads(out)["with_truth"] == N
    run = read_run(tmp_path / "run")
    assert len(run.log) == N
    xi = se3.log(se3.inverse(run.log.trajectory()) @ se3.inverse(poses[0]) @ poses)
    assert np.abs(xi).max() < 1e-7
    assert run.truth is not None


def test_a_run_keeps_what_its_slips_are_told_by(tmp_path):
    write_tum(tmp_path / "log", T_NS, _poses())
    words = ("--vehicle", "car", "--max-turn", "7.5")
    assert gpvo("import", tmp_path / "log", "-o", tmp_path / "run", *words)[0] == 0
    assert read_run(tmp_path / "run").log.vehicle == Vehicle(12.0, 7.5)
    meta = json.loads((tmp_path / "run" / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps({**meta, "vehicle": {"max_turn_radps2": -1.0}}))
    with pytest.raises(SourceError, match="cannot move"):
        read_run(tmp_path / "run")


def test_the_columns_of_a_truth_are_named_like_those_of_a_log(tmp_path):
    write_tum(tmp_path / "est.txt", T_NS, _poses())
    write_euroc_csv(tmp_path / "gt.csv", T_NS, _poses())
    lines = (tmp_path / "gt.csv").read_text().splitlines()
    names = ["when", "east", "north", "up", "a", "b", "c", "d"]
    (tmp_path / "gt.csv").write_text("\n".join([",".join(names), *(",".join(x.split(",")[:8]) for x in lines[1:])]))
    command = ("import", tmp_path / "est.txt", "--truth", tmp_path / "gt.csv", "-o", tmp_path / "run")
    code, _, err = gpvo(*command)
    assert code == 2
    assert "--truth-map" in err
    # EuRoC's quaternion begins with its real part.
    targets = ("t_ns", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z")
    given = [word for pair in zip(names, targets) for word in ("--truth-map", "=".join(pair))]
    code, out, err = gpvo(*command, *given, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["with_truth"] == N


def test_import_finds_rotation_and_time_offset(tmp_path):
    """The truth is of a body turned against the camera, and the log's clock runs 120 ms late."""
    poses = _poses()
    R = se3.so3_exp(np.array([0.9, -1.2, 0.7]))
    write_tum(tmp_path / "est.txt", T_NS + 120_000_000, poses)
    write_tum(tmp_path / "gt.txt", T_NS, poses @ se3.from_rt(R, np.zeros(3)))
    code, out, err = gpvo(
        "import", tmp_path / "est.txt", "--truth", tmp_path / "gt.txt", "-o", tmp_path / "run",
        "--align", "rotation", "--time-offset", "auto", "--json",
    )  # fmt: skip
    assert (code, err) == (0, "")
    document = json.loads(out)
    assert document["time_offset_s"] == pytest.approx(-0.12, abs=2e-3)
    run = read_run(tmp_path / "run")
    from gpvo.dataset.errors import motion_errors

    errors = motion_errors(run.log, run.truth)
    assert len(errors.xi) > N - 10
    step = np.median(np.linalg.norm(errors.T_true[:, :3, 3], axis=1))
    assert np.median(np.linalg.norm(errors.xi[:, :3], axis=1)) < 0.05 * step


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["{log}", "-o", "{out}", "--frame", "world"], "--frame is 'world'"),
        (["{log}", "-o", "{out}", "--time-offset", "soon"], "--time-offset is 'soon'"),
        (["{log}", "-o", "{out}", "--time-offset", "auto"], "give --truth"),
        (["{log}", "-o", "{out}", "--map", "abc"], "--map is 'abc'"),
        (["{log}", "-o", "{out}", "--truth-map", "abc"], "--truth-map is 'abc'"),
        (["{log}", "-o", "{out}", "--format", "xml"], "unknown format 'xml'"),
        (["{log}", "-o", "{out}", "--truth-sigma", "1"], "--truth-sigma is '1'"),
        (["{log}", "-o", "{out}", "--vehicle", "boat"], "--vehicle is 'boat'"),
        (["{log}", "-o", "{out}", "--max-turn", "0"], "--max-turn is 0"),
        (["{log}", "-o", "{out}", "--truth", "{late}"], "--time-offset auto"),
        (["{log}", "-o", "{out}", "--truth", "{late}"], "does not overlap"),
        (["{log}", "-o", "{out}", "--truth", "{positions}"], "write 0, 0, 0, 1 as q_x, q_y, q_z, q_w"),
        (["{log}", "-o", "{out}", "--truth", "{laser}"], "write 0, 0, 0, 1 as q_x, q_y, q_z, q_w"),
        (["{log}", "-o", "{out}", "--truth", "{nan}"], "line 5 holds NaN"),
        (["{missing}", "-o", "{out}"], "no such file"),
        (["{log}", "-o", "{taken}"], "not a run"),
    ],
)
def test_import_refuses_in_one_line(tmp_path, words, reason):
    files = {k: tmp_path / k for k in ("log", "out", "late", "nan", "missing", "taken", "positions", "laser")}
    write_tum(files["log"], T_NS, _poses())
    write_tum(files["late"], T_NS + 10**12, _poses())
    write_tum(files["nan"], T_NS, _poses())
    lines = files["nan"].read_text().splitlines()
    lines[4] = lines[4].split(" ")[0] + " nan" * 7
    files["nan"].write_text("\n".join(lines))
    files["positions"].write_text("1.5 0 0 0\n1.6 0 0 1\n")
    files["laser"].write_text("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]\n1500000000,0,0,0\n")
    files["taken"].mkdir()
    (files["taken"] / "mine.txt").write_text("mine")
    code, out, err = gpvo("import", *(w.format(**files) for w in words))
    assert code == 2
    assert reason in err
    assert err.count("\n") == 1
    assert out == ""


def test_import_of_real_logs(real_data, tmp_path):
    kitti, euroc = real_data / "kitti_stereo_vo", real_data / "euroc_v1_01_vo"
    code, out, _ = gpvo("import", kitti / "07_est.txt", "--truth", kitti / "07_gt.txt", "-o", tmp_path / "k", "--json")
    assert code == 0
    assert json.loads(out)["with_truth"] == json.loads(out)["frames"]
    code, out, _ = gpvo(
        "import", euroc / "stamped_odometry_trajectory_all.txt", "--truth", euroc / "stamped_groundtruth.txt",
        "--align", "rotation", "--time-offset", "auto", "-o", tmp_path / "e", "--json",
    )  # fmt: skip
    assert code == 0
    document = json.loads(out)
    assert abs(document["time_offset_s"]) < 0.2
    assert document["rotation_deg"] > 1
    from gpvo.dataset.errors import motion_errors

    run = read_run(tmp_path / "e")
    errors = motion_errors(run.log, run.truth)
    true = np.median(np.linalg.norm(errors.T_true[:, :3, 3], axis=1))
    assert np.median(np.linalg.norm(errors.xi[:, :3], axis=1)) < 0.5 * true
    openvins = real_data / "openvins_mh01_cov"
    code, out, _ = gpvo(
        "import", openvins / "MH01_ov_est.csv", "--truth", openvins / "MH01_ov_gt.csv", "-o", tmp_path / "o", "--json"
    )
    assert code == 0
    assert json.loads(out)["methods"] == ["imported_pose"]


def test_a_camera_is_described_by_plain_numbers(tmp_path):
    """What ``info`` prints of a calibration is JSON as it stands."""
    from gpvo.cameras.rig import StereoRig

    lens = PinholeRadtan(400.0, 400.0, 320.0, 240.0, 640, 480)
    json.dumps(StereoRig(lens, lens, seq.T_RIGHT_LEFT).describe())


def test_simulated_log_with_turned_truth_is_put_right(tmp_path):
    """Odometry on simulated tracks, written as TUM; its truth in a tracker's frame, turned, on a clock 250 ms ahead."""
    from gpvo.dataset.errors import motion_errors
    from gpvo.io import open_source
    from gpvo.runner import run as run_vo
    from gpvo.sim.points import simulate_points

    flight = simulate_points("room-t265", 3, duration_s=20.0)
    run_vo(open_source(flight.save(tmp_path / "flight.npz")), tmp_path / "vo")
    own = read_run(tmp_path / "vo")
    R_cam_tracker = se3.so3_exp(np.array([1.1, -0.6, 2.0]))
    turned = own.truth.T_world_cam @ se3.from_rt(R_cam_tracker, np.zeros(3))
    write_tum(tmp_path / "gt.txt", own.truth.t_ns + 250_000_000, turned)
    args = ("--align", "rotation", "--time-offset", "auto", "--json")
    code, out, err = gpvo(
        "import", tmp_path / "vo" / "trajectory.tum", "--truth", tmp_path / "gt.txt", "-o", tmp_path / "run", *args
    )
    assert (code, err) == (0, "")
    document = json.loads(out)
    assert document["time_offset_s"] == pytest.approx(0.25, abs=5e-3)
    found = read_run(tmp_path / "run")
    t = own.truth.t_ns + 250_000_000
    np.testing.assert_array_equal(found.truth.t_ns, t)
    # What the import took off the truth's axes is what was put on them, to half a degree.
    left = np.swapaxes(own.truth.T_world_cam[:, :3, :3], 1, 2) @ found.truth.T_world_cam[:, :3, :3]
    assert np.degrees(np.linalg.norm(se3.so3_log(left), axis=1).max()) < 0.5
    # And the errors of the imported log are about those that the odometry really had.
    a, b = (motion_errors(r.log, r.truth).xi for r in (own, found))
    rms = [np.sqrt((x[:, :3] ** 2).sum(axis=1).mean()) for x in (a, b)]
    assert rms[1] < 2 * rms[0]


def test_python_m_gpvo_is_the_command_line():
    done = subprocess.run([sys.executable, "-m", "gpvo", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("gpvo ")


def test_run_says_what_the_source_remarks(tmp_path):
    path = stereo_bag(True).write(tmp_path / "a.bag")
    code, out, err = gpvo("run", path, "-o", tmp_path / "run", "--preset", "thesis", "--json")
    assert code == 0
    assert json.loads(out)["frames"] == 12
    assert err.count("poses on '/vicon/head/head' not used as truth") == 1
    code, _, err = gpvo(
        "run", path, "-o", tmp_path / "run", "--overwrite", "--preset", "thesis", "--truth-topic", "none"
    )
    assert (code, err) == (0, "")


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "runs/a/x.parquet"), 2, "runs/a/x.parquet: No space left"),
        (IsADirectoryError(errno.EISDIR, "Is a directory", "out"), 2, "out: Is a directory"),
        (OSError("two\nlines"), 2, "two lines"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 1, ""),
    ],
)
def test_failures_of_the_system_in_one_line(monkeypatch, tmp_path, error, code, line):
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("gpvo.cli.files.describe", fail)
    monkeypatch.setattr("sys.stdout", sys.stdout)  # put back what the command line puts before a broken pipe
    monkeypatch.setattr("sys.stderr", sys.stderr)
    stopped, _, err = gpvo("info", tmp_path)
    assert stopped == code
    assert err.startswith(f"gpvo: {line}" if line else "")
    assert len(err.splitlines()) == (1 if line else 0)


def test_pair_tolerance(tmp_path):
    path = seq.write_euroc(tmp_path / "s")
    late = [f"{t + 4_000_000},{t}.png" for t in seq.stamps(12)]
    (path / "mav0" / "cam1" / "data.csv").write_text("\n".join(late))
    code, _, err = gpvo("info", path)
    assert code == 2
    assert "the nearest are 4 ms apart" in err
    code, out, _ = gpvo("info", path, "--pair-tolerance", "0.005", "--json")
    assert (code, json.loads(out)["frames"]) == (0, 12)


def test_numbered_images_as_their_refusal_advises(tmp_path):
    path = seq.write_folder(tmp_path / "s")
    for k, file in enumerate(sorted((path / "left").iterdir())):
        (path / "right" / file.name).rename(path / "right" / f"{k:04d}.png")
        file.rename(path / "left" / f"{k:04d}.png")
    code, _, err = gpvo("info", path)
    assert code == 2
    assert "or give --rate-hz" in err
    code, out, _ = gpvo("info", path, "--rate-hz", 10, "--json")
    assert (code, json.loads(out)["frames"], json.loads(out)["rate_hz"]) == (0, 12, pytest.approx(10.0))


@pytest.mark.parametrize(("term", "told"), [(0, "0.00 px remain"), (10, "--calibration-state")])
def test_what_a_corrected_calibration_leaves(tmp_path, term, told):
    """A shift, and a bend of fourth order, which neither a rotation nor a focal length explains."""
    camera = StereoCamera(380.0, 380.0, 319.5, 239.5, 0.12, 640, 480)
    write_run(tmp_path / "r", VoLog([VoRecord(0, 0, Status.START, np.eye(4))], camera=camera))
    for size, text in ((0.0, "c.yaml: the calibration, unchanged"), (0.01, told)):
        state = RigState(size * np.eye(N_COEFFICIENTS)[term], 1e-6 * np.eye(N_COEFFICIENTS), 1.0)
        write_json(tmp_path / "r" / "calibration_state.json", document(state, camera))
        code, out, err = gpvo("calibration", tmp_path / "r", "-o", tmp_path / "c.yaml")
        assert code == 0
        assert text in out + err


def test_a_run_that_is_mostly_lost_has_not_shown_its_calibration(tmp_path):
    camera = StereoCamera(380.0, 380.0, 319.5, 239.5, 0.12, 640, 480)
    records = [VoRecord(0, 0, Status.START, np.eye(4))]
    records += [VoRecord(k, 0, Status.LOST, np.eye(4), reason=f"only {k} of 99 points agree") for k in range(1, 10)]
    write_run(tmp_path / "r", VoLog(records, camera=camera))
    state = RigState(np.zeros(N_COEFFICIENTS), 1e-6 * np.eye(N_COEFFICIENTS), 1.0)
    write_json(tmp_path / "r" / "calibration_state.json", document(state, camera))
    code, out, _ = gpvo("calibration", tmp_path / "r")
    assert (code, out) == (0, "too few motions tell: 9 of 10 are lost; is the calibration of these images?\n")
    assert "not_ok: only N of N points agree (9)" in gpvo("info", tmp_path / "r")[1]


def test_a_baseline_of_decimetres_is_told(tmp_path):
    path = seq.write_folder(tmp_path / "s")
    chain = path / "camchain.yaml"
    chain.write_text(chain.read_text().replace("[1.0, 0.0, 0.0, -0.1]", "[1.0, 0.0, 0.0, -5.37]"))
    code, out, _ = gpvo("info", path)
    assert code == 0
    assert "notes: baseline 5.37 m: are the translations in metres?" in out

"""Whose poses a log holds: what ``gpvo import`` takes them for, what it says, and what comes out at the other end."""

from __future__ import annotations

import json
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
import sequences as seq
from bag_maker import BagMaker
from gpvo.cli import app
from gpvo.geometry import se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.bag_reader import ODOMETRY_TYPE, messages, open_bag
from gpvo.io.run import read_run
from gpvo.io.trajectory import write_tum
from typer.testing import CliRunner

N, DT_S = 40, 0.05
# A body that drives ahead and turns to the left, and the camera on it that looks ahead.
SPEED_MPS, YAW_RADPS = 1.3, 0.5
BODY = se3.exp(np.outer(np.arange(N) * DT_S, [SPEED_MPS, 0, 0, 0, 0, YAW_RADPS]))
CAMERA = se3.inverse(T_FLU_OPTICAL) @ BODY @ T_FLU_OPTICAL
AHEAD = SPEED_MPS * DT_S


def _call(*words: object) -> tuple[str, str]:
    result = CliRunner().invoke(app, [str(w) for w in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout, result.stderr


def _odometry(path: Path, poses: np.ndarray, child: str) -> Path:
    maker = BagMaker(ros1=True)
    for t, T in zip(seq.stamps(N), poses, strict=True):
        maker.odometry("/odom", t, T, np.eye(6), 1e-4 * np.eye(6), child)
    return maker.write(path)


def _pose(path: Path, poses: np.ndarray, frame: str) -> Path:
    maker = BagMaker(ros1=True)
    for t, T in zip(seq.stamps(N), poses, strict=True):
        maker.pose_with_covariance("/odom", t, T, 1e-4 * np.eye(6), frame)
    return maker.write(path)


def _pose_stamped(path: Path, poses: np.ndarray, frame: str) -> Path:
    maker = BagMaker(ros1=True)
    for t, T in zip(seq.stamps(N), poses, strict=True):
        maker.pose_with_covariance("/odom", t, T, np.eye(6), frame)
        at, topic, message = maker.messages.pop()
        stamped = maker.type("geometry_msgs/msg/PoseStamped")(message.header, message.pose.pose)
        maker.add(topic, stamped, at)
    return maker.write(path)


@pytest.mark.parametrize(
    ("make", "poses", "name", "frame"),
    [
        (_odometry, BODY, "base_link", "body"),
        (_odometry, BODY, "camera_link", "body"),
        (_odometry, BODY, "", "body"),
        (_odometry, CAMERA, "Left_Camera_Optical_Frame", "cam"),
        (_pose, BODY, "odom", "body"),
        (_pose, CAMERA, "camera_optical", "cam"),
        (_pose_stamped, BODY, "world", "body"),
        (_pose_stamped, CAMERA, "camera_optical", "cam"),
    ],
)
def test_a_bag_holds_a_body_unless_its_frame_is_optical(make, poses, name, frame, tmp_path):
    bag = make(tmp_path / "a.bag", poses, name)
    _, err = _call("import", bag, "-o", tmp_path / "run")
    other = "cam" if frame == "body" else "body"
    assert err.count("\n") == 1
    assert f"/odom ('{name}')" in err
    assert f"--frame {other}" in err
    run = read_run(tmp_path / "run")
    np.testing.assert_allclose(se3.log(list(run.log)[5].T_prev_cur)[:3], [0, 0, AHEAD], atol=1e-6)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["kind"] == "import"
    assert f'frame = "{frame}"' in (tmp_path / "run" / "config.toml").read_text()
    # Stated, it is not said again; and quiet is quiet.
    assert _call("import", bag, "-o", tmp_path / "stated", "--frame", other)[1] == ""
    assert _call("import", bag, "-o", tmp_path / "quiet", "-q")[1] == ""
    turned = list(read_run(tmp_path / "stated").log)[5].T_prev_cur
    assert abs(turned[2, 3]) < 0.1 * AHEAD


def test_ground_truth_in_the_same_bag_is_used_and_said_to_be(tmp_path):
    maker, stamps = BagMaker(True), seq.stamps(N)
    for k in range(N):
        maker.odometry("/odom", stamps[k], BODY[k], np.zeros((6, 6)), np.eye(6) * 1e-4, "base_link")
        maker.pose_with_covariance("/mocap", stamps[k], BODY[k], np.zeros((6, 6)), "world")
    bag = maker.write(tmp_path / "a.bag")
    with_truth = ("import", bag, "--topic", "/odom", "--truth", bag, "--truth-topic", "/mocap", "-o", tmp_path / "run")
    assert "not used" not in _call(*with_truth)[0]
    assert "poses on /mocap are not used" in _call("import", bag, "--topic", "/odom", "-o", tmp_path / "bare")[0]
    result = CliRunner().invoke(app, ["doctor", str(bag), "--truth", str(bag)])
    assert "which topic of the bag is the ground truth? (name it with --truth-topic)" in str(result.exception)


def test_a_file_holds_a_camera_and_nothing_is_said(tmp_path):
    write_tum(tmp_path / "log.tum", np.array(seq.stamps(N)), CAMERA)
    assert _call("import", tmp_path / "log.tum", "-o", tmp_path / "run")[1] == ""
    np.testing.assert_allclose(
        se3.log(list(read_run(tmp_path / "run").log)[5].T_prev_cur)[:3], [0, 0, AHEAD], atol=1e-6
    )


def test_a_log_of_px4_is_its_body_seen_from_below(tmp_path):
    """NED world and FRD body, as a flight controller logs them, give the run that ENU and FLU give."""
    stamps, world, body = np.array(seq.stamps(N)), se3.from_rt(se3.R_NED_ENU, [5, 6, 7]), np.eye(4)
    body[:3, :3] = se3.R_FRD_FLU
    write_tum(tmp_path / "flu.tum", stamps, BODY)
    write_tum(tmp_path / "frd.tum", stamps, world @ BODY @ body)
    runs = {}
    for name, frame in (("flu", "body"), ("frd", "frd")):
        log = tmp_path / f"{name}.tum"
        _call("import", log, "--truth", log, "-o", tmp_path / name, "--frame", frame)
        runs[name] = read_run(tmp_path / name)
    for flu, frd in zip(runs["flu"].log, runs["frd"].log, strict=True):
        np.testing.assert_allclose(frd.T_prev_cur, flu.T_prev_cur, atol=1e-7)
    np.testing.assert_array_equal(runs["frd"].mounting.T_body_cam, T_FLU_OPTICAL)
    truth = runs["frd"].truth.T_world_cam
    np.testing.assert_allclose(se3.inverse(truth[:-1]) @ truth[1:], se3.inverse(CAMERA[:-1]) @ CAMERA[1:], atol=1e-7)


def test_odometry_of_a_bag_is_published_as_it_came(tmp_path):
    """Ahead is ahead and left is left, from the messages of a robot to the messages of gpvo."""
    _call("import", _odometry(tmp_path / "a.bag", BODY, "base_link"), "-o", tmp_path / "run")
    _call("publish", tmp_path / "run", "--method", "imported", "-o", tmp_path / "out.bag")
    with open_bag(tmp_path / "out.bag") as reader:
        topics = [name for name, info in reader.topics.items() if info.msgtype == ODOMETRY_TYPE]
        _, message = list(messages(reader, topics))[5]
    assert message.child_frame_id == "base_link"
    v, w = message.twist.twist.linear, message.twist.twist.angular
    np.testing.assert_allclose([v.x, v.y, v.z, w.x, w.y, w.z], [SPEED_MPS, 0, 0, 0, 0, YAW_RADPS], atol=1e-4)


def test_a_quaternion_in_the_wrong_order_is_asked_about(tmp_path):
    """A TUM file with w first is as regular as one with x first; only the truth tells."""
    rng, stamps = np.random.default_rng(3), np.array(seq.stamps(400))
    motions = se3.exp([0, 0, AHEAD, 0, 0, 0] + np.cumsum(0.003 * rng.standard_normal((400, 6)), axis=0))
    poses = np.array(list(accumulate(motions, np.matmul)))
    for name in ("log.tum", "gt.tum"):
        write_tum(tmp_path / name, stamps, poses)
    rows = [line.split() for line in (tmp_path / "log.tum").read_text().splitlines()]
    (tmp_path / "log.tum").write_text("".join(" ".join([*r[:4], r[7], *r[4:7]]) + "\n" for r in rows))
    _call("import", tmp_path / "log.tum", "--truth", tmp_path / "gt.tum", "-o", tmp_path / "run")
    out, _ = _call("evaluate", tmp_path / "run")
    assert "Are the quaternions of both in the right order" in " ".join(out.split())


@pytest.mark.parametrize("inverse", ["log", "gt", None])
def test_poses_from_world_to_camera_are_named(tmp_path, inverse):
    """Some odometries write T_cam_world. Their motions look like motions; only the other poses tell."""
    rng, stamps = np.random.default_rng(5), np.array(seq.stamps(400))
    motions = se3.exp([0, 0, AHEAD, 0, 0, 0] + np.cumsum(0.003 * rng.standard_normal((400, 6)), axis=0))
    poses = np.array(list(accumulate([np.eye(4), *motions[1:]], np.matmul)))
    noisy = np.array(
        list(accumulate([np.eye(4), *(motions @ se3.exp(2e-3 * rng.standard_normal((400, 6))))[1:]], np.matmul))
    )
    for name, T in (("log", noisy), ("gt", poses)):
        write_tum(tmp_path / f"{name}.tum", stamps, se3.inverse(T) if name == inverse else T)
    _call("import", tmp_path / "log.tum", "--truth", tmp_path / "gt.tum", "-o", tmp_path / "run")
    out, _ = _call("evaluate", tmp_path / "run")
    told, whose = " ".join(out.split()), {"log": "odometry", "gt": "truth or odometry"}
    assert "fixed rotation" not in told
    if inverse is None:
        assert "inverse" not in told
    else:
        assert f"The poses of the {whose[inverse]} seem to be inverse, T_cam_world" in told
        assert "backwards" not in told


def test_the_doctor_judges_a_bag_as_import_and_evaluate_do(tmp_path):
    rng = np.random.default_rng(3)
    noisy = se3.exp(np.cumsum(0.01 * rng.standard_normal((N, 6)), axis=0))
    for poses, name in ((BODY, "base_link"), (CAMERA, "left_optical")):
        bag, truth, run = _odometry(tmp_path / f"{name}.bag", poses @ noisy, name), tmp_path / "gt.tum", tmp_path / name
        write_tum(truth, np.array(seq.stamps(N)), poses)
        [topic] = json.loads(_call("doctor", bag, "--truth", truth, "--json")[0])["topics"]
        _call("import", bag, "--truth", truth, "-o", run)
        [judged] = json.loads(_call("evaluate", run, "--json")[0])["runs"]
        motions = topic["nees"]["motions"]
        assert motions["joint"]["nees_dof"] == judged["methods"]["imported"]["nees_dof"]["joint"]
        assert motions["translation"]["nees_dof"] == judged["methods"]["imported"]["nees_dof"]["translation"]

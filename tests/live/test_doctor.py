"""The doctor finds what is wrong with a covariance, and nothing where nothing is."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_maker import BagMaker
from gpvo.cli import app
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.trajectory import write_tum
from gpvo.live.doctor import Stated, examine, examine_bag
from gpvo.publish.odometry import Odometry
from gpvo.publish.ros import odometry_message
from shim_bags import engine, flight, flown
from synthetic_runs import make_run
from typer.testing import CliRunner

TOPIC = "/vo/odometry"
N = 150


def good_flight(seed: int) -> list[Odometry]:
    live, kept, _ = engine()
    for arrival in flown(*flight(seed=seed, n=N)):
        live.take(arrival)
    return [o for o in kept.frames if o.twist_body is not None]


@pytest.fixture(scope="module")
def good() -> list[Odometry]:
    return good_flight(11)


def bag_of(frames: list[Odometry], path: Path) -> Path:
    maker = BagMaker(ros1=False)
    for k, o in enumerate(frames):
        maker.add(TOPIC, odometry_message(o, maker.store.types), 10**18 + k * 50_000_000)
    return maker.write(path)


def _each(change: Callable[[Odometry, int], dict]) -> Callable[[list[Odometry]], list[Odometry]]:
    return lambda frames: [replace(o, **change(o, k)) for k, o in enumerate(frames)]


def _permuted(C: np.ndarray) -> np.ndarray:
    order = [3, 4, 5, 0, 1, 2]
    return C[np.ix_(order, order)]


def _impossible(C: np.ndarray) -> np.ndarray:
    out = C.copy()
    out[0, 1] = out[1, 0] = 2 * np.sqrt(C[0, 0] * C[1, 1])
    return out


def _asymmetric(C: np.ndarray) -> np.ndarray:
    out = C.copy()
    out[0, 1] += 0.5 * C[0, 0]
    return out


def _with_diagonal(C: np.ndarray, index: int, value: float) -> np.ndarray:
    out = C.copy()
    out[index, :] = out[:, index] = 0.0
    out[index, index] = value
    return out


def _turned_as_vectors(o: Odometry, k: int) -> dict:
    d = np.array([1e-4, 4e-4, 9e-4])
    R = o.T_odom_body[:3, :3]
    return {"pose_covariance": np.diag([*(R @ d), 1e-5, 2e-5, 3e-5])}


def _in_parent(o: Odometry, k: int) -> dict:
    R = o.T_odom_body[:3, :3]
    return {"twist_body": np.concatenate([R @ o.twist_body[:3], R @ o.twist_body[3:]])}


def _moved(T: np.ndarray, x: float) -> np.ndarray:
    out = T.copy()
    out[0, 3] += x
    return out


FAULTS = {
    "pose-zero": _each(lambda o, k: {"pose_covariance": np.zeros((6, 6))}),
    "twist-zero": _each(lambda o, k: {"twist_covariance": np.zeros((6, 6))}),
    "pose-constant": _each(lambda o, k: {"pose_covariance": np.diag([0.01] * 3 + [0.001] * 3)}),
    "twist-constant": _each(lambda o, k: {"twist_covariance": np.diag([0.01] * 3 + [0.001] * 3)}),
    "twist-tiny": _each(lambda o, k: {"twist_covariance": _with_diagonal(o.twist_covariance, 2, 1e-10)}),
    "pose-huge": _each(lambda o, k: {"pose_covariance": _with_diagonal(o.pose_covariance, 5, 9999.0 + k)}),
    "pose-some-zero": _each(lambda o, k: {"pose_covariance": _with_diagonal(o.pose_covariance, 5, 0.0)}),
    "twist-negative": _each(lambda o, k: {"twist_covariance": _with_diagonal(o.twist_covariance, 1, -1e-3)}),
    "twist-not-finite": _each(lambda o, k: {"twist_covariance": o.twist_covariance * (np.nan if k == 70 else 1)}),
    "pose-asymmetric": _each(lambda o, k: {"pose_covariance": _asymmetric(o.pose_covariance)}),
    "twist-not-positive": _each(lambda o, k: {"twist_covariance": _impossible(o.twist_covariance)}),
    "pose-swapped": _each(lambda o, k: {"pose_covariance": _permuted(o.pose_covariance * np.outer(S, S))}),
    "pose-turned": _each(_turned_as_vectors),
    "pose-equals-twist": _each(lambda o, k: {"pose_covariance": o.twist_covariance}),
    "pose-against-twist": _each(lambda o, k: {"twist_covariance": o.twist_covariance * 0.05**4}),
    "twist-levels": _each(lambda o, k: {"twist_covariance": np.eye(6) * 10.0 ** -(2 + k // 40)}),
    "stamp-zero": _each(lambda o, k: {"t_ns": 0}),
    "stamp-backward": _each(lambda o, k: {"t_ns": o.t_ns - (10**8 if k % 9 == 8 else 0)}),
    "stamp-repeated": _each(lambda o, k: {"t_ns": o.t_ns - (50_000_000 if k % 9 == 8 else 0)}),
    "stamp-gap": lambda frames: [*frames[:60], *frames[80:]],
    "frame-empty": _each(lambda o, k: {"child_frame_id": ""}),
    "frame-same": _each(lambda o, k: {"child_frame_id": "odom"}),
    "frame-optical": _each(lambda o, k: {"child_frame_id": "camera_left_optical_frame"}),
    "frame-changes": _each(lambda o, k: {"frame_id": "odom" if k < 70 else "map"}),
    "pose-jump": _each(lambda o, k: {"T_odom_body": _moved(o.T_odom_body, 5.0 * (k >= 70))}),
    "twist-in-parent": _each(_in_parent),
    "twist-empty": _each(lambda o, k: {"twist_body": np.zeros(6)}),
    "twist-linear-unlike": _each(lambda o, k: {"twist_body": o.twist_body * [-1, 1, 1, 1, 1, 1]}),
    "twist-angular-unlike": _each(lambda o, k: {"twist_body": o.twist_body * [1, 1, 1, 57.3, 57.3, 57.3]}),
    "twist-scale": _each(lambda o, k: {"twist_body": o.twist_body * 0.05}),
}
S = np.array([3.0] * 3 + [1.0] * 3)


@pytest.mark.parametrize("code", FAULTS)
def test_a_seeded_fault_is_found(code: str, good: list[Odometry], tmp_path: Path) -> None:
    bag = bag_of(FAULTS[code](good), tmp_path / "bag")
    result = CliRunner().invoke(app, ["doctor", str(bag), "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    [topic] = json.loads(result.stdout)["topics"]
    assert topic["topic"] == TOPIC
    found = {f["code"]: f for f in topic["findings"]}
    assert code in found
    assert found[code]["consequence"]


def test_a_message_without_a_stamp_hides_nothing_and_is_no_gap(good: list[Odometry], tmp_path: Path) -> None:
    """Its place in the bag tells when it came: the others are judged as if it were not there."""
    for order in (1, -1):
        frames = [replace(o, t_ns=0) if k % 40 == 20 else o for k, o in enumerate(good)]
        frames[65:67] = frames[65:67][::order]
        found = {f.code for f in examine_bag(bag_of(frames, tmp_path / str(order)))[TOPIC]}
        assert found == {"stamp-zero"} | ({"stamp-backward"} if order < 0 else set())


def _truth_of(seed: int, path: Path) -> Path:
    """Of the body, in a world of its own."""
    stamps, _ = flight(seed=seed, n=N)
    _, truth = make_run(seed, n=N, rate_hz=20.0, geometry=False)
    T = T_FLU_OPTICAL @ truth.T_world_cam @ se3.inverse(T_FLU_OPTICAL)
    write_tum(path, stamps, T)
    return path


def test_with_truth_it_says_how_sure_the_topic_is(tmp_path: Path) -> None:
    """A fifth of the honest standard deviation has 25 times its NEES."""
    truth, joint = _truth_of(11, tmp_path / "truth.tum"), {}
    for name, part in (("honest", 1.0), ("sure", 0.2)):
        frames = [replace(o, twist_covariance=o.twist_covariance * part**2) for o in good_flight(11)]
        bag = bag_of(frames, tmp_path / name)
        result = CliRunner().invoke(app, ["doctor", str(bag), "--truth", str(truth), "--json"], catch_exceptions=False)
        [topic] = json.loads(result.stdout)["topics"]
        joint[name] = topic["nees"]["motions"]["joint"]["nees_dof"]
        assert topic["nees"]["poses"] is topic["nees"]["problem"] is None
    assert 0.4 < joint["honest"] < 2.0
    assert joint["sure"] == pytest.approx(25 * joint["honest"], rel=0.02)
    said = CliRunner().invoke(app, ["doctor", str(tmp_path / "sure"), "--truth", str(truth)]).stdout
    assert f"motions: {joint['sure']:.3g}" in said
    assert "overconfident" in said


def test_a_truth_of_another_time_is_told_beside_the_findings(good: list[Odometry], tmp_path: Path) -> None:
    stamps, T = flight(seed=11, n=N)
    write_tum(tmp_path / "late.tum", stamps + 10**12, T)
    result = CliRunner().invoke(
        app, ["doctor", str(bag_of(good, tmp_path / "bag")), "--truth", str(tmp_path / "late.tum")]
    )
    assert result.exit_code == 0
    assert "NEES unknown" in result.stdout


@pytest.mark.parametrize("seed", [11, 12, 13, 14, 15])
def test_nothing_is_found_in_a_good_bag(seed: int, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["doctor", str(bag_of(good_flight(seed), tmp_path / "bag"))])
    assert result.exit_code == 0
    assert result.stdout.splitlines()[-1].endswith("nothing found")


def test_what_was_found_is_counted(good: list[Odometry], tmp_path: Path) -> None:
    constant = [replace(o, pose_covariance=np.eye(6)) for o in good]
    for count, part in ((1, {}), (2, {"twist_covariance": 2 * np.eye(6)})):
        bag = bag_of([replace(o, **part) for o in constant], tmp_path / f"bag{count}")
        lines = CliRunner().invoke(app, ["doctor", str(bag)]).stdout.splitlines()
        assert sum(line.startswith("  ") and line[2] != " " for line in lines) == count, lines
        assert lines[0].endswith(": 1 fault found" if count == 1 else ": 2 faults found")


def test_wheel_odometry_of_two_robots_is_constant_and_says_the_same_twice(real_data: Path) -> None:
    """Both recordings are real, and neither is good: their drivers publish one covariance for ever."""
    for name in ("rl_test1.bag", "rl_test2.bag"):
        result = CliRunner().invoke(app, ["doctor", str(real_data / "bags" / name), "--json"])
        [topic] = json.loads(result.stdout)["topics"]
        codes = {f["code"] for f in topic["findings"]}
        assert {"pose-constant", "twist-constant"} <= codes
        assert not {c for c in codes if c.startswith(("stamp", "frame", "twist-in", "twist-scale"))}


def test_a_type_without_a_covariance_says_so(good: list[Odometry]) -> None:
    maker = BagMaker(ros1=False)
    for o in good:
        header, (p, q) = maker.header(o.t_ns, "odom"), maker._pose(o.T_odom_body)
        pose = maker.type("geometry_msgs/msg/Pose")(maker.type("geometry_msgs/msg/Point")(*p), q)
        maker.add("/pose", maker.type("geometry_msgs/msg/PoseStamped")(header, pose), o.t_ns)
    stated = Stated.of(m for _, _, m in maker.messages)
    assert [f.code for f in examine(stated)] == ["no-covariance"]
    assert np.isfinite(se3.log(stated.T)).all()


def test_a_twist_is_compared_with_the_motion_that_ends_there() -> None:
    """Of a body turned around that shakes, the twist of the message before is the motion in the parent's axes."""
    n, dt_s = 40, 0.05
    v = np.zeros((n, 6))
    v[:, 0] = (-1.0) ** np.arange(n)
    T = np.tile(se3.exp(np.array([0, 0, 0, 0, 0, np.pi])), (n, 1, 1))
    T[:, 0, 3] = -np.cumsum(v[:, 0]) * dt_s
    T[-1] = np.nan
    t_ns = 10**18 + np.arange(n, dtype=np.int64) * round(dt_s * 1e9)
    stated = Stated(t_ns, T, np.ones(n), (("odom", "base_link"),), None, None, v)
    assert [f.code for f in examine(stated)] == ["pose-not-finite", "no-covariance"]


def test_what_is_no_bag_and_no_topic_is_one_line() -> None:
    result = CliRunner().invoke(app, ["doctor", "no/such.bag"])
    assert result.exit_code != 0
    assert "--zenoh" in str(result.exception)


def test_a_truth_that_cannot_be_read_and_a_bag_without_poses_are_one_line(good: list[Odometry], tmp_path: Path) -> None:
    maker = BagMaker(ros1=False)
    maker.image("/left", 10**18, np.zeros((48, 64), np.uint8))
    bag, images = bag_of(good, tmp_path / "bag"), maker.write(tmp_path / "images")
    for words, said in (
        ((str(bag), "--truth", str(tmp_path / "none.tum")), r"none\.tum: no such file"),
        ((str(images),), "images: holds no poses to check .*gpvo run"),
    ):
        with pytest.raises(GpvoError, match=said):
            CliRunner().invoke(app, ["doctor", *words], catch_exceptions=False)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("absurd", [1e200, 1e300])
def test_what_is_beyond_all_measure_is_found_and_overflows_nothing(absurd: float, good: list[Odometry]) -> None:
    maker = BagMaker(ros1=False)
    last = len(good) - 1
    for k, o in enumerate(good):
        wild = replace(o, T_odom_body=_moved(o.T_odom_body, absurd), pose_covariance=o.pose_covariance * absurd)
        maker.add(TOPIC, odometry_message(wild if k in (0, 70, last) else o, maker.store.types), o.t_ns)
    codes = {f.code for f in examine(Stated.of(m for _, _, m in maker.messages))}
    assert "pose-not-finite" in codes


@pytest.mark.parametrize(("name", "told"), [("gone.bag", "no such bag"), ("notes.txt", "is not a bag")])
def test_what_is_no_bag_is_told_from_what_is_not_there(name: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x\n")
    with pytest.raises(GpvoError, match=rf"{name}: {told} \(for a running topic add --zenoh"):
        examine_bag(tmp_path / name)

"""The engine gives what the offline path gives, and says what is wrong."""

from __future__ import annotations

import shutil
import struct
import weakref
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bag_maker import BagMaker
from gpvo.dataset.check import rate_problems
from gpvo.errors import GpvoError, SourceError
from gpvo.files import read_json, write_json
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite
from gpvo.geometry.se3 import T_FLU_OPTICAL, rotate_covariance
from gpvo.io.bag_reader import ODOMETRY_TYPE, open_bag, stamp_ns
from gpvo.io.bag_reader import messages as read
from gpvo.io.foreign import read_foreign
from gpvo.io.stated import to_records
from gpvo.live import LiveSettings, job, outputs
from gpvo.live.engine import Engine
from gpvo.live.intake import Arrival, replay
from gpvo.live.job import run_live
from gpvo.live.late_truth import LateTruth
from gpvo.live.stages import PoseStage
from gpvo.live.stereo_stage import StereoStage
from gpvo.publish import ros
from gpvo.publish.odometry import Odometry, OdometryBuilder
from gpvo.publish.odometry import messages as offline
from gpvo.types import Status, StereoCamera, VoLog, VoRecord
from rosbags.rosbag2 import Writer
from shim_bags import STATED, TOPIC, Kept, engine, flight, flown, messages, save_model, shim_predictor
from small_model import small_model
from synthetic_runs import make_run


@pytest.mark.parametrize("stated", [None, STATED])
@pytest.mark.parametrize("child", ["base_link", "cam0_optical_frame"])
def test_the_shim_equals_the_imported_run(stated: np.ndarray | None, child: str, tmp_path: Path) -> None:
    stamps, T = flight()
    bag = messages(stamps, T, twist_covariance=stated, child=child).write(tmp_path / "vio")
    log = read_foreign(bag, topic=TOPIC)
    place = T_FLU_OPTICAL if log.frame == "body" else np.eye(4)
    assert (log.frame == "cam") == ("optical" in child)
    log = log.seen_from(place)
    records = VoLog(to_records(log)[0])
    predictions = shim_predictor().replay(records)
    want = list(offline(records, lambda r: predictions.get(r.t_ns), OdometryBuilder(place, T[0])))
    live, kept, told = engine()
    for arrival in flown(stamps, T, twist_covariance=stated, child=child):
        live.take(arrival)
    assert len(kept.frames) == len(want) == len(T)
    for ours, theirs, pose in zip(kept.frames, want, T, strict=True):
        np.testing.assert_allclose(ours.T_odom_body, pose, atol=1e-9)
        np.testing.assert_allclose(ours.pose_covariance, theirs.pose_covariance, rtol=1e-9, atol=1e-15)
        assert (ours.twist_covariance is None) == (theirs.twist_covariance is None)
        if ours.twist_covariance is not None:
            np.testing.assert_allclose(ours.twist_covariance, theirs.twist_covariance, rtol=1e-9)
            np.testing.assert_allclose(ours.twist_body, theirs.twist_body, rtol=1e-9)
    # The model learned from a body that flies ahead along x; seen by that camera it flies sideways.
    assert (told == []) == (child == "base_link")
    assert kept.reports[-1].level == (child != "base_link")
    assert "sigma x" in kept.reports[-1].values["driven_by"]


@pytest.mark.parametrize("frame", ["map", "cam0_optical_frame"])
def test_a_pose_message_names_what_its_twist_is_the_motion_of(frame: str) -> None:
    stamps, T = flight()
    live, kept, _ = engine()
    for arrival in flown(stamps, T):
        pose = arrival.message.pose.pose
        header = replace(arrival.message.header, frame_id=frame)
        live.take(replace(arrival, message=SimpleNamespace(header=header, pose=pose)))
    moved = se3.log(se3.inverse(T[-2]) @ T[-1]) / ((stamps[-1] - stamps[-2]) * 1e-9)
    np.testing.assert_allclose(kept.frames[-1].twist_body, moved, atol=1e-9)
    expected = ("odom", frame) if "optical" in frame else (frame, "base_link")
    assert {(o.frame_id, o.child_frame_id) for o in kept.frames} == {expected}


@pytest.mark.parametrize("given", [{"mavlink": "udp:127.0.0.1:14550"}, {"px4": True}])
def test_a_flight_controller_is_not_told_that_a_pose_does_not_drift(given: dict[str, Any]) -> None:
    """EKF2 and EKF3 fuse a pose as it stands; neither knows differences of poses."""
    with pytest.raises(GpvoError, match="not of an increment"):
        job._outputs(LiveSettings(Path("m"), pose_covariance="increment", **given), None)


def _of_a_planar_robot(
    of: str, tilt_rad: float, place: np.ndarray, folder: Path
) -> tuple[list[VoRecord], list[VoRecord]]:
    """What live and import make of 60 messages with zeros for height, roll and pitch, while the body trembles by
    ``tilt_rad`` about the latter two; the camera at ``place``."""
    rng, T, C = np.random.default_rng(2), np.eye(4), np.zeros((6, 6))
    own, maker, live, zero = (
        np.diag([1e-6, 4e-6, 0.0, 0.0, 0.0, 1e-6]),
        BagMaker(ros1=False),
        PoseStage(TOPIC, place),
        np.zeros((6, 6)),
    )
    for k in range(60):
        in_world = rotate_covariance(T[:3, :3], C) if of == "pose" else zero
        maker.odometry(TOPIC, 10**18 + k * 50_000_000, T, in_world, own if of == "twist" else zero, "base_link")
        motion = se3.exp(np.array([0.05, 0.0, 0.0, *(tilt_rad * rng.standard_normal(2)), 0.02]))
        A = se3.adjoint(se3.inverse(motion))
        T, C = T @ motion, A @ C @ A.T + own
    log = read_foreign(maker.write(folder / "wheels"), topic=TOPIC)
    records = [taken.record for t, topic, m in maker.messages for taken in live.take(Arrival(topic, m, t))]
    return records, to_records(log.seen_from(place))[0]


@pytest.mark.parametrize("axes", ["auto", "world", "body", "mixed"])
def test_covariances_of_poses_in_any_axes_as_in_an_import(axes: str, tmp_path: Path) -> None:
    """Each motion's own is what comes out, however the growing one of the pose is stated: OpenVINS' is mixed."""
    rng, T, C, zero = np.random.default_rng(3), np.eye(4), np.zeros((6, 6)), np.zeros((6, 6))
    root = 1e-3 * rng.standard_normal((6, 6))
    own, maker, live = root @ root.T + 1e-7 * np.eye(6), BagMaker(ros1=False), PoseStage(TOPIC, np.eye(4), axes)
    for k in range(60):
        of_rotation = np.eye(3) if axes == "mixed" else None
        stated = C if axes == "body" else rotate_covariance(T[:3, :3], C, of_rotation)
        maker.odometry(TOPIC, 10**18 + k * 50_000_000, T, stated, zero, "base_link")
        motion = se3.exp(np.array([0.3, 0.1, 0.0, 0.1, -0.2, 0.3]) + 0.05 * rng.standard_normal(6))
        A = se3.adjoint(se3.inverse(motion))
        T, C = T @ motion, A @ C @ A.T + own
    log = read_foreign(maker.write(tmp_path / "vio"), topic=TOPIC, covariance_axes=axes)
    records = [taken.record for t, topic, m in maker.messages for taken in live.take(Arrival(topic, m, t))]
    for ours, imported in zip(records[2:], to_records(log)[0][2:], strict=True):
        np.testing.assert_allclose(ours.covariances["imported"], own, rtol=0, atol=1e-9)
        np.testing.assert_allclose(imported.covariances["imported"], own, rtol=0, atol=1e-9)


@pytest.mark.parametrize("tilt_rad", [0.0, 1e-16, 1e-9, 1e-7])
@pytest.mark.parametrize("of", ["twist", "pose"])
def test_a_robot_in_a_plane_states_three_axes_as_in_an_import(of: str, tilt_rad: float, tmp_path: Path) -> None:
    """Its driver states zero for height, roll and pitch; what it says of the others counts, message by message."""
    records, imported = _of_a_planar_robot(of, tilt_rad, T_FLU_OPTICAL, tmp_path)
    for ours, theirs in zip(records[1:], imported[1:], strict=True):
        assert set(ours.covariances) == set(theirs.covariances) == {"imported"}
        if tilt_rad == 0.0:
            np.testing.assert_allclose(
                ours.covariances["imported"], theirs.covariances["imported"], rtol=1e-5, atol=1e-12
            )


@pytest.mark.parametrize("of", ["twist", "pose"])
def test_a_robot_in_a_plane_may_carry_a_tilted_camera(of: str, tmp_path: Path) -> None:
    tilted = T_FLU_OPTICAL @ se3.exp(np.array([0.2, 0.0, 0.3, -0.17, 0.0, 0.0]))
    records, _ = _of_a_planar_robot(of, 0.0, tilted, tmp_path)
    assert all(set(r.covariances) == {"imported"} and r.status is Status.OK for r in records[1:])


def _planar(k: int, T: np.ndarray, covariance: np.ndarray) -> Arrival:
    maker = BagMaker(ros1=False)
    maker.odometry(TOPIC, 10**18 + k * 50_000_000, T, np.zeros((6, 6)), covariance, "base_link")
    ((t, topic, message),) = maker.messages
    return Arrival(topic, message, t)


def test_unknown_height_roll_and_pitch_do_not_lose_a_tilted_camera() -> None:
    """In its axes they leak into the heading, which the driver does know."""
    tilted = T_FLU_OPTICAL @ se3.exp(np.array([0, 0, 0, -0.17, 0.0, 0.0]))
    live, T, unknown = PoseStage(TOPIC, tilted), np.eye(4), np.diag([1e-4, 2e-4, 1e6, 1e6, 2e6, 1e-4])
    for k in range(20):
        [taken] = live.take(_planar(k, T, unknown))
        assert taken.record.status in (Status.START, Status.OK)
        T = T @ se3.exp(np.array([0.05, 0, 0, 0, 0, 0.02]))


def test_one_bump_does_not_end_what_a_planar_robot_states() -> None:
    """Nor does rest before the first motion."""
    live, T, own = PoseStage(TOPIC, T_FLU_OPTICAL), np.eye(4), np.diag([1e-4, 2e-4, 0, 0, 0, 1e-4])
    stated = []
    for k in range(400):
        [taken] = live.take(_planar(k, T, own))
        stated.append(set(taken.record.covariances))
        T = T @ se3.exp(np.array([0.05, 0, 1e-5 if k == 100 else 0.0, 0, 0, 0.02]) * (k >= 40))
    assert stated[42:] == [{"imported"}] * 358


def test_a_covariance_is_symmetric_if_rounding_is_all_that_differs() -> None:
    """A filter that turns an isotropic block leaves 1e-21 on one side of the diagonal and -1e-21 on the other."""
    rng, live, T = np.random.default_rng(0), PoseStage(TOPIC, T_FLU_OPTICAL), np.eye(4)
    for k in range(50):
        R = se3.so3_exp(rng.standard_normal(3))
        C = np.zeros((6, 6))
        C[:3, :3], C[3:, 3:] = R @ (1e-4 * np.eye(3)) @ R.T, R @ (1e-6 * np.eye(3)) @ R.T
        [taken] = live.take(_planar(k, T, C))
        assert k == 0 or set(taken.record.covariances) == {"imported"}
        T = T @ se3.exp(rng.standard_normal(6) * 0.02)


def test_a_placeholder_pose_of_a_lost_odometry_moves_nothing() -> None:
    """RTAB-Map's, in ROS 2: the origin, with a variance of 9999. The way back from there is no motion either."""
    live, known = PoseStage(TOPIC, T_FLU_OPTICAL), np.eye(6) * 1e-4
    records = []
    for k in range(12):
        T = se3.exp(np.array([20.0 + 0.05 * k, 0, 0, 0, 0, 0]))
        lost = k in (5, 6)
        [taken] = live.take(_planar(k, np.eye(4) if lost else T, known * (9999e4 if lost else 1)))
        records.append(taken.record)
    assert [k for k, r in enumerate(records) if r.status is Status.LOST] == [5, 6, 7]
    assert max(np.linalg.norm(r.T_prev_cur[:3, 3]) for r in records) == pytest.approx(0.15)


def test_the_twist_is_in_the_child_frame_and_the_pose_in_its_parent() -> None:
    """A body that only drives forward, heading north: the twist is along its x, the pose moves along odom's y."""
    north = se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    T = np.array([north @ se3.exp(np.array([0.05 * k, 0, 0, 0, 0, 0])) for k in range(60)])
    stamps = 10**18 + np.arange(60) * 50_000_000
    live, kept, _ = engine()
    for arrival in flown(stamps, T):
        live.take(arrival)
    last = kept.frames[-1]
    assert last.twist_body is not None
    np.testing.assert_allclose(last.twist_body, [1.0, 0, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(last.T_odom_body[:3, 3], [0, 59 * 0.05, 0], atol=1e-9)
    # The model knows that the error along the way is twice that across it (camera z, body x, here odom's y).
    assert last.twist_covariance is not None
    assert last.twist_covariance[0, 0] > 1.5 * last.twist_covariance[1, 1]
    assert last.pose_covariance[1, 1] > 1.5 * last.pose_covariance[0, 0]


def test_the_increments_covariance_neither_grows_nor_vanishes() -> None:
    stamps, T = flight()
    last = {}
    for increment in (False, True):
        live, kept, _ = engine(increment=increment)
        for arrival in flown(stamps, T):
            live.take(arrival)
        last[increment] = np.array([np.trace(o.pose_covariance[:3, :3]) for o in kept.frames[1:]])
        assert all(is_positive_definite(o.pose_covariance) for o in kept.frames)
    assert last[False][-1] > 5 * last[False][1]
    assert last[True][50:].mean() < 2 * last[True][1:50].mean()
    assert last[True].min() > 1e-7


def test_a_state_holds_what_adds_up_whichever_covariance_is_published(tmp_path: Path) -> None:
    for increment in (False, True):
        live, _, _ = engine(increment=increment, state=tmp_path / f"{increment}.json")
        for arrival in flown(*flight()):
            live.take(arrival)
        live.close()
    assert (tmp_path / "True.json").read_bytes() == (tmp_path / "False.json").read_bytes()


def test_a_state_is_taken_up_where_it_stopped(tmp_path: Path) -> None:
    stamps, T = flight(n=80)
    state = tmp_path / "state.json"
    arrivals = flown(stamps, T)
    before, kept_before, _ = engine(state=state)
    for arrival in arrivals[:40]:
        before.take(arrival)
    before.close()
    after, kept_after, _ = engine(state=state)
    for arrival in arrivals[40:]:
        after.take(arrival)
    stopped, resumed = kept_before.frames[-1], kept_after.frames[0]
    np.testing.assert_allclose(resumed.T_odom_body, stopped.T_odom_body, atol=1e-9)
    assert np.linalg.eigvalsh(resumed.pose_covariance - stopped.pose_covariance).min() > 1e-3
    after.close()
    again, kept_again, _ = engine(state=state)
    again.take(arrivals[-1])
    assert [k.frames[0].reset_counter for k in (kept_before, kept_after, kept_again)] == [0, 1, 2]
    (tmp_path / "state.json").write_text("[]")
    with pytest.raises(GpvoError, match="not a state file of gpvo live"):
        engine(state=state)


def _gone(way_m: float, n: int = 300) -> list[Arrival]:
    """Straight ahead at 20 messages per second."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = np.linspace(0.0, way_m, n)
    return flown(10**18 + np.arange(n) * 50_000_000, T)


def test_a_state_taken_up_under_way_is_as_unsure_as_what_was_missed_is_long(tmp_path: Path) -> None:
    arrivals, state = _gone(150.0), tmp_path / "state.json"
    before, _, _ = engine(state=state)
    for arrival in arrivals[:100]:
        before.take(arrival)
    before.close()
    after, kept, _ = engine(state=state)
    after.take(arrivals[200])  # 5 s and 50 m later
    missed_m = 150.0 * 101 / 299
    assert missed_m / 3 < np.sqrt(kept.frames[0].pose_covariance[0, 0]) < 3 * missed_m


def test_what_was_missed_before_any_motion_was_seen_is_as_long_as_usual_ones() -> None:
    arrivals = _gone(150.0)
    live, kept, _ = engine()
    usual = np.full(6, 100.0)
    live.predictor.model = replace(
        live.predictor.model, velocities=replace(live.predictor.model.velocities, usual_rate_var=usual)
    )
    live = Engine(live.stage, live.predictor, [kept])
    live.take(arrivals[0])
    live.stage.reset()
    live.take(arrivals[100])
    assert np.sqrt(kept.frames[-1].pose_covariance[0, 0]) > 150.0 * 100 / 299


def test_a_silence_after_a_lost_frame_is_at_the_speed_of_before() -> None:
    arrivals = _gone(150.0)
    live, kept, _ = engine()
    for arrival in [*arrivals[:100], arrivals[130]]:
        live.take(arrival)
    lost = kept.frames[-1]
    assert lost.status is Status.LOST
    live.stage.reset()
    live.take(arrivals[240])
    grown = kept.frames[-1].pose_covariance - lost.pose_covariance
    assert np.sqrt(grown[0, 0]) > 0.9 * 150.0 * 110 / 299


@pytest.mark.parametrize("changed", [
    {"T_odom_body": 2.0 * np.eye(4)}, {"T_odom_body": np.diag([1.0, 1.0, 1.0, np.nan])},
    {"pose_covariance": -np.eye(6)}, {"pose_covariance": np.eye(6) + 2.0 * np.eye(6)[::-1]},
    {"pose_covariance": np.full((6, 6), 1e300)}, {"scale": np.zeros(6)}, {"scale": "x"}, {"resets": "x"},
    {"twist": [1.0, np.inf, 0.0, 0.0, 0.0, 0.0]}, {"t_ns": "x"},
], ids=str)  # fmt: skip
def test_a_state_that_cannot_be_is_refused_in_one_line(changed: dict, tmp_path: Path) -> None:
    good = {"schema": 1, "T_odom_body": np.eye(4), "pose_covariance": np.eye(6), "scale": np.ones(6)}
    write_json(tmp_path / "state.json", {**good, **changed})
    with pytest.raises(GpvoError, match=r"state\.json: is not a state file of gpvo live") as refusal:
        engine(state=tmp_path / "state.json")
    assert "\n" not in str(refusal.value)


def test_a_model_of_another_camera_is_called_out_at_once_and_every_ten_seconds() -> None:
    camera = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
    stage, told = StereoStage("/left", "/right"), []
    stage.camera = replace(camera, baseline_m=0.5)
    predictor = shim_predictor()
    predictor.camera = camera
    live = Engine(stage, predictor, [], tell=told.append)
    for second in range(26):
        live.take(Arrival("/other", None, second * 10**9))
    assert sum("baseline is 0.5" in text for text in told) == 3


def test_a_warning_whose_numbers_change_is_repeated_every_ten_seconds_as_well() -> None:
    live, _, told = engine()
    shares = iter(range(100))
    live.stage.problems = lambda: [f"only {next(shares) / 3:.3g} % of the images are of {next(shares)} lines"]
    for second in range(26):
        live.take(Arrival("/other", None, second * 10**9))
    assert sum("% of the images" in text for text in told) == 3


def test_inputs_that_the_odometry_does_not_give_are_named() -> None:
    """A model of images, asked about poses: not the surroundings are unknown, the model is the wrong one."""
    stamps, T = flight(n=60)
    live, kept, told = engine(predictor=small_model().predictor())
    for arrival in flown(stamps, T):
        live.take(arrival)
    assert any("the input lacks n_inliers, ln_var_" in text for text in told)
    assert "n_inliers" in kept.reports[-1].text


def test_an_odometry_at_another_rate_or_outside_the_domain_is_called_out() -> None:
    stamps, T = flight(n=60)
    live, kept, told = engine()
    for arrival in flown(stamps[0] + (stamps - stamps[0]) * 4, T):
        live.take(arrival)
    assert any("the rate is 5 Hz" in text for text in told)
    assert kept.reports[-1].level == 1
    # A reference that is kept, as at rest, makes long motions of frames that come as usual.
    resting = [VoRecord(k * 50_000_000, 0, Status.OK, np.eye(4)) for k in range(1, 30)]
    assert rate_problems(live.predictor, resting) == []
    assert rate_problems(live.predictor, resting[::5]) != []


def test_a_bag_replayed_by_the_command_is_the_same_in_a_bag(tmp_path: Path) -> None:
    stamps, T = flight(n=60)
    bag = messages(stamps, T).write(tmp_path / "vio")
    model = save_model(tmp_path / "vio.gpvo")
    with pytest.raises(GpvoError, match="already exists .*remove it"):
        run_live(LiveSettings(model, replay=bag, fast=True, out=bag))
    result = run_live(LiveSettings(model, replay=bag, fast=True, out=tmp_path / "out.mcap"))
    assert result["counts"]["frames_ok"] == 60
    written = read_foreign(tmp_path / "out.mcap")
    np.testing.assert_allclose(written.trajectory.T_world_body, T[1:], atol=1e-9)
    assert written.covariance is not None
    assert all(is_positive_definite(C) for C in written.covariance[1:])


def test_a_torn_message_of_a_recording_costs_no_other(tmp_path: Path) -> None:
    maker, model = messages(*flight(n=60)), save_model(tmp_path / "vio.gpvo")
    with Writer(tmp_path / "vio", version=8) as writer:
        connection = writer.add_connection(TOPIC, ODOMETRY_TYPE, typestore=maker.store)
        for k, (t, _, message) in enumerate(maker.messages):
            data = maker.store.serialize_cdr(message, ODOMETRY_TYPE)
            writer.write(connection, t, data[:20] if k == 30 else data)
    result = run_live(LiveSettings(model, replay=tmp_path / "vio", fast=True, out=tmp_path / "out.mcap"))
    assert (result["counts"]["undecodable"], result["counts"]["frames_ok"]) == (1, 59)
    assert len(read_foreign(tmp_path / "out.mcap").trajectory.t_ns) == 59


def test_of_a_recording_that_breaks_off_what_was_before_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(*args: Any, **options: Any) -> Iterator[Arrival]:
        yield from islice(replay(*args, **options), 30)
        raise SourceError("a chunk is cut off")

    monkeypatch.setattr(job, "replay", cut)
    bag = messages(*flight(n=60)).write(tmp_path / "vio")
    settings = LiveSettings(save_model(tmp_path / "vio.gpvo"), replay=bag, fast=True, out=tmp_path / "out.bag")
    with pytest.raises(SourceError, match="cut off"):
        run_live(settings)
    assert len(read_foreign(tmp_path / "out.bag").trajectory.t_ns) == 29


def test_a_flight_that_is_killed_remains_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "PART_S", 0.0)
    arrivals, kept = flown(*flight(n=12)), Kept()
    output = outputs.FileOutput(tmp_path / "out.mcap")
    live = Engine(PoseStage(TOPIC), shim_predictor(), [output, kept])
    for arrival in arrivals:
        live.take(arrival)
    output._writer.shutdown()  # the process would end here
    parts = sorted((tmp_path / "out.mcap.parts").iterdir())
    poses = [read_foreign(part).trajectory.T_world_body for part in parts]
    np.testing.assert_allclose(np.concatenate(poses), [o.T_odom_body for o in kept.frames[1:]], atol=1e-9)
    live.close()
    assert [p.name for p in tmp_path.iterdir()] == ["out.mcap"]
    again = outputs.FileOutput(tmp_path / "again.bag")
    (tmp_path / "again.bag.parts").mkdir()
    (tmp_path / "again.bag.parts" / "1.bag").touch()  # of a process that was killed
    for frame in kept.frames:
        again.odometry(frame)
    again.close()
    assert sorted(p.name for p in tmp_path.rglob("*.bag")) == ["1.bag", "again.bag"]


def test_a_bag_in_parts_holds_all_in_order_whatever_its_suffix_and_memory_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "PART_S", 0.0)
    live, kept, _ = engine()
    for arrival in flown(*flight(n=12)):
        live.take(arrival)
    write, fails = ros.write_bag, [True, False]

    def write_bag(*args: Any, **options: Any) -> int:
        if fails and fails.pop(0):
            raise GpvoError("the disk is full")
        return write(*args, **options)

    monkeypatch.setattr(ros, "write_bag", write_bag)
    output, stamps = outputs.FileOutput(tmp_path / "OUT.BAG"), [o.t_ns for o in kept.frames[1:]]
    (tmp_path / "OUT.BAG.parts").mkdir()
    (tmp_path / "OUT.BAG.parts" / f"{stamps[3]}.bag").touch()  # of a process that was killed, on a clock from zero
    frames = [replace(o) for o in kept.frames]
    for frame in frames[:2]:
        output.odometry(frame)
    output._writer.submit(lambda: None).result()  # it is done
    with pytest.raises(GpvoError, match="disk is full"):
        output.odometry(frames[2])
    for frame in frames[3:]:
        output.odometry(frame)
    output._writer.shutdown()
    held, frame = [weakref.ref(f) for f in frames], None
    del frames
    assert [ref() is None for ref in held] == [k != 1 for k in range(len(held))]  # but for what could not be written
    output.close()
    with open_bag((tmp_path / "OUT.BAG").rename(tmp_path / "out.bag")) as reader:
        headers = [reader.deserialize(raw, c.msgtype).header for c, _, raw in reader.messages()]
    assert [stamp_ns(SimpleNamespace(header=h)) for h in headers] == stamps
    assert [h.seq for h in headers] == list(range(len(stamps)))
    assert [p.name for p in (tmp_path / "OUT.BAG.parts").iterdir()] == [f"{stamps[3]}.bag"]


@pytest.mark.parametrize("part_s", [0.0, 1e9])
def test_a_clock_that_is_set_back_does_not_mix_two_flights(
    part_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "PART_S", part_s)
    (stamps, T), kept = flight(n=60), Kept()
    live = Engine(PoseStage(TOPIC), shim_predictor(), [outputs.FileOutput(tmp_path / "out.mcap"), kept])
    for back_ns in (0, 2 * 10**9):
        for arrival in flown(stamps - back_ns, T):
            live.take(replace(arrival, received_ns=arrival.received_ns + 3 * back_ns))
    live.close()
    sent = [o.t_ns for o in kept.frames if o.twist_body is not None]
    assert (np.diff(sent) < 0).sum() == 1
    with open_bag(tmp_path / "out.mcap") as reader:
        assert [stamp_ns(m) for _, m in read(reader, ["/gpvo/odometry"])] == sent


def test_status_lost_is_not_sent_but_reported() -> None:
    stamps, T = flight(n=60)
    arrivals = flown(stamps, T)
    live, kept, _ = engine()
    for arrival in [*arrivals[:30], *arrivals[45:]]:
        live.take(arrival)
    lost = [o for o in kept.frames if o.status is Status.LOST]
    assert [o.t_ns for o in lost] == [stamps[45]]
    assert lost[0].twist_covariance is None
    assert max(r.level for r in kept.reports) == 2
    assert kept.reports[-1].level == 2 or kept.frames[-1].status is Status.OK


@pytest.mark.parametrize("sec", [-5, 2**31, 2**32 - 1])
def test_a_stamp_that_no_message_can_hold_is_dropped(sec: int) -> None:
    stamps, T = flight(n=30)
    live, kept, _ = engine()
    for arrival in flown(stamps, T):
        live.take(arrival)
    for arrival in flown(sec * 10**9 + stamps - stamps[0], T):
        live.take(arrival)
    assert len(kept.frames) == len(T)
    assert live.stage.counts["clock"] == len(T)


class _Down(Kept):
    """An output whose link is down in the middle of a flight, and a file that cannot be finished."""

    def odometry(self, odometry: Odometry) -> None:
        if 10 <= len(self.frames) < 20:
            self.frames.append(odometry)
            raise OSError("network is unreachable") if len(self.frames) % 2 else struct.error("too large to pack")
        super().odometry(odometry)

    def close(self) -> None:
        raise GpvoError("cannot be written: no space left", where="out.bag")


def test_a_link_that_is_down_and_a_state_that_cannot_be_saved_end_nothing(tmp_path: Path) -> None:
    stamps, T = flight(n=60)
    folder, told, kept, closed = tmp_path / "gone", [], Kept(), []
    folder.mkdir()
    kept.close = lambda: closed.append(True)
    live = Engine(PoseStage(TOPIC), shim_predictor(), [_Down(), kept], tell=told.append, state=folder / "state.json")
    for k, arrival in enumerate(flown(stamps, T)):
        if k == 1:
            shutil.rmtree(folder)
            folder.touch()  # a file where its folder was
        live.take(replace(arrival, received_ns=k * 10**9))
    assert len(kept.frames) == len(T)
    assert live.counts["output_failed"] == 10
    assert live.counts["failed"] == 0
    assert any("network is unreachable" in text for text in told)
    assert any("the state is not saved" in text for text in told)
    with pytest.raises(GpvoError, match="no space left"):
        live.close()
    assert closed
    with pytest.raises(GpvoError, match="is no folder"):
        engine(state=folder / "state.json")


def _with_truth(
    factor: float, state: Path | None = None, covariance: float = 1e-12, told: list[str] | None = None
) -> tuple[Engine, list[Arrival]]:
    """An engine fed with an odometry whose errors are ``factor`` times its usual ones, and truth half a second late."""
    log, truth = make_run(9, n=300, geometry=False)
    T_true = T_FLU_OPTICAL @ truth.T_world_cam @ se3.inverse(T_FLU_OPTICAL)
    motions = se3.inverse(T_true[:-1]) @ T_true[1:]
    T_log = T_FLU_OPTICAL @ log.trajectory() @ se3.inverse(T_FLU_OPTICAL)
    errors = se3.log(se3.inverse(motions) @ se3.inverse(T_log[:-1]) @ T_log[1:])
    T_est = [T_true[0]]
    for motion, error in zip(motions, errors):
        T_est.append(T_est[-1] @ motion @ se3.exp(factor * error))
    stamps = 10**18 + np.arange(len(T_true)) * 50_000_000
    maker = BagMaker(ros1=False)
    for t, T in zip(stamps, T_true):
        maker.pose_with_covariance("/mocap", int(t), T, covariance * np.eye(6))
    late = [Arrival("/mocap", m, t + 500_000_000) for t, _, m in maker.messages]
    arrivals = sorted([*flown(stamps, np.array(T_est)), *late], key=lambda a: a.received_ns)
    stage = PoseStage(TOPIC)
    tell, truth = ([] if told is None else told).append, LateTruth("/mocap")
    return Engine(stage, shim_predictor(), [Kept()], tell=tell, truth=truth, state=state), arrivals


def test_late_truth_adapts_the_scale_which_a_restart_keeps(tmp_path: Path) -> None:
    scales = {}
    for factor in (1.0, 4.0):
        live, arrivals = _with_truth(factor, tmp_path / f"{factor}.json")
        for arrival in arrivals:
            live.take(arrival)
        live.close()
        assert live.counts["truth"] > 280
        assert live.counts["failed"] == 0
        scales[factor] = live.predictor.scale
    assert np.exp(np.log(scales[4.0]).mean()) > 2.0 * np.exp(np.log(scales[1.0]).mean())
    again, arrivals = _with_truth(4.0, tmp_path / "4.0.json")
    again.take(next(a for a in arrivals if a.topic == TOPIC))
    np.testing.assert_allclose(again.predictor.scale, scales[4.0])
    document = read_json(tmp_path / "4.0.json")
    write_json(tmp_path / "4.0.json", {**document, "model": "another"})
    other, arrivals = _with_truth(4.0, tmp_path / "4.0.json", told=(told := []))
    [frame] = other.take(next(a for a in arrivals if a.topic == TOPIC))
    np.testing.assert_array_equal(other.predictor.scale, np.ones(6))
    np.testing.assert_allclose(frame.T_odom_body, document["T_odom_body"])
    assert any("another model's" in text for text in told)


def test_truth_of_another_body_or_in_other_axes_is_called_out() -> None:
    live, arrivals = _with_truth(1.0, told=(told := []))
    kept = live.outputs[0]
    for arrival in arrivals:
        if arrival.topic == "/mocap":
            p = arrival.message.pose.pose.position
            p.x, p.y, p.z = p.y, p.z, p.x
        live.take(arrival)
    assert any("late truth does not fit" in text for text in told)
    assert isinstance(kept, Kept)
    assert kept.reports[-1].level == 1
    assert max(float(x) for x in kept.reports[-1].values["scale"].split()) > 5.0


def test_truth_that_knows_less_than_the_odometry_teaches_nothing() -> None:
    live, arrivals = _with_truth(4.0, covariance=1.0)
    for arrival in arrivals:
        live.take(arrival)
    assert live.counts["truth"] == 0
    np.testing.assert_array_equal(live.predictor.scale, np.ones(6))


def test_one_truth_stamped_an_hour_ahead_costs_no_more_than_itself() -> None:
    counts = []
    for ahead_s in (0, 3600):
        live, arrivals = _with_truth(1.0)
        [a for a in arrivals if a.topic == "/mocap"][100].message.header.stamp.sec += ahead_s
        for arrival in arrivals:
            live.take(arrival)
        counts.append(live.counts["truth"])
    assert counts[0] - counts[1] <= 15  # those that waited: half a second of 20 Hz

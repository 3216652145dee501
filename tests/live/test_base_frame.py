"""The odometry of a robot's base frame, placed by /tf_static and /tf."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_maker import BagMaker, stereo_bag
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.bag_messages import FrameTree
from gpvo.io.bag_reader import open_bag
from gpvo.io.foreign import read_foreign
from gpvo.live import LiveSettings
from gpvo.live.engine import Engine
from gpvo.live.intake import Arrival
from gpvo.live.job import Live, make_stage, run_live
from gpvo.live.stages import BaseFrameStage, PoseStage
from gpvo.live.stereo_stage import StereoStage
from shim_bags import TOPIC, Kept, engine, flight, flown, messages, save_model, shim_predictor

T_BASE_MAST = se3.exp(np.array([0.1, 0.0, 0.5, 0.0, 0.3, 0.0]))
T_MAST_SOURCE = se3.exp(np.array([0.2, -0.1, 0.4, 0.1, -0.3, 0.5]))
TRANSFORMS = [("mast", "base_link", T_MAST_SOURCE), ("chassis", "mast", T_BASE_MAST)]
T_CHASSIS_SOURCE = T_BASE_MAST @ T_MAST_SOURCE


def tf_message(transforms: Iterable[tuple[str, str, np.ndarray]], maker: BagMaker | None = None) -> Any:
    """``tf2_msgs/TFMessage`` of (parent, child, T_parent_child)."""
    out = maker or BagMaker(ros1=False)
    parts = BagMaker(out.ros1)
    for parent, child, T in transforms:
        parts.transform("/", 0, T, parent, child)
    return out.type("tf2_msgs/msg/TFMessage")([m for _, _, m in parts.messages])


def tf(*transforms: tuple[str, str, np.ndarray], topic: str = "/tf_static") -> Arrival:
    return Arrival(topic, tf_message(transforms), 0)


def based(base: str = "chassis") -> tuple[Engine, Kept, list[str]]:
    kept, told = Kept(), []
    return Engine(BaseFrameStage(PoseStage(TOPIC), base), shim_predictor(), [kept], tell=told.append), kept, told


def test_pose_and_twist_with_their_covariances_are_those_of_the_base() -> None:
    arrivals = flown(*flight(n=40))
    plain, of_source, _ = engine()
    live, of_base, _ = based()
    for arrival in [tf(*TRANSFORMS), *arrivals]:
        live.take(arrival)
        plain.take(arrival)
    assert len(of_base.frames) == len(of_source.frames) == len(arrivals)
    A = se3.adjoint(T_CHASSIS_SOURCE)
    for ours, theirs in zip(of_base.frames, of_source.frames, strict=True):
        assert ours.child_frame_id == "chassis"
        T = theirs.T_odom_body @ se3.inverse(T_CHASSIS_SOURCE)
        np.testing.assert_allclose(ours.T_odom_body, T, atol=1e-9)
        if theirs.twist_body is not None:
            assert ours.twist_covariance is not None
            np.testing.assert_allclose(ours.twist_body, A @ theirs.twist_body, atol=1e-9)
            np.testing.assert_allclose(ours.twist_covariance, A @ theirs.twist_covariance @ A.T, rtol=1e-6, atol=1e-12)


def test_the_sources_own_frame_needs_no_transform() -> None:
    live, kept, _ = based("base_link")
    for arrival in flown(*flight(n=20)):
        live.take(arrival)
    assert len(kept.frames) == 21
    np.testing.assert_allclose(live.stage.T_body_cam, T_FLU_OPTICAL)


def test_nothing_is_published_until_the_transforms_say_where() -> None:
    arrivals = flown(*flight(n=60))
    live, kept, told = based()
    for arrival in [*arrivals[:30], tf(TRANSFORMS[0]), *arrivals[30:40]]:
        live.take(arrival)
    assert kept.frames == []
    assert live.stage.counts["unplaced"] == 40
    assert told == ["no transform from chassis to base_link on /tf_static or /tf"]
    assert kept.reports[-1].level == 1
    for arrival in [tf(TRANSFORMS[1], topic="/tf"), *arrivals[40:]]:
        live.take(arrival)
    assert [f.t_ns for f in kept.frames] == [a.received_ns - 1_000_000 for a in arrivals[40:]]
    assert "no transform" not in kept.reports[-1].text


def test_a_mounting_that_moves_is_told_and_the_first_place_stays() -> None:
    arrivals = flown(*flight(n=60))
    live, kept, told = based()
    turned = (*TRANSFORMS[1][:2], T_BASE_MAST @ se3.exp(np.array([0, 0, 0, 0, 0, 0.1])))
    for arrival in [tf(*TRANSFORMS), *arrivals[:30], tf(turned, topic="/tf"), *arrivals[30:]]:
        live.take(arrival)
    assert told == ["the transform from chassis to base_link changes: the mounting must be rigid"]
    np.testing.assert_allclose(live.stage.T_body_cam, T_CHASSIS_SOURCE @ T_FLU_OPTICAL)
    for arrival in [tf(TRANSFORMS[1], topic="/tf"), *flown(*flight(n=90))[62:]]:
        live.take(arrival)
    assert kept.reports[-1].level == 0


def test_a_source_that_names_another_frame_is_placed_anew() -> None:
    """One path, of the base frame, told of two frames on it one after the other."""
    T_SOURCE_EYE = se3.exp(np.array([0.1, 0.2, 0.3, 0.4, -0.2, 0.1])) @ T_FLU_OPTICAL
    stamps, T = flight(n=60)
    before, after = flown(stamps[:30], T[:30]), flown(stamps[30:], T[30:] @ T_SOURCE_EYE, child="eye_optical")
    live, kept, _ = based()
    for arrival in [tf(*TRANSFORMS), *before, *after[:10]]:
        live.take(arrival)
    assert len(kept.frames) == 30  # nothing says yet where it is
    for arrival in [tf(("base_link", "eye_optical", T_SOURCE_EYE)), *after[10:]]:
        live.take(arrival)
    np.testing.assert_allclose(live.stage.T_body_cam, T_CHASSIS_SOURCE @ T_SOURCE_EYE, atol=1e-9)
    T_base = T @ se3.inverse(T_CHASSIS_SOURCE)
    twists = {f.t_ns: f.twist_body for f in kept.frames if f.twist_body is not None}
    for k in (20, 45, 59):
        moved = se3.log(se3.inverse(T_base[k - 1]) @ T_base[k]) * 20.0
        np.testing.assert_allclose(twists[int(stamps[k])], moved, atol=1e-6)


def test_a_tree_joins_frames_over_their_common_ancestor_and_refuses_what_cannot_be() -> None:
    tree = FrameTree()
    assert tree.transform("a", "b") is None
    tree.take(tf_message([("/hub", "/a", T_BASE_MAST), ("hub", "b", T_MAST_SOURCE)]))
    T_a_b = tree.transform("a", "b")
    assert T_a_b is not None
    np.testing.assert_allclose(T_a_b, se3.inverse(T_BASE_MAST) @ T_MAST_SOURCE, atol=1e-12)
    good = tf_message([("hub", "b", np.eye(4))])
    [transform] = good.transforms
    q, v = type(transform.transform.rotation), type(transform.transform.translation)
    absurd = [
        replace(transform, transform=replace(transform.transform, rotation=q(0.0, 0.0, 0.0, 0.0))),
        replace(transform, transform=replace(transform.transform, rotation=q(np.nan, 0.0, 0.0, 1.0))),
        replace(transform, transform=replace(transform.transform, translation=v(1e200, 0.0, 0.0))),
        replace(transform, transform=replace(transform.transform, translation=v(0.0, np.inf, 0.0))),
        replace(transform, child_frame_id="hub"),
    ]
    tree.take(replace(good, transforms=absurd))
    assert tree.refused == len(absurd)
    np.testing.assert_array_equal(tree.transform("a", "b"), T_a_b)
    tree.take(tf_message([("b", "hub", np.eye(4))]))  # a ring: it ends all the same
    assert tree.transform("a", "elsewhere") is None
    tree.take(tf_message([("hub", f"f{k}", np.eye(4)) for k in range(2000)]))
    assert tree.refused > 1000


def test_a_camera_sits_where_the_frame_of_its_images_does() -> None:
    T_base_optical = se3.exp(np.array([0.3, 0.05, 0.2, 0.0, 0.0, 0.1])) @ T_FLU_OPTICAL
    left, right = "/camera/left/image_raw", "/camera/right/image_raw"
    live = BaseFrameStage(StereoStage(left, right), "base_link")
    taken = []
    for t, topic, m in [(0, "/tf_static", tf_message([("base_link", "cam", T_base_optical)])),
                        *sorted(stereo_bag(ros1=False, n=4).messages, key=lambda m: m[0])]:  # fmt: skip
        taken += live.take(Arrival(topic, m, t))
    taken += live.flush()
    assert len(taken) == 4
    assert {t.child_frame_id for t in taken} == {"base_link"}
    np.testing.assert_allclose(live.T_body_cam, T_base_optical @ live.T_source_cam, atol=1e-12)


def test_a_bag_with_transforms_is_replayed(tmp_path: Path) -> None:
    stamps, T = flight(n=60)
    maker = messages(stamps, T)
    maker.add("/tf_static", tf_message(TRANSFORMS, maker), int(stamps[0]) - 1)
    bag, model = maker.write(tmp_path / "vio"), save_model(tmp_path / "vio.gpvo")
    out = tmp_path / "out.mcap"
    run_live(LiveSettings(model, replay=bag, fast=True, out=out, base_frame="chassis"))
    written = read_foreign(out).trajectory
    np.testing.assert_allclose(written.T_world_body, (T @ se3.inverse(T_CHASSIS_SOURCE))[1:], atol=1e-9)
    plain, none = messages(stamps, T).write(tmp_path / "plain"), tmp_path / "none.mcap"
    with pytest.warns(UserWarning, match=r"none\.mcap: not written, because no frame had a motion"):
        result = run_live(LiveSettings(model, replay=plain, fast=True, out=none, base_frame="chassis"))
    assert result["counts"]["unplaced"] == len(T)
    assert not none.exists()


def test_poses_that_do_not_name_their_frame_are_refused() -> None:
    with pytest.raises(GpvoError, match="--base-frame"):
        make_stage(LiveSettings(Path("m"), odometry="/pose", odometry_type="pose", base_frame="base_link"))


def test_recorded_poses_that_do_not_name_their_frame_are_told_and_not_taken_for_the_odometrys_origin() -> None:
    live, kept, _ = based()
    maker = BagMaker(ros1=False)
    for k in range(30):
        maker.pose_with_covariance(TOPIC, 10**18 + k * 10**8, np.eye(4), 1e-6 * np.eye(6))
    live.take(tf(("odom", "chassis", T_BASE_MAST), ("map", "odom", np.eye(4))))
    for t, _, message in maker.messages:
        live.take(Arrival(TOPIC, message, t))
    assert not kept.frames
    assert live.stage.counts["unplaced"] == 30
    assert any("do not name the frame that moves" in p for p in live.stage.problems())


def test_the_topic_is_also_that_of_the_bag_and_what_lies_there_is_refused_before_the_flight(tmp_path: Path) -> None:
    bag, model = messages(*flight(n=60)).write(tmp_path / "vio"), save_model(tmp_path / "vio.gpvo")
    out = tmp_path / "out.mcap"
    settings = LiveSettings(model, replay=bag, fast=True, out=out, topic="/foo/odom")
    run_live(settings)
    with open_bag(out) as reader:
        assert list(reader.topics) == ["/foo/odom"]
    with pytest.raises(GpvoError, match=r"out\.mcap: already exists \(give another name or remove it\)"):
        Live(settings, None, print)
    for name, told in (("out.txt", "suffix.*end it in .bag or .mcap"), ("vio.gpvo/out.bag", "cannot be written")):
        with pytest.raises(GpvoError, match=told):
            Live(replace(settings, out=tmp_path / name), None, print)
    with pytest.raises(GpvoError, match="not a valid ROS name"):
        Live(replace(settings, topic="bad topic"), None, print)

"""``gpvo live`` in a process of its own, fed and read over the loopback by processes that share none of its state.

The readers are other people's: ``zenoh-ros2-sdk``, ``cyclonedds`` with IDL written out by hand and its command-line
tools, Debian's ``rostopic`` and ``rosbag``.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.live.intake import Arrival
from gpvo.live.job import open_wire
from gpvo.publish.odometry import Odometry
from ros1_tools import SYSTEM_PYTHON, needs_live_ros1, with_gpvo
from shim_bags import TOPIC, engine, flight, flown, save_model
from test_base_frame import TRANSFORMS, based, tf, tf_message
from wire_peers import Rows, ends, live, place, reader, running
from wire_publishers import latched, publish

needs_zenoh = pytest.mark.skipif(
    importlib.util.find_spec("zenoh_ros2_sdk") is None, reason="needs eclipse-zenoh and zenoh-ros2-sdk"
)
needs_dds = pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="needs cyclonedds")
WIRES = [
    pytest.param("zenoh", marks=needs_zenoh),
    pytest.param("dds", marks=needs_dds),
    pytest.param("ros1", marks=needs_live_ros1),
]
HASH = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
LISTED = {
    "zenoh": [["nav_msgs/msg/Odometry", HASH, "gpvo"]],
    "dds": [["nav_msgs::msg::dds_::Odometry_", f"typehash={HASH};"]],
    "ros1": "nav_msgs/Odometry",
}


def expected(messages: int) -> tuple[list[Arrival], list[Odometry]]:
    """A flight of another odometry, and what the engine makes of it in this process."""
    arrivals = flown(*flight(n=messages))
    here, kept, _ = engine()
    for arrival in arrivals:
        here.take(arrival)
    return arrivals, [o for o in kept.frames if o.twist_body is not None]


def check(got: Rows, want: list[Odometry], child: str = "base_link") -> None:
    """Every message arrived, with the numbers of the offline path."""
    assert [g["t"] for g in got] == [o.t_ns for o in want]
    for ours, theirs in zip(got, want, strict=True):
        assert (ours["frame"], ours["child"]) == ("odom", child)
        assert ours["x"] == pytest.approx(theirs.T_odom_body[0, 3], abs=1e-9)
        np.testing.assert_allclose(ours["pose"], theirs.pose_covariance.reshape(36), rtol=1e-9, atol=1e-15)
        assert theirs.twist_covariance is not None
        np.testing.assert_allclose(ours["twist"], theirs.twist_covariance.reshape(36), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("wire", WIRES)
def test_the_shim_is_listed_and_read_by_others(wire: str, tmp_path: Path) -> None:
    arrivals, want = expected(40)
    model = save_model(tmp_path / "m.gpvo")
    with (
        place(wire) as at,
        live(at, "--odometry", TOPIC, "--model", str(model)) as process,
        reader(at, len(want), tmp_path) as (listed, rows),
    ):
        assert listed == LISTED[wire]
        publish(at, TOPIC, arrivals, tmp_path)
        check(rows(), want)
        assert ends(process)["frames_start"] == 1


@pytest.mark.parametrize("wire", WIRES)
def test_transforms_that_were_sent_before_the_start_place_the_base(wire: str, tmp_path: Path) -> None:
    here, kept, _ = based()
    arrivals = flown(*flight(n=20))
    for arrival in [tf(*TRANSFORMS), *arrivals]:
        here.take(arrival)
    want = [o for o in kept.frames if o.twist_body is not None]
    model = save_model(tmp_path / "m.gpvo")
    with (
        place(wire) as at,
        latched(at, tf_message(TRANSFORMS), tmp_path),
        live(at, "--odometry", TOPIC, "--base-frame", "chassis", "--model", str(model)) as process,
        reader(at, len(want), tmp_path) as (_, rows),
    ):
        publish(at, TOPIC, arrivals, tmp_path)
        check(rows(), want, child="chassis")
        assert "unplaced" not in ends(process)


@needs_dds
def test_the_command_line_tools_of_cyclonedds_list_and_read_it(tmp_path: Path) -> None:
    tool = str(Path(sys.executable).with_name("cyclonedds"))
    arrivals, want = expected(20)
    model = save_model(tmp_path / "m.gpvo")
    with place("dds") as at, live(at, "--odometry", TOPIC, "--model", str(model)):
        plain = ["-i", at.address, "-r", "2s", "--suppress-progress-bar", "--color", "none"]
        ls = subprocess.run([tool, "ls", *plain, "-q"], capture_output=True, text=True, timeout=60)
        for said in ("rt/gpvo/odometry", "nav_msgs::msg::dds_::Odometry_", f"typehash={HASH[:20]}", "rt/diagnostics"):
            assert said in ls.stdout
        with running(tool, "subscribe", "rt/gpvo/odometry", *plain, "--qos", "dds-default") as subscribed:
            time.sleep(4.0)
            publish(at, TOPIC, arrivals, tmp_path)
            time.sleep(1.0)
            subscribed.terminate()
            out, _ = subscribed.communicate(timeout=20)
    stamps = [int(a) * 10**9 + int(b) for a, b in re.findall(r"sec=(\d+), nanosec=(\d+)", out)]
    # It looks now and then, and keeps the newest message alone.
    assert len(stamps) > len(want) // 2
    assert stamps == [o.t_ns for o in want if o.t_ns in stamps]


@needs_live_ros1
def test_without_a_master_ros_1_is_one_line() -> None:
    command = [SYSTEM_PYTHON, "-m", "gpvo", "live", "--ros1", "--odometry", "/odom", "--model", "m.gpvo"]
    env = with_gpvo(ROS_MASTER_URI="http://localhost:1")
    run = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 2
    assert "no ROS master at 'http://localhost:1'" in run.stderr


@needs_zenoh
@pytest.mark.parametrize("address", ["127.0.0.1", "tcp/127.0.0.1:1"])
def test_an_address_without_zenoh_is_one_line_that_names_it(address: str) -> None:
    with pytest.raises(GpvoError, match=f"{address}.*(start|give)") as told:
        open_wire("zenoh", address)
    assert ".rs:" not in str(told.value)
    assert "cargo" not in str(told.value)

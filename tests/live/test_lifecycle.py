"""What a managed node of ROS 2 asks of the engine: configured, active, inactive, active again, cleaned up."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from gpvo.live import LiveSettings
from gpvo.live.engine import load_state
from gpvo.live.intake import Mailbox
from gpvo.live.job import Live, open_wire
from shim_bags import TOPIC, flight, flown, save_model
from test_base_frame import TRANSFORMS, tf_message
from test_wires import needs_dds
from wire_peers import free_port
from wire_publishers import publish_on


def _until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@needs_dds
def test_a_pause_is_an_unknown_motion_and_what_came_in_it_is_not_used(tmp_path: Path) -> None:
    domain, told = 100 + free_port() % 100, []
    here, there = open_wire("dds", domain=domain), open_wire("dds", domain=domain)
    state = tmp_path / "state.json"
    settings = LiveSettings(
        save_model(tmp_path / "m.gpvo"),
        odometry=TOPIC,
        base_frame="chassis",
        depth=200,
        state=state,
    )
    try:
        live = Live(settings, here, told.append)
        arrivals = flown(*flight(n=60))
        transforms, poses = publish_on(there, "/tf", "tf2_msgs/msg/TFMessage"), publish_on(there, TOPIC)
        transforms(tf_message(TRANSFORMS))
        counts = live.engine.counts

        def fly(part: slice) -> None:
            for arrival in arrivals[part]:
                poses(arrival.message)
                time.sleep(0.005)

        fly(slice(0, 10))  # before it is activated
        time.sleep(0.3)
        assert counts["frames_start"] == 0
        live.start()
        _until(lambda: any("listening" in text for text in told))
        fly(slice(10, 30))
        _until(lambda: counts["frames_ok"] == 19)
        live.stop()
        fly(slice(30, 40))
        time.sleep(0.3)
        assert counts["frames_ok"] == 19
        live.start()
        _until(lambda: len(told) == 2)
        fly(slice(40, 60))
        _until(lambda: counts["frames_ok"] == 38)
        done = live.close()
        assert (done["frames_start"], done["restarts"]) == (2, 1)
        assert not {"failed", "unplaced", "undecodable", TOPIC} & set(done)
        assert load_state(state) is not None
        assert live.engine.last is not None
        assert live.engine.last.t_ns == arrivals[59].received_ns - 1_000_000
    finally:
        here.close()
        there.close()


def test_a_mailbox_that_was_closed_forgets_all_but_what_lasts() -> None:
    box = Mailbox(depth=2)
    box.close()
    for _ in range(3):
        box.put("/odom", b"old")
    box.put("/tf_static", b"lasts")
    box.open(["/tf_static"])
    box.put("/odom", b"new")
    assert [box.get(0.0)[1:] for _ in range(2)] == [("/tf_static", b"lasts"), ("/odom", b"new")]
    assert box.get(0.0) is None
    assert not any(box.dropped.values())

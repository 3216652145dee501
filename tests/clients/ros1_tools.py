"""ROS 1 as Debian packs it: which of its parts are here, an environment for its tools, and a master."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

SYSTEM_PYTHON = "/usr/bin/python3"
ROOT = Path(__file__).parents[2]


def environment(**more: str) -> dict[str, str]:
    """For Debian's own programs: nothing of this Python's."""
    keep = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "ROS"))}
    return {**keep, "ROS_PYTHON_VERSION": "3", "ROS_HOSTNAME": "localhost", "ROS_IP": "127.0.0.1", **more}


def with_gpvo(**more: str) -> dict[str, str]:
    """For Debian's Python with gpvo and what it needs, as a virtual environment with --system-site-packages has it."""
    path = os.pathsep.join([str(ROOT), sysconfig.get_path("purelib")])
    return environment(PYTHONPATH=path, **more)


def has(modules: str, env: dict[str, str] | None = None) -> bool:
    """Whether Debian's Python can import them."""
    if not Path(SYSTEM_PYTHON).exists():
        return False
    command = [SYSTEM_PYTHON, "-c", f"import {modules}"]
    return subprocess.run(command, capture_output=True, env=env or environment(), check=False).returncode == 0


needs_rosbag = pytest.mark.skipif(not has("rosbag"), reason="Debian's python3-rosbag is not installed")
needs_rospy = pytest.mark.skipif(
    not has("rospy, netifaces, nav_msgs.msg") or shutil.which("rosmaster") is None,
    reason="needs Debian's python3-rospy, -rosmaster, -netifaces, -nav-msgs, -geometry-msgs, -actionlib-msgs",
)
needs_live_ros1 = pytest.mark.skipif(
    not has("rospy, netifaces, nav_msgs.msg, sensor_msgs.msg, diagnostic_msgs.msg, numpy, cv2, rosbags", with_gpvo())
    or not all(shutil.which(tool) for tool in ("rosmaster", "rostopic", "rosbag")),
    reason="needs Debian's python3-rospy, -rosmaster, -rostopic, -rosbag, -netifaces, -sensor-msgs, -diagnostic-msgs, "
    "and a Python of the same version as Debian's",
)


@contextmanager
def ros_master() -> Iterator[str]:
    """A master of its own; yields ROS_MASTER_URI."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen(
        ["rosmaster", "--core", "-p", str(port)],
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    for _ in range(100):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        time.sleep(0.05)
    try:
        yield f"http://localhost:{port}"
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()

"""The ROS 2 package without ROS: its logic is run, its files agree with one another, its imports name what gpvo has."""

from __future__ import annotations

import ast
import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
import yaml
from gpvo.errors import GpvoError
from gpvo.live.outputs import ODOMETRY, POSE

PACKAGE = Path(__file__).parents[2] / "ros" / "gpvo_ros"


def _run_without_ros(path: Path) -> dict[str, Any]:
    """The names of a module, leaving out what it imports from ROS."""
    tree = ast.parse(path.read_text())
    ros = ("rclpy", "launch", "launch_ros")
    kept = []
    for node in tree.body:
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if not any(n.split(".")[0] in ros for n in names):
            kept.append(node)
    names: dict[str, Any] = {"__name__": "checked"}
    exec(compile(ast.Module(kept, []), str(path), "exec"), names)
    return names


def test_the_nodes_parameters_are_the_commands_options() -> None:
    node = _run_without_ros(PACKAGE / "gpvo_ros" / "live.py")
    stated = yaml.safe_load((PACKAGE / "config" / "live.yaml").read_text())["gpvo"]["ros__parameters"]
    assert stated == node["DEFAULTS"]
    settings = node["settings_of"]({**stated, "model": "m.gpvo", "odometry": "/vio", "odometry_type": "pose"})
    assert (settings.odometry, settings.pose_type, settings.stereo, settings.wire) == ("/vio", POSE, None, "ros2")
    stereo = node["settings_of"]({"model": "m.gpvo", "left": "/l", "right": "/r", "pose_covariance": "increment"})
    assert (stereo.stereo, stereo.pose_type, stereo.engine.increment) == (("/l", "/r"), ODOMETRY, True)
    for wrong in ({}, {"model": "m", "left": "/l"}, {"model": "m", "odometry_type": "tf"}):
        with pytest.raises(GpvoError):
            node["settings_of"](wrong)


def test_the_launch_file_declares_parameters_of_the_node() -> None:
    launch = ast.parse((PACKAGE / "launch" / "live.launch.py").read_text())
    [arguments] = [
        ast.literal_eval(n.value) for n in launch.body if isinstance(n, ast.Assign) and n.targets[0].id == "ARGUMENTS"
    ]
    assert set(arguments) <= set(_run_without_ros(PACKAGE / "gpvo_ros" / "live.py")["DEFAULTS"])


def test_the_package_is_an_ament_python_package() -> None:
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert package.findtext("export/build_type") == "ament_python"
    setup = (PACKAGE / "setup.py").read_text()
    for name in ("resource/gpvo_ros", "launch/live.launch.py", "config/live.yaml", "package.xml"):
        assert name in setup
        assert (PACKAGE / name).exists()
    assert f'version="{package.findtext("version")}"' in setup


def test_ros_wires_say_what_is_missing_where_ros_is_not_installed() -> None:
    from gpvo.live.job import open_wire

    for wire, package in (("ros2", "rclpy"), ("ros1", "rospy")):
        if importlib.util.find_spec(package) is None:
            with pytest.raises(GpvoError, match=f"{package} is not installed"):
                open_wire(wire)

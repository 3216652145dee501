"""The ROS 2 package without ROS: its logic is run, its files agree with one another, and what it takes from gpvo and
from ROS is there, by gpvo's modules and by what ROS's documentation lists."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from gpvo.errors import GpvoError
from gpvo.live.job import Live
from gpvo.live.ros_wire import Ros2Wire
from gpvo.types import VEHICLES, Vehicle

PACKAGE = Path(__file__).parents[2] / "ros" / "gpvo_ros"
NODE, LAUNCH = PACKAGE / "gpvo_ros" / "live.py", PACKAGE / "launch" / "live.launch.py"
# docs.ros.org: rclpy, launch, launch_ros and rcl_interfaces of Humble to Kilted.
ROS = {
    "rclpy": {"init", "spin", "try_shutdown"},
    "rclpy.executors": {"ExternalShutdownException"},
    "rclpy.lifecycle": {"LifecycleNode", "LifecycleState", "TransitionCallbackReturn"},
    "rcl_interfaces.msg": {"FloatingPointRange", "IntegerRange", "ParameterDescriptor"},
    "ament_index_python.packages": {"get_package_share_directory"},
    "launch": {"LaunchContext", "LaunchDescription"},
    "launch.actions": {"DeclareLaunchArgument", "OpaqueFunction"},
    "launch.substitutions": {"LaunchConfiguration"},
    "launch_ros.actions": {"LifecycleNode"},
}
OF_A_NODE = {"declare_parameter", "get_parameter", "get_logger", "trigger_configure", "trigger_activate"}
CALLBACKS = {f"on_{name}" for name in ("configure", "activate", "deactivate", "cleanup", "shutdown", "error")}


@pytest.fixture
def parameters(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(PACKAGE)
    return importlib.import_module("gpvo_ros.parameters")


def test_the_nodes_parameters_are_the_commands_options(parameters: ModuleType) -> None:
    stated = yaml.safe_load((PACKAGE / "config" / "live.yaml").read_text())["gpvo"]["ros__parameters"]
    assert stated == {name: p.default for name, p in parameters.PARAMETERS.items()}
    assert all(type(stated[name]) is type(p.default) for name, p in parameters.PARAMETERS.items())
    given = {"model": "m.gpvo", "odometry": "/vio", "odometry_type": "pose", "vehicle": "car", "max_turn": 5.0}
    settings = parameters.settings_of({**stated, **given})
    assert (settings.odometry, settings.odometry_type, settings.stereo) == ("/vio", "pose", None)
    assert settings.wire.transport() == "ros2"
    assert settings.vehicle == Vehicle(VEHICLES["car"].max_acceleration_mps2, 5.0)
    given = {"model": "m.gpvo", "left": "/l", "right": "/r", "pose_covariance": "increment", "base_frame": "base_link"}
    stereo = parameters.settings_of(given)
    assert (stereo.stereo, stereo.odometry_type, stereo.pose_covariance) == (("/l", "/r"), "odometry", "increment")
    assert stereo.base_frame == "base_link"
    assert stereo.calibration is None
    seen = {"preset": "thesis", "settings": "window=5 sigma_m_px=auto", "size": "320x240", "vehicle": "car"}
    of_pair = parameters.settings_of({**given, **seen}).vo
    assert (of_pair.config.preset, of_pair.config.window, of_pair.config.sigma_m_px) == ("thesis", 5, None)
    assert (of_pair.config.vehicle, of_pair.size, of_pair.hfov_deg) == (VEHICLES["car"], (320, 240), None)
    for wrong in (
        {},
        {"model": "m", "left": "/l"},
        {"model": "m", "odometry_type": "tf"},
        {"model": "m", "vehicle": "x"},
        {"model": "m", "left": "/l", "right": "/r", "settings": "windw=5"},
    ):
        with pytest.raises(GpvoError):
            parameters.settings_of(wrong)


def test_every_parameter_says_what_it_is_and_its_default_is_allowed(parameters: ModuleType) -> None:
    for name, p in parameters.PARAMETERS.items():
        assert p.description, name
        assert not p.choices or p.default in p.choices, name
        assert p.range is None or p.range[0] <= p.default <= p.range[1], name


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def _imports(path: Path) -> dict[str, set[str]]:
    """Modules, and what is taken from each by name or by ``module.name``."""
    out: dict[str, set[str]] = {}
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.ImportFrom):
            out.setdefault(str(node.module), set()).update(a.name for a in node.names)
        if isinstance(node, ast.Import):
            out.update({a.name: _attributes(path, a.name) for a in node.names})
    return out


def _attributes(path: Path, *names: str) -> set[str]:
    """What is asked of any of these names: ``name.attribute``."""
    found = [n for n in ast.walk(_tree(path)) if isinstance(n, ast.Attribute)]
    return {n.attr for n in found if ast.unparse(n.value) in names}


@pytest.mark.parametrize("path", [NODE, LAUNCH], ids=lambda p: p.name)
def test_what_is_imported_is_there(path: Path, parameters: ModuleType) -> None:
    needed = {e.text for e in ElementTree.parse(PACKAGE / "package.xml").getroot().iter("exec_depend")}
    for module, names in _imports(path).items():
        if module in ROS:
            assert names <= ROS[module], module
            assert module.split(".")[0] in needed
        else:
            there: Any = importlib.import_module(module)
            assert all(hasattr(there, name) for name in names), module


def test_what_the_node_asks_of_the_engine_and_of_itself_is_there() -> None:
    assert _attributes(NODE, "live", "self._live") == {"start", "stop", "close"}
    assert all(hasattr(Live, name) for name in ("start", "stop", "close"))
    assert all(hasattr(Ros2Wire, name) for name in _attributes(NODE, "wire"))
    [node] = [n for n in _tree(NODE).body if isinstance(n, ast.ClassDef)]
    own = {n.name for n in node.body if isinstance(n, ast.FunctionDef)} | {"_wire", "_live"}
    assert own >= CALLBACKS
    assert _attributes(NODE, "self", "node") <= own | OF_A_NODE


def test_messages_that_the_wire_asks_ros_for_are_named_in_the_package() -> None:
    needed = {e.text for e in ElementTree.parse(PACKAGE / "package.xml").getroot().iter("exec_depend")}
    assert {"diagnostic_msgs", "geometry_msgs", "nav_msgs", "sensor_msgs", "tf2_msgs"} <= needed


def test_a_launch_argument_becomes_its_parameters_type(parameters: ModuleType) -> None:
    for name, text, value in [
        ("autostart", "false", False), ("depth", "20", 20), ("max_turn", "5", 5.0), ("model", "1", "1"),
    ]:  # fmt: skip
        made = parameters.typed(name, text)
        assert (made, type(made)) == (value, type(value))


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

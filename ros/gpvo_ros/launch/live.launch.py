"""ros2 launch gpvo_ros live.launch.py model:=vins.gpvo odometry:=/vins_estimator/odometry

Arguments are the node's parameters (``--show-args``); those that are not given come from the file ``config``.
"""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from gpvo_ros.parameters import PARAMETERS, typed
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode


def generate_launch_description() -> LaunchDescription:
    """The managed node, with its parameters as launch arguments."""
    config = str(Path(get_package_share_directory("gpvo_ros")) / "config" / "live.yaml")
    declared = [DeclareLaunchArgument("config", default_value=config, description="Parameter file.")]
    for name, parameter in PARAMETERS.items():
        declared.append(DeclareLaunchArgument(name, default_value="", description=parameter.description))
    return LaunchDescription([*declared, OpaqueFunction(function=_node)])


def _node(context: LaunchContext) -> list[LifecycleNode]:
    texts = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    given = {name: typed(name, text) for name, text in texts.items() if text}
    parameters = [LaunchConfiguration("config").perform(context), *([given] if given else [])]
    return [
        LifecycleNode(
            package="gpvo_ros", executable="live", name="gpvo", namespace="", output="screen", parameters=parameters
        )
    ]

"""ros2 launch gpvo_ros live.launch.py model:=vins.gpvo odometry:=/vins_estimator/odometry"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = ("model", "odometry", "odometry_type", "left", "right", "imu", "calibration", "topic", "state")
DEFAULTS = {"odometry_type": "odometry", "topic": "/gpvo/odometry"}


def generate_launch_description() -> LaunchDescription:
    """The node, with its text parameters as launch arguments."""
    declared = [DeclareLaunchArgument(name, default_value=DEFAULTS.get(name, "")) for name in ARGUMENTS]
    parameters = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    node = Node(package="gpvo_ros", executable="live", name="gpvo", output="screen", parameters=[parameters])
    return LaunchDescription([*declared, node])

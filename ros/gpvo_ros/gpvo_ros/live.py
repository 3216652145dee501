"""Managed ROS 2 node: gpvo's live engine with rclpy as its wire, and parameters in place of the command's options.

It broadcasts no transform: the filter that consumes the odometry does. Pairs of images are joined by the engine, by
stamps; transforms and CameraInfo are read by it from their topics.
"""

from __future__ import annotations

import sys

import rclpy
from gpvo.errors import GpvoError
from gpvo.live.job import Live
from gpvo.live.ros_wire import Ros2Wire
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from gpvo_ros.parameters import PARAMETERS, Parameter, settings_of


class LiveNode(LifecycleNode):
    """Configured, it has its model and its topics; active, it publishes; cleaned up, it has saved its state.

    Parameters are read when it is configured.
    """

    def __init__(self) -> None:
        super().__init__("gpvo")
        self._wire: Ros2Wire | None = None
        self._live: Live | None = None
        for name, parameter in PARAMETERS.items():
            self.declare_parameter(name, parameter.default, descriptor_of(parameter))

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the model and subscribe; FAILURE, with one line in the log, where something cannot be used."""
        self._wire = Ros2Wire(self)
        try:
            given = {name: self.get_parameter(name).value for name in PARAMETERS}
            self._live = Live(settings_of(given), self._wire, self.get_logger().warning)
        except GpvoError as error:
            self.get_logger().error(str(error))
            self.end()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Use what arrives from here on; after a pause, across an unknown motion."""
        if self._live is not None:
            self._live.start()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stay silent, with model, topics and pose."""
        if self._live is not None:
            self._live.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Save the state, and let go of model and topics."""
        self.end()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As when it is cleaned up, from any state."""
        self.end()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Back to the beginning, as if never configured."""
        self.end()
        return TransitionCallbackReturn.SUCCESS

    def end(self) -> None:
        """Save the state, and let go of model and topics, if there are any."""
        live, wire, self._live, self._wire = self._live, self._wire, None, None
        try:
            if live is not None:
                live.close()
        except GpvoError as error:
            self.get_logger().error(str(error))
        finally:
            if wire is not None:
                wire.close()


def descriptor_of(parameter: Parameter) -> ParameterDescriptor:
    """Description, range and choices, as ``ros2 param describe`` shows them."""
    described = ParameterDescriptor(description=parameter.description)
    if parameter.choices:
        described.additional_constraints = f"One of {', '.join(parameter.choices)}."
    if parameter.range is not None:
        least, most = parameter.range
        if isinstance(parameter.default, int):
            described.integer_range = [IntegerRange(from_value=int(least), to_value=int(most), step=1)]
        else:
            described.floating_point_range = [FloatingPointRange(from_value=least, to_value=most)]
    return described


def main() -> None:
    """Run until the node is shut down; exit code 1 where it was to start by itself and could not."""
    rclpy.init()
    node, succeeded = LiveNode(), True
    try:
        if node.get_parameter("autostart").value:
            succeeded = node.trigger_configure() == TransitionCallbackReturn.SUCCESS
            succeeded = succeeded and node.trigger_activate() == TransitionCallbackReturn.SUCCESS
        if succeeded:
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.end()
        rclpy.try_shutdown()
    sys.exit(0 if succeeded else 1)


if __name__ == "__main__":
    main()

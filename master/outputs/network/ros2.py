"""ROS 2 as a live output.

Hands and objects on standard topics, by rmw_zenoh's own network, without ROS.
"""

from common.calibration.output_settings import Ros2Output
from common.errors import BusError
from common.messages import HandPose, ObjectPose, ResultMessage
from master.outputs.network.ros2_link import RosPublishers
from master.outputs.network.ros2_messages import hand_messages, object_messages
from master.outputs.network.times import Times


class Ros2Sink:
    """A `Sink`. Holds the node `phalanx` in ROS's network."""

    def __init__(self, settings: Ros2Output, times: Times) -> None:
        """Join the router.

        Raises:
            BusError: It is not there.
        """
        self._times, self._router = times, settings.router
        self._publishers = RosPublishers(settings.router, settings.domain_id, "/", "phalanx")

    def write(self, message: ResultMessage) -> None:
        """Publish a hand or an object.

        Raises:
            BusError: The router is gone.
        """
        if not self._publishers.joined:
            raise BusError(f"ros2: the router at {self._router} is gone")
        if isinstance(message, HandPose):
            messages = hand_messages(message, self._times.wall_ns(message.t_ns))
        elif isinstance(message, ObjectPose):
            messages = object_messages(message, self._times.wall_ns(message.t_ns))
        else:
            return
        for topic, payload in messages:
            self._publishers.publish(topic, payload)

    def close(self) -> None:
        """Leave ROS's network. Safe to call twice."""
        self._publishers.close()

"""Publishers of ROS 2 on a zenoh session of their own.

The session joins the router of rmw_zenoh; no ROS is installed.

The other file that knows zenoh: this session belongs to ROS's network, not to the bus.
"""

import json
import logging
import time

import zenoh

from common.errors import BusError
from master.outputs.network.ros2_names import Node, Topic, attachment, gid_of

_LOG = logging.getLogger(__name__)
_RETRY = {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2}


class RosPublishers:
    """A ROS 2 node and its publishers.

    Holds the session, and for each topic its publisher, token and number of messages.
    """

    def __init__(self, router: str, domain: int, namespace: str, name: str) -> None:
        """Join the router at `router`, for example tcp/127.0.0.1:7447.

        A router that is not there is tried again.

        Raises:
            BusError: The endpoint is malformed.
        """
        timeout_ms = 1000
        settings: dict[str, object] = {
            "mode": "client",
            "connect": {
                "endpoints": [router],
                "timeout_ms": timeout_ms,
                "exit_on_failure": True,
                "retry": _RETRY,
            },
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        except zenoh.ZError as error:
            raise BusError(
                f"ros2: no router at {router}: start one with `ros2 run rmw_zenoh_cpp rmw_zenohd`, or set `router`"
            ) from error
        self._node = Node(domain, str(self._session.info.zid()), namespace, name)
        self._token = self._session.liveliness().declare_token(self._node.token())
        self._publishers: dict[str, _Publisher] = {}

    @property
    def joined(self) -> bool:
        """Whether a router is there now."""
        return len(self._session.info.routers_zid()) > 0

    def publish(self, topic: Topic, payload: bytes | memoryview) -> None:
        """Send one message, CDR with its header of four bytes.

        The first message of a topic declares its publisher.

        Raises:
            BusError: The session is gone.
        """
        try:
            publisher = self._publishers.get(topic.name)
            if publisher is None:
                token = self._node.publisher_token(len(self._publishers) + 1, topic)
                publisher = _Publisher(self._session, topic.key(self._node.domain), token)
                self._publishers[topic.name] = publisher
            publisher.put(payload)
        except zenoh.ZError as error:
            raise BusError(f"ros2: cannot publish {topic.name}: {error}") from error

    def close(self) -> None:
        """Leave: all tokens go. Safe to call twice."""
        try:
            self._session.close()
        except zenoh.ZError as error:
            _LOG.warning("ros2: closing: %s", error)


class _Publisher:
    """Holds the publisher of one topic, its token and how many messages it sent."""

    def __init__(self, session: zenoh.Session, key: str, token: str) -> None:
        self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._token = session.liveliness().declare_token(token)
        self._gid = gid_of(token)
        self._sent = 0

    def put(self, payload: bytes | memoryview) -> None:
        self._sent += 1
        self._publisher.put(bytes(payload), attachment=attachment(self._sent, time.time_ns(), self._gid))

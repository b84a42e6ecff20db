"""Names that ROS 2 uses on zenoh.

Keys of topics, liveliness tokens of nodes and publishers, gids, attachments.

ROS 2's middleware rmw_zenoh finds publishers by tokens that describe all about them, and reads each topic at a key
that holds domain, topic, type and the hash of the type's description. Written from its public description
(github.com/ros2/rmw_zenoh, docs/design.md and the token layout in liveliness_utils, Jazzy to Kilted).
"""

import re
import struct
from dataclasses import dataclass

import xxhash

ADMIN = "@ros2_lv"
# Reliable, volatile, keep the last ten; what rmw takes for granted is left out of the text: reliability, durability,
# history, and times of deadline, lifespan and liveliness.
QOS = "::,10:,:,:,,"


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic that is published.

    Attributes:
        name: As ROS writes it, from the root: "/phalanx/right/joints".
        type_name: "geometry_msgs/msg/PoseArray".
        type_hash: RIHS01_ and 64 hexadecimal digits (REP 2016).
    """

    name: str
    type_name: str
    type_hash: str

    @property
    def dds_type(self) -> str:
        """The type's name as DDS has it: "geometry_msgs::msg::dds_::PoseArray_"."""
        package, kind, name = self.type_name.split("/")
        return f"{package}::{kind}::dds_::{name}_"

    def key(self, domain: int) -> str:
        """Where its messages are put."""
        return f"{domain}/{self.name.strip('/')}/{self.dds_type}/{self.type_hash}"


@dataclass(frozen=True, slots=True)
class Node:
    """The node that publishes.

    Attributes:
        domain: ROS_DOMAIN_ID.
        zid: Id of the zenoh session, as zenoh writes it.
        namespace: "/" or "/some/name".
        name: Of the node.
    """

    domain: int
    zid: str
    namespace: str
    name: str

    def token(self) -> str:
        """Its liveliness token; the first entity of the session."""
        return f"{self._place(0, 'NN')}/{_plain(self.namespace)}/{self.name}"

    def publisher_token(self, number: int, topic: Topic) -> str:
        """That of its publisher `number`, from 1, of a topic."""
        where = f"{self._place(number, 'MP')}/{_plain(self.namespace)}/{self.name}"
        return f"{where}/{_plain(topic.name)}/{topic.dds_type}/{topic.type_hash}/{QOS}"

    def _place(self, number: int, kind: str) -> str:
        return f"{ADMIN}/{self.domain}/{self.zid}/0/{number}/{kind}/%"


def gid_of(token: str) -> bytes:
    """Return the id (16 bytes) of the entity with this token.

    Its XXH3 hash of 128 bits, lower half first, little-endian.
    """
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def attachment(number: int, t_ns: int, gid: bytes) -> bytes:
    """Return the attachment of a message.

    Its number, when it was sent [ns since 1970], and the publisher's gid.
    """
    gid_bytes = 16
    return struct.pack("<qqB", number, t_ns, gid_bytes) + gid


def ros_name(name: str) -> str:
    """Return `name` as a valid part of a ROS name.

    Letters, digits and underscores, no digit first.
    """
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{plain}" if plain[:1].isdigit() else plain


def _plain(name: str) -> str:
    return name.replace("/", "%")

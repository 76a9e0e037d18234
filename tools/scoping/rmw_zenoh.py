"""How ROS 2 nodes find and understand each other over zenoh, without ROS 2: names, types, tokens, attachments.

The wire format of rmw_zenoh_cpp (ROS 2 Jazzy to Kilted, with zenoh 1.x): a topic or service has the key
`<domain>/<fully qualified name>/<type>/<type hash>`; each publisher, subscription and service declares a liveliness
token below `@ros2_lv`, from which every node makes its picture of the graph; every message and call carries an
attachment of sequence number, source timestamp and the 16 bytes (gid) that its sender is known by.  Bodies are CDR.

Types and hashes come from `rosbags`; services are composed here as ROS 2 does for their hash.
"""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from xxhash import xxh3_128_intdigest

JOINT_STATE = "sensor_msgs/msg/JointState"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
SET_POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
TRIGGER = "std_srvs/srv/Trigger"

ADMIN_SPACE = "@ros2_lv"
NODE, PUBLISHER, SUBSCRIPTION, SERVICE = "NN", "MP", "MS", "SS"
QOS = "::,10:,:,:,,"  # what differs from rmw_zenoh's default: reliable, volatile, keep the last 10
_ATTACHMENT = struct.Struct("<qqB16s")  # zenoh's serialization: two int64, a sequence with its length
_GID_BYTES = 16


def type_store() -> Typestore:
    """The messages of ROS 2, and std_srvs/srv/Trigger with the parts that its hash is made of."""
    store = get_typestore(Stores.ROS2_JAZZY)
    info, request, response, event = (
        "service_msgs/msg/ServiceEventInfo", f"{TRIGGER}_Request", f"{TRIGGER}_Response", f"{TRIGGER}_Event"
    )  # fmt: skip
    # `char` of a message file is uint8 for everything behind the parser of ROS 2, the hash too
    gid = (Nodetype.ARRAY, ((Nodetype.BASE, ("uint8", 0)), _GID_BYTES))
    fields: dict[str, Any] = {
        info: [(name, gid if name == "client_gid" else kind) for name, kind in store.fielddefs[info][1]],
        request: [],
        response: [("success", (Nodetype.BASE, ("bool", 0))), ("message", (Nodetype.BASE, ("string", 0)))],
        event: [
            ("info", (Nodetype.NAME, info)),
            ("request", (Nodetype.SEQUENCE, ((Nodetype.NAME, request), 1))),
            ("response", (Nodetype.SEQUENCE, ((Nodetype.NAME, response), 1))),
        ],
        TRIGGER: [
            ("request_message", (Nodetype.NAME, request)),
            ("response_message", (Nodetype.NAME, response)),
            ("event_message", (Nodetype.NAME, event)),
        ],
    }
    del store.fielddefs[info]
    store.register({name: ([], found) for name, found in fields.items()})
    return store


def dds_type(ros_type: str) -> str:
    """`sensor_msgs::msg::dds_::JointState_` of sensor_msgs/msg/JointState."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def gid_of(token: str) -> bytes:
    """Of an endpoint: the hash of its liveliness token."""
    return xxh3_128_intdigest(token.encode()).to_bytes(_GID_BYTES, "little")


@dataclass(frozen=True)
class Endpoint:
    """Where a topic or service is, how its endpoint is announced, and by what it is known."""

    key: str
    token: str
    gid: bytes


@dataclass(frozen=True)
class Node:
    """A node without a namespace, in a session of its own."""

    domain: int
    session: str  # zenoh's id of the session, in hexadecimal digits
    name: str

    @property
    def token(self) -> str:
        """That of the node itself."""
        return self._token(0, NODE)

    def _token(self, number: int, kind: str) -> str:
        place = f"{ADMIN_SPACE}/{self.domain}/{self.session}/0/{number}/{kind}"
        return f"{place}/%/%/{self.name}"  # no enclave, no namespace

    def endpoint(self, number: int, kind: str, name: str, types: tuple[str, str]) -> Endpoint:
        """The `number`th endpoint of the node; `types`: the type of ROS 2, and its hash."""
        dds, type_hash = dds_type(types[0]), types[1]
        token = f"{self._token(number, kind)}/{_mangled(name)}/{dds}/{type_hash}/{QOS}"
        return Endpoint(f"{self.domain}/{name.strip('/')}/{dds}/{type_hash}", token, gid_of(token))


def attachment(sequence: int, gid: bytes) -> bytes:
    """Of a message sent now; of a reply with the request's own sequence number and gid."""
    return _ATTACHMENT.pack(sequence, time.time_ns(), _GID_BYTES, gid)


def read_attachment(data: bytes) -> tuple[int, bytes] | None:
    """Sequence number and gid; None for what is no attachment of ROS 2."""
    if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
        return None
    sequence, _, _, gid = _ATTACHMENT.unpack(data)
    return sequence, gid


def node_of(token: str) -> str:
    """`/arm/teleop`, the fully qualified name of the node that a token is of; "" for what is no token."""
    parts = token.split("/")
    if len(parts) < 9 or parts[0] != ADMIN_SPACE:
        return ""
    namespace, name = parts[7].replace("%", "/").rstrip("/"), parts[8]
    return f"{namespace}/{name}"

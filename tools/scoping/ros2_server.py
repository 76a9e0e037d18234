"""The ROS 2 node: `python -m jointctl.tools.scoping.ros2_server`, started by --ros2.

Publishes joint_states and /diagnostics, serves ~/stop, and with --allow-remote ~/enable and the set-points of
~/command.  Anyone whom zenoh lets in can send these: the supervisor judges what comes; what is no message is refused
here.
"""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zenoh
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from xxhash import xxh3_128_intdigest

from jointctl.drivers.errors import printable
from jointctl.firmware_py.states import fault_name
from jointctl.tools.recording.ros_messages import JOINT_STATE_TOPIC, SECOND_NS
from jointctl.tools.recording.run_log import ERROR, WARNING, Event
from jointctl.tools.scoping.remote import RemoteOrder
from jointctl.tools.scoping.supervisor_link import NOT_TAKEN, LiveView, WayBack, serve_order
from jointctl.tools.session.display import fault_words, phase_name
from jointctl.tools.session.session_drive import drive_state_name, session_drive
from jointctl.tools.session.set_points import RemoteSetPoint

# --- How ROS 2 nodes find and understand each other over zenoh, without ROS 2: names, types, tokens, attachments ---
# The wire format of rmw_zenoh_cpp (ROS 2 Jazzy to Kilted, with zenoh 1.x): a topic or service has the key
# `<domain>/<fully qualified name>/<type>/<type hash>`; each publisher, subscription and service declares a liveliness
# token below `@ros2_lv`, from which every node makes its picture of the graph; every message and call carries an
# attachment of sequence number, source timestamp and the 16 bytes (gid) that its sender is known by.  Bodies are CDR.
#
# Types and hashes come from `rosbags`; services are composed here as ROS 2 does for their hash.


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
        token = f"{self._token(number, kind)}/{name.replace('/', '%')}/{dds}/{type_hash}/{QOS}"
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


# --- The node ---


ROUTER_AT = "tcp/localhost:7447"  # where every ROS 2 node looks for its router
DIAGNOSTICS_S = 1.0
MOST_NODES = 4096  # that are remembered by name
_OK, _WARN, _ERROR = 0, 1, 2  # levels of diagnostic_msgs/msg/DiagnosticStatus
WAITING = "approved at the terminal; the next call of ~/enable moves the joint"
NO_CALL = "not taken: it is no call of this service by a ROS 2 node"
NOT_WAITING = "nothing waits for it: it enables once, after the approval at the terminal"


def session_config(listen: str) -> zenoh.Config:
    """A peer as rmw_zenoh's nodes are: it looks for the router of this computer, and for no one by multicast."""
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": [listen],
        "connect/endpoints": [ROUTER_AT],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,  # in the background, again and again
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Ros2View:
    """See `Publisher`; and what other nodes may do."""

    def __init__(self, order: RemoteOrder) -> None:
        self._order = order
        self._types = type_store()
        self.view = LiveView(self, order.names)
        self.way = WayBack(order, self.view, self._refused)
        self._session = zenoh.open(session_config(order.place))
        self._node = Node(order.domain, str(self._session.info.zid()), order.joint)
        self._kept: list[object] = []  # what zenoh takes back when it is dropped
        self._count, self._told_s = 0, 0.0
        self._drive = session_drive(order.drive)
        self._problems: dict[str, tuple[int, str]] = {}  # the newest warning or error, of each joint that had one
        self._refusal = ""
        self._names: dict[bytes, str] = {}
        self._first: dict[str, bytes] = {}  # the endpoint whose set-points first came under a name
        self._lock = threading.Lock()
        self._keep(self._session.liveliness().declare_token(self._node.token))
        self._put_states = self._publisher(JOINT_STATE_TOPIC.name, JOINT_STATE)
        self._put_diagnostics = self._publisher("/diagnostics", DIAGNOSTICS)
        if not order.only_states:
            self._serve("stop", self._stop)
        if order.allow_remote:
            self._serve("enable", self._enable, by_node=True)
            self._follow()

    # --- endpoints ---

    def _keep(self, declared: object) -> None:
        self._kept.append(declared)

    def _endpoint(self, kind: str, name: str, ros_type: str) -> Endpoint:
        self._count += 1
        found = self._node.endpoint(self._count, kind, name, (ros_type, self._types.hash_rihs01(ros_type)))
        self._keep(self._session.liveliness().declare_token(found.token))
        return found

    def _publisher(self, name: str, ros_type: str) -> Callable[[bytes], None]:
        endpoint = self._endpoint(PUBLISHER, name, ros_type)
        publisher = self._session.declare_publisher(endpoint.key, congestion_control=zenoh.CongestionControl.DROP)
        self._keep(publisher)
        sent = 0

        def put(body: bytes) -> None:
            nonlocal sent
            sent += 1
            publisher.put(body, attachment=attachment(sent, endpoint.gid))

        return put

    def _serve(self, name: str, answer: Callable[[str], tuple[bool, str]], *, by_node: bool = False) -> None:
        """`by_node`: only a node's call counts, and no query for many keys, as of a tool that looks what is there."""
        endpoint = self._endpoint(SERVICE, f"/{self._order.joint}/{name}", TRIGGER)
        response = self._types.types[f"{TRIGGER}_Response"]

        def call(query: zenoh.Query) -> None:
            found = read_attachment(query.attachment.to_bytes()) if query.attachment is not None else None
            success, message = False, NO_CALL
            if not by_node or (found is not None and str(query.key_expr) == endpoint.key):
                success, message = answer(self._name_of(found))
            body = self._types.serialize_cdr(response(success=success, message=message), f"{TRIGGER}_Response")
            given = attachment(*found) if found is not None else None
            query.reply(endpoint.key, bytes(body), attachment=given)
            query.drop()  # type: ignore[no-untyped-call]  # the caller waits until then

        self._keep(self._session.declare_queryable(endpoint.key, call, complete=True))

    def _follow(self) -> None:
        """Set-points, and who there is to send them."""
        endpoint = self._endpoint(SUBSCRIPTION, f"/{self._order.joint}/command", SET_POINT)
        self._keep(self._session.declare_subscriber(endpoint.key, self._on_command))
        tokens = f"{ADMIN_SPACE}/{self._order.domain}/**"
        self._keep(self._session.liveliness().declare_subscriber(tokens, self._on_token, history=True))

    # --- what other nodes ask for ---

    def _on_token(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT and (name := printable(node_of(token))):
            with self._lock:
                if len(self._names) < MOST_NODES:
                    self._names.setdefault(gid_of(token), f"ROS 2 node {name[:80]}")

    def _name_of(self, found: tuple[int, bytes] | None) -> str:
        """The same from the first message on, whatever is announced later."""
        if found is None:
            return "a program without a ROS 2 name"
        gid = found[1]
        with self._lock:
            name = self._names.get(gid, f"ROS 2 endpoint {gid.hex()[:8]}")
            if len(self._names) < MOST_NODES:
                self._names[gid] = name
        return name

    def _source_of(self, found: tuple[int, bytes] | None) -> str:
        """Two nodes of one name, such as a program that was started twice, are two sources."""
        who = self._name_of(found)
        if found is None:
            return who
        with self._lock:
            if len(self._first) < MOST_NODES:
                self._first.setdefault(who, found[1])
            same = self._first.get(who, found[1]) == found[1]
        return who if same else f"{who} ({found[1].hex()[:8]})"

    def _on_command(self, sample: zenoh.Sample) -> None:
        found = read_attachment(sample.attachment.to_bytes()) if sample.attachment is not None else None
        who = self._source_of(found)
        try:
            point: Any = self._types.deserialize_cdr(sample.payload.to_bytes(), SET_POINT)
            self.way.set_point(set_point_of(who, point, len(self._order.names)))
        except Exception as error:  # whatever comes, the node goes on
            self._refused(who, f"not understood: {printable(str(error))[:200] or type(error).__name__}")

    def _refused(self, who: str, words: str) -> None:
        self._refusal = f"set-point of {who} refused: {words}"

    def _stop(self, who: str) -> tuple[bool, str]:
        return self.way.stop(who)

    def _enable(self, who: str) -> tuple[bool, str]:
        if self.view.settings.get("stage") != "approved":
            return False, NOT_WAITING
        self.view.settings["stage"] = "enable asked for"  # once
        taken = self.way.ask("enable", who, {name: self.view.settings.get(name) for name in ("number", "told_s")})
        return taken, "enabling" if taken else NOT_TAKEN

    # --- Publisher ---

    def states(self, records: np.ndarray, body: bytes, wall_ns: int) -> None:
        self._put_states(body)
        now_s = time.monotonic()
        if now_s - self._told_s >= DIAGNOSTICS_S:
            self._told_s = now_s
            self._put_diagnostics(self._diagnostics(records, wall_ns))

    def event(self, event: Event, body: bytes, wall_ns: int) -> None:
        """See `Publisher`: the newest warning or error is in the diagnostics, of an arm in those of its joint."""
        if event.level >= WARNING:
            joint, _, text = event.text.partition(": ")
            names = self._order.names
            whose, text = ((joint,), text) if joint in names else (names, event.text)
            found = (_ERROR if event.level >= ERROR else _WARN, f"{event.source}: {text}")
            self._problems |= dict.fromkeys(whose, found)

    def settings(self) -> None:
        """See `Publisher`: they are in the diagnostics, also before the loop has records."""
        if self.view.settings.get("stage") == "approved":
            self._put_diagnostics(self._diagnostics([None] * len(self._order.names), time.time_ns()))

    def _diagnostics(self, records: Sequence[np.void | None] | np.ndarray, wall_ns: int) -> bytes:
        types = self._types.types
        sec, nanosec = divmod(wall_ns, SECOND_NS)
        found = types[DIAGNOSTICS](
            header=types["std_msgs/msg/Header"](
                stamp=types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec), frame_id=""
            ),
            status=[self._status(name, record) for name, record in zip(self._order.names, records, strict=True)],
        )
        return bytes(self._types.serialize_cdr(found, DIAGNOSTICS))

    def _status(self, name: str, record: np.void | None) -> Any:
        """Of one joint; without a record it waits to be enabled."""
        if record is None:
            return self._shown(name, _OK, WAITING, {"newest refusal": self._refusal})
        order, settings = self._order, self.view.settings
        fault, (level, problem) = int(record["fault"]), self._problems.get(name, (_OK, ""))
        values: dict[str, object] = {
            "position_rad": f"{record['position_rad']:.6g}",
            "torque_Nm": f"{record['measured_torque_Nm']:.6g}",
        }
        message = problem or "ok"
        if not order.only_states:
            drive = drive_state_name(self._drive, int(record["status_word"]), int(record["drive_state"]))
            phase = phase_name(int(record["phase"]))
            values |= {"phase": phase, "drive": drive, "fault": fault_name(fault) if fault else "none"}
            values |= {"motion": settings.get("motion"), "temperature_degC": settings.get("temperature_degC")}
            values |= {"newest event": problem, "newest refusal": self._refusal}
            values |= {"skipped": settings.get("skipped")}  # cycles since the start
            level = _ERROR if fault else level
            message = f"{phase}: {fault_words(fault)}" if fault else phase
        return self._shown(name, level, message, values)

    def _shown(self, name: str, level: int, message: str, values: Mapping[str, object]) -> Any:
        types = self._types.types
        pair, status = types["diagnostic_msgs/msg/KeyValue"], types["diagnostic_msgs/msg/DiagnosticStatus"]
        shown = [pair(key=key, value=str(value)) for key, value in values.items() if value not in (None, "")]
        return status(level=level, name=f"{self._order.joint}: {name}", message=message, hardware_id="", values=shown)


def set_point_of(who: str, point: Any, joints: int = 1) -> RemoteSetPoint:
    """Of a JointTrajectoryPoint of all joints; a time of zero is none.  `ValueError` tells what is wrong."""
    given: dict[str, list[float] | None] = {}
    whose = "one joint" if joints == 1 else f"{joints} joints"
    for name, least in (("positions", joints), ("velocities", 0), ("accelerations", 0), ("effort", 0)):
        values = np.asarray(getattr(point, name), float)
        if len(values) not in (least, joints):
            wanted = str(joints) if least else f"0 or {joints}"
            raise ValueError(f"{name} has {len(values)} values, must have {wanted}: {whose}")
        given[name] = values.tolist() or None
    time_s = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
    assert given["positions"] is not None
    return RemoteSetPoint(
        who, given["positions"], given["velocities"], given["accelerations"], given["effort"], time_s or None
    )


def serve(order: RemoteOrder) -> None:
    """Until the run ends."""
    zenoh.init_log_from_env_or("off")
    way = Ros2View(order).way
    way.ready()
    way.run()


if __name__ == "__main__":
    sys.exit(serve_order(serve))

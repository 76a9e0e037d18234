"""A ROS 2 node on zenoh as rmw_zenoh's are, put together without our code, without rosbags and without ROS 2.

Type hashes are those that ROS 2 itself generates (`...__get_type_hash` in the C code of the messages); bodies go
through `mcap_ros2`; attachments through zenoh's own serializer, which rmw_zenoh uses.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, Self

import xxhash
import zenoh
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from zenoh.ext import Int64, UInt8, z_deserialize, z_serialize

from tests.python_process import eventually

_TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = f"MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{'=' * 80}\n{_TIME}"
_LINE = "=" * 80 + "\n"
JOINT_STATE = "sensor_msgs/msg/JointState"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
SET_POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
TRIGGER = "std_srvs/srv/Trigger"
DEFINITIONS = {
    JOINT_STATE: "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    f"{_LINE}{_HEADER}",
    DIAGNOSTICS: f"std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n{_LINE}"
    "MSG: diagnostic_msgs/DiagnosticStatus\nbyte level\nstring name\nstring message\nstring hardware_id\n"
    f"diagnostic_msgs/KeyValue[] values\n{_LINE}MSG: diagnostic_msgs/KeyValue\nstring key\nstring value\n{_LINE}"
    f"{_HEADER}",
    SET_POINT: "float64[] positions\nfloat64[] velocities\nfloat64[] accelerations\nfloat64[] effort\n"
    f"builtin_interfaces/Duration time_from_start\n{_LINE}"
    "MSG: builtin_interfaces/Duration\nint32 sec\nuint32 nanosec\n",
    f"{TRIGGER}_Response": "bool success\nstring message\n",
}
HASHES = {
    JOINT_STATE: "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    DIAGNOSTICS: "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    SET_POINT: "RIHS01_de8907036d8bd45aac6f30cc9044a3d4a329c42cbf719aff7d95a584cfa532d7",
    TRIGGER: "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}
EMPTY_REQUEST = bytes.fromhex("0001000000")  # header, and the byte that a message without fields has
QOS = "::,10:,:,:,,"


def key(domain: int, name: str, ros_type: str) -> str:
    package, kind, word = ros_type.split("/")
    return f"{domain}/{name.strip('/')}/{package}::{kind}::dds_::{word}_/{HASHES[ros_type]}"


def decoded(ros_type: str, body: bytes) -> Any:
    return generate_dynamic(ros_type, DEFINITIONS[ros_type])[ros_type](body)


class Ros2Client:
    """Node /NAME in the domain, connected to one endpoint."""

    def __init__(self, endpoint: str, name: str = "teleop", domain: int = 0, timeout_s: float = 30.0) -> None:
        config = zenoh.Config()
        for path, value in {
            "mode": "peer", "connect/endpoints": [endpoint], "listen/endpoints": [], "connect/timeout_ms": -1,
            "scouting/multicast/enabled": False,
        }.items():  # fmt: skip
            config.insert_json5(path, json.dumps(value))
        self.session, self.domain, self.name = zenoh.open(config), domain, name
        self._gid, self._sent = bytes(range(16)), 0
        self.commands = "/joint/command"
        eventually(lambda: list(self.session.info.peers_zid()), timeout_s)

    def tokens(self) -> list[str]:
        """Everything that is in the graph."""
        replies = self.session.liveliness().get(f"@ros2_lv/{self.domain}/**", timeout=5.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def collect(self, name: str, ros_type: str, take: Callable[[Any, tuple[int, int, bytes]], None]) -> None:
        """Each message of a topic and its attachment: sequence number, source timestamp, gid."""

        def on_sample(sample: zenoh.Sample) -> None:
            assert sample.attachment is not None
            take(decoded(ros_type, sample.payload.to_bytes()), self.attached(sample.attachment))

        self._subscriber = self.session.declare_subscriber(key(self.domain, name, ros_type), on_sample)

    @staticmethod
    def attached(attachment: zenoh.ZBytes) -> tuple[int, int, bytes]:
        sequence, stamp_ns, gid = z_deserialize(tuple[Int64, Int64, list[UInt8]], attachment)
        return sequence, stamp_ns, bytes(gid)

    def _attachment(self) -> zenoh.ZBytes:
        self._sent += 1
        return z_serialize((Int64(self._sent), Int64(time.time_ns()), [UInt8(byte) for byte in self._gid]))

    def anonymous(self, gid: bytes) -> None:
        """Publish under this gid from now on, which no token tells of."""
        self._gid = gid

    def announce(self) -> None:
        """Publish to /joint/command by a token, as a node of ROS 2 does, and under the gid that goes with it."""
        where = key(self.domain, "x", SET_POINT).split("/", 2)[2]
        node = f"@ros2_lv/{self.domain}/{self.session.info.zid()}/0/1/MP/%/%/{self.name}"
        token = f"{node}/%joint%command/{where}/{QOS}"
        self._token = self.session.liveliness().declare_token(token)
        digest = xxhash.xxh3_128_digest(token.encode())
        self._gid = digest[8:][::-1] + digest[:8][::-1]  # low half first, each little-endian

    def command(self, body: bytes | None = None, **fields: Any) -> None:
        """A set-point, or whatever `body` is, to `self.commands`."""
        if body is None:
            time_s = fields.pop("time_s", 0.0)
            sec, nanosec = int(time_s), round(time_s % 1.0 * 1e9) % 1_000_000_000
            values = {"positions": [], "velocities": [], "accelerations": [], "effort": [], **fields}
            values["time_from_start"] = {"sec": sec, "nanosec": nanosec}
            body = bytes(serialize_dynamic(SET_POINT, DEFINITIONS[SET_POINT])[SET_POINT](values))
        self.session.put(key(self.domain, self.commands, SET_POINT), body, attachment=self._attachment())

    def call(self, name: str) -> tuple[bool, str]:
        """A service without arguments; its reply belongs to this very request."""
        replies = list(
            self.session.get(
                key(self.domain, name, TRIGGER), payload=EMPTY_REQUEST, attachment=self._attachment(), timeout=5.0
            )
        )
        assert len(replies) == 1, name
        assert replies[0].ok is not None
        assert replies[0].ok.attachment is not None
        sequence, _, gid = self.attached(replies[0].ok.attachment)
        assert (sequence, gid) == (self._sent, self._gid)
        answer = decoded(f"{TRIGGER}_Response", replies[0].ok.payload.to_bytes())
        return answer.success, answer.message

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

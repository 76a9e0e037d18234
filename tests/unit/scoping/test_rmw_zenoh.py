"""Hashes, keys, tokens and attachments of ROS 2, each by an implementation that is not the one in use."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from zenoh.ext import Int64, UInt8, z_serialize

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.tools.recording.ros_messages import JOINT_STATE_TOPIC
from jointctl.tools.recording.run_log import ERROR, INFO, WARNING, Event
from jointctl.tools.scoping import ros2_server as ros
from jointctl.tools.scoping.remote import RemoteOrder
from jointctl.tools.scoping.ros2_server import session_config, set_point_of
from jointctl.tools.session.set_points import RemoteSetPoint
from tests.ros2_client import DEFINITIONS, DIAGNOSTICS, HASHES, JOINT_STATE, SET_POINT, TRIGGER, key

STORE = ros.type_store()


@pytest.mark.parametrize("ros_type", HASHES)
def test_type_hashes_are_those_of_ros_2(ros_type: str) -> None:
    assert STORE.hash_rihs01(ros_type) == HASHES[ros_type]


@pytest.mark.parametrize("ros_type", HASHES)
def test_and_those_of_another_library(ros_type: str) -> None:
    description = pytest.importorskip("ros2_pyterfaces.core.description")
    package, kind, name = ros_type.split("/")
    module = pytest.importorskip(f"ros2_pyterfaces.core.{package}.{kind}")
    assert description.hash_rihs01(getattr(module, name)) == HASHES[ros_type]


def test_keys_and_tokens() -> None:
    node = ros.Node(7, "a0b1", "my_joint")
    assert node.token == "@ros2_lv/7/a0b1/0/0/NN/%/%/my_joint"
    found = node.endpoint(3, ros.SERVICE, "/my_joint/stop", (TRIGGER, HASHES[TRIGGER]))
    assert found.key == key(7, "/my_joint/stop", TRIGGER)
    assert found.token == (
        "@ros2_lv/7/a0b1/0/3/SS/%/%/my_joint/%my_joint%stop/std_srvs::srv::dds_::Trigger_/"
        f"{HASHES[TRIGGER]}/::,10:,:,:,,"
    )
    assert ros.node_of(found.token) == "/my_joint"
    assert ros.node_of(found.token.replace("/%/%/", "/%/%left%arm/")) == "/left/arm/my_joint"
    assert ros.node_of("@ros2_lv/7/a0b1") == ros.node_of("a/b/c/d/e/f/g/h/i") == ""


def test_and_those_of_a_robot_makers_client() -> None:
    entity, keys = (pytest.importorskip(f"zenoh_ros2_sdk.{name}") for name in ("entity", "keyexpr"))
    theirs = entity.NodeEntity(domain_id=7, session_id="a0b1", node_id=0, node_name="my_joint")
    ours = ros.Node(7, "a0b1", "my_joint")
    assert keys.node_liveliness_keyexpr(theirs) == ours.token
    for number, (kind, name, ros_type) in enumerate(
        [(ros.PUBLISHER, "/joint_states", JOINT_STATE), (ros.SUBSCRIPTION, "/my_joint/command", SET_POINT)], 1
    ):
        found = ours.endpoint(number, kind, name, (ros_type, HASHES[ros_type]))
        endpoint = entity.EndpointEntity(
            theirs, number, entity.EntityKind(kind), name, ros.dds_type(ros_type), HASHES[ros_type], ros.QOS
        )
        assert keys.endpoint_liveliness_keyexpr(endpoint) == found.token
        assert keys.topic_keyexpr(7, name, ros.dds_type(ros_type), HASHES[ros_type]) == found.key


def test_a_gid_is_the_hash_of_the_token() -> None:
    # XXH3, 128 bits, seed 0, of the empty input, from the test vectors of xxHash; low half first, little-endian
    low, high = 0x6001C324468D497F, 0x99AA06D3014798D8
    assert ros.gid_of("") == low.to_bytes(8, "little") + high.to_bytes(8, "little")


def test_attachments_are_what_zenohs_serializer_makes() -> None:
    gid = bytes(range(16))
    body = ros.attachment(5, gid)
    stamp_ns = int.from_bytes(body[8:16], "little")
    theirs = z_serialize((Int64(5), Int64(stamp_ns), [UInt8(byte) for byte in gid])).to_bytes()
    assert body == theirs
    assert ros.read_attachment(theirs) == (5, gid)


@pytest.mark.parametrize("data", [b"", b"x" * 33, bytes(32), bytes(34)])
def test_what_is_no_attachment(data: bytes) -> None:
    assert ros.read_attachment(data) is None


def test_the_definition_of_joint_states_is_that_of_ros_2() -> None:
    ours = generate_dynamic(JOINT_STATE, JOINT_STATE_TOPIC.definition)[JOINT_STATE]
    values = {
        "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": ""},
        "name": ["joint"], "position": [0.5], "velocity": [1.5], "effort": [-2.5],
    }  # fmt: skip
    body = bytes(serialize_dynamic(JOINT_STATE, DEFINITIONS[JOINT_STATE])[JOINT_STATE](values))
    found, theirs = ours(body), STORE.deserialize_cdr(body, JOINT_STATE)
    assert (found.name, found.position, found.effort) == (["joint"], [0.5], [-2.5])
    assert bytes(STORE.serialize_cdr(theirs, JOINT_STATE)) == body


def point_of(time_s: float = 0.0, **fields: list[float]) -> RemoteSetPoint:
    values = {"positions": [], "velocities": [], "accelerations": [], "effort": [], **fields}
    values["time_from_start"] = {"sec": int(time_s), "nanosec": round(time_s % 1.0 * 1e9)}  # type: ignore[assignment]
    body = bytes(serialize_dynamic(SET_POINT, DEFINITIONS[SET_POINT])[SET_POINT](values))
    return set_point_of("a node", STORE.deserialize_cdr(body, SET_POINT))


def test_set_points_of_ros_2() -> None:
    assert point_of(positions=[0.1]) == RemoteSetPoint("a node", [0.1])
    full = point_of(1.5, positions=[0.1], velocities=[0.2], accelerations=[0.3], effort=[4.0])
    assert full == RemoteSetPoint("a node", [0.1], [0.2], [0.3], [4.0], 1.5)


@pytest.mark.parametrize("fields", [{}, {"positions": [0.1, 0.2]}, {"positions": [0.1], "velocities": [0.1, 0.2]}])
def test_a_set_point_is_for_one_joint(fields: dict[str, list[float]]) -> None:
    with pytest.raises(ValueError, match="one joint"):
        point_of(**fields)


def test_zenoh_stays_on_this_computer_and_looks_for_no_one_by_multicast() -> None:
    config = session_config("tcp/127.0.0.1:0")
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/127.0.0.1:0"]
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/localhost:7447"]
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False


def test_the_diagnostics_of_an_arm_tell_of_each_joint_what_happened_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    bodies: list[bytes] = []
    monkeypatch.setattr(ros.Ros2View, "_publisher", lambda _, name, __: bodies.append if "diag" in name else id)
    monkeypatch.setattr(ros, "WayBack", lambda *_: None)
    view = ros.Ros2View(RemoteOrder("arm", "arm", ("shoulder", "elbow"), "canopen", "tcp/127.0.0.1:0"))
    with contextlib.closing(view._session):
        for event in (
            Event(0, WARNING, "loop", "shoulder: held up: 13 cycles skipped"),
            Event(0, ERROR, "drive", "elbow: EMCY 5000h: hardware"),
            Event(0, INFO, "loop", "shoulder: ramping"),
        ):
            view.event(event, b"", 0)
        view.states(np.asarray(new(LogRecord, 2)), b"", 0)
        view.event(Event(0, WARNING, "bus", "nobody acknowledges"), b"", 0)
        view._told_s = 0.0
        view.states(np.asarray(new(LogRecord, 2)), b"", 0)
    found = [
        [(status.level, {pair.key: pair.value for pair in status.values}["newest event"]) for status in report.status]
        for report in (STORE.deserialize_cdr(body, DIAGNOSTICS) for body in bodies)
    ]
    assert found[0] == [(1, "loop: held up: 13 cycles skipped"), (2, "drive: EMCY 5000h: hardware")]
    assert found[1] == [(1, "bus: nobody acknowledges")] * 2

"""PyPI's `zenoh-ros2-sdk`, a robot maker's ROS 2 client on zenoh, moves the joint; skipped where not installed.

Nothing is fetched: definitions and hashes are given to it.  It speaks to `jointctl run` in a process of its own.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase
from tests.hil.test_ros2 import DOMAIN, Run
from tests.ros2_client import HASHES, JOINT_STATE, SET_POINT, TRIGGER

pytestmark = pytest.mark.skipif(not importlib.util.find_spec("zenoh_ros2_sdk"), reason="zenoh-ros2-sdk is missing")

TIME = "int32 sec\nuint32 nanosec\n"
PROGRAM = f"""
import json, math, os, sys, time
import numpy as np
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber, ZenohSession

place = dict(router_ip="127.0.0.1", router_port=int(sys.argv[1]), domain_id={DOMAIN}, node_name="teleop")
session = ZenohSession.get_instance("127.0.0.1", place["router_port"])
for name in ("Time", "Duration"):
    session.register_message_type({TIME!r}, "builtin_interfaces/msg/" + name)
session.register_message_type("builtin_interfaces/Time stamp\\nstring frame_id\\n", "std_msgs/msg/Header")
states = []
ROS2Subscriber(
    "/joint_states", "{JOINT_STATE}", states.append, type_hash="{HASHES[JOINT_STATE]}", **place,
    msg_definition="std_msgs/Header header\\nstring[] name\\nfloat64[] position\\nfloat64[] velocity\\n"
    "float64[] effort\\n",
)
commands = ROS2Publisher(
    "/joint/command", "{SET_POINT}", type_hash="{HASHES[SET_POINT]}", **place,
    msg_definition="float64[] positions\\nfloat64[] velocities\\nfloat64[] accelerations\\nfloat64[] effort\\n"
    "builtin_interfaces/Duration time_from_start\\n",
)
enable, stop = (
    ROS2ServiceClient(
        "/joint/" + name, "{TRIGGER}", request_definition="", response_definition="bool success\\nstring message\\n",
        type_hash="{HASHES[TRIGGER]}", **place,
    )
    for name in ("enable", "stop")
)
duration, none = session.store.types["builtin_interfaces/msg/Duration"], np.zeros(0)
while not enable.call().success:
    time.sleep(0.1)
time.sleep(5.0)
begun_s = time.monotonic()
while (now_s := time.monotonic() - begun_s) < 3.0:
    at_rad = 0.05 * min(now_s, 1.0) ** 2 * math.sin(now_s)
    since = duration(sec=int(now_s + 1.0), nanosec=int(now_s % 1.0 * 1e9))
    commands.publish(
        positions=np.array([at_rad]), velocities=none, accelerations=none, effort=none, time_from_start=since
    )
    time.sleep(0.01)
stopped = stop.call()
print(json.dumps([len(states), list(states[-1].name), stopped.success, stopped.message]), flush=True)
os._exit(0)  # its threads would go on
"""


def test_it_enables_moves_and_stops_the_joint(bench: Any) -> None:
    run = Run(bench, "--hold", "--allow-remote")
    run.program.saw("waiting up to")
    (bench.folder / "client.py").write_text(PROGRAM)
    client = bench.start(run.endpoint.rpartition(":")[2], script=bench.folder / "client.py").finished(60.0)
    assert '["joint"], true, "STOP taken; again: quick stop"]' in client.out, client.err
    log = run.ended()
    tracking = log.records[log.records.phase == AxisPhase.TRACKING]
    assert np.ptp(tracking.desired_position_rad) > 0.03
    assert "set-points come from ROS 2 " in "\n".join(event.text for event in log.events)

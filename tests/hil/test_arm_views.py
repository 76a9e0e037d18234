"""An arm with Foxglove and ROS 2 beside it: the states of all joints, set-points of all, one STOP."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from jointctl.firmware_py.states import AxisPhase, Fault
from tests.browser import PROGRAM, Browser, free_port
from tests.foxglove_client import FoxgloveClient
from tests.hil.test_arm_run import NAMES, ArmBench
from tests.hil.test_foxglove import decoded
from tests.hil.test_python_arm import PATIENT
from tests.hil.test_scope_browser import environment, moves, printed_address, state_is
from tests.python_process import eventually
from tests.ros2_client import DIAGNOSTICS, JOINT_STATE, Ros2Client

DOMAIN = 7
START_rad = 0.1  # virtual.initial_position_rad of all


@pytest.fixture
def arm(bench: Any) -> ArmBench:
    return ArmBench(bench, PATIENT)


def targets(now_s: float) -> list[float]:
    """From rest; each joint its own way."""
    share = min(now_s, 1.0) ** 2
    return [START_rad + way * share * math.sin(now_s) for way in (0.05, -0.04, 0.03)]


def assert_followed(arm: ArmBench) -> None:
    for log, way in zip(arm.logs(), (0.05, -0.04, 0.03), strict=True):
        tracking = log.records[log.records.phase == AxisPhase.TRACKING]
        assert np.ptp(tracking.desired_position_rad) > 0.6 * abs(way)
        assert abs(tracking.error_rad).max() < 0.02


def test_foxglove_has_all_joints_takes_vectors_and_stops_all(arm: ArmBench) -> None:
    port = free_port()
    run = arm.bench.start(
        "run", arm.path, "-y", "--hold", "--foxglove", f"127.0.0.1:{port}", "--allow-remote"
    )  # fmt: skip
    run.saw("  tracking")
    with FoxgloveClient(port) as client:
        client.subscribe("/joint_states", "/joint/elbow")
        client.set_parameter("control.kp", 1.0)  # an arm has none that a viewer may change
        client.until(lambda: any("does not support parameters" in text for text in client.statuses))
        client.advertise("/arm/command")
        client.publish({"position_rad": [START_rad, 5.0, START_rad]})
        client.until(lambda: any("elbow: position_rad (=5) must be in [" in text for text in client.statuses))
        client.publish({"position_rad": [START_rad]})
        client.until(lambda: any("must have 3, one a joint" in text for text in client.statuses))
        begun_s = time.monotonic()
        while (now_s := time.monotonic() - begun_s) < 2.0:
            client.publish({"position_rad": targets(now_s), "time_s": 1.0 + now_s})
            time.sleep(0.02)
        client.until(lambda: any(name == "/joint/elbow" for name, _, _ in client.messages))
        state = decoded(client, "/joint_states", client.newest("/joint_states"))
        assert list(state.name) == list(NAMES)
        assert client.call("/arm/stop")["success"]
    done = run.finished(60.0)
    assert done.code == 130, done.err
    assert arm.all_off()
    assert_followed(arm)
    first = max(arm.bench.folder.glob("runs/*.shoulder.mcap"))
    with first.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        logged = [message for *_, message in reader.iter_decoded_messages(["/joint_states"])]
    assert len(logged) > 200
    assert {tuple(state.name) for state in logged} == {NAMES}
    positions = np.array([state.position for state in logged])
    for column, log in zip(positions.T, arm.logs(), strict=True):
        assert np.isin(column, log.records.position_rad).all()


@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this computer")
def test_the_page_shows_the_joint_that_is_chosen_and_stops_all(arm: ArmBench, tmp_path: Path) -> None:
    pytest.importorskip("nicegui")
    run = arm.bench.start(
        "run", arm.path, "-y", "--scope", "--scope-port", str(free_port()), env=environment()
    )  # fmt: skip
    run.saw("  tracking")
    url = printed_address(run)
    with Browser(tmp_path) as browser:
        tab = browser.open(url)
        state_is(tab, "tracking")
        moves(tab)
        assert tab.js("document.querySelector('[data-testid=\"go\"]')") is None  # nothing changes an arm's motion
        tab.click("joint")
        tab.until("[...document.querySelectorAll('.q-item')].some(e => e.innerText == 'wrist')")
        tab.js("[...document.querySelectorAll('.q-item')].find(e => e.innerText == 'wrist').click()")
        tab.until("document.querySelector('[data-testid=\"joint\"]').closest('.q-field').innerText.includes('wrist')")
        moves(tab)
        tab.click("stop")
        done = run.finished(60.0)
    assert done.code == 130, done.err
    assert arm.all_off()


def test_a_ros_2_node_enables_leads_and_leaves_all_joints(arm: ArmBench) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    run = arm.bench.start(
        "run", arm.path, "-y", "--hold", "--ros2", str(DOMAIN), "--ros2-listen", endpoint, "--allow-remote"
    )  # fmt: skip
    states: list[Any] = []
    reports: list[Any] = []
    with Ros2Client(endpoint, "teleop", DOMAIN) as client:
        client.commands = "/arm/command"
        client.collect("/joint_states", JOINT_STATE, lambda state, _: states.append(state))
        client.collect("/diagnostics", DIAGNOSTICS, lambda report, _: reports.append(report))
        run.saw("waiting up to")
        eventually(lambda: client.call("/arm/enable")[0])
        run.saw("  tracking")
        client.command(positions=[START_rad])  # of one joint: for nothing
        begun_s = time.monotonic()
        while (now_s := time.monotonic() - begun_s) < 2.0:
            client.command(positions=targets(now_s), time_s=1.0 + now_s)
            time.sleep(0.01)
        # then it is silent
        done = run.finished(60.0)
    assert done.code == 7, done.err
    assert {int(log.records.fault[-1]) for log in arm.logs()} & {Fault.CLIENT_SILENT}
    assert arm.all_off()
    assert_followed(arm)
    assert {tuple(state.name) for state in states} == {NAMES}
    assert [status.name for status in reports[-1].status] == [f"arm: {name}" for name in NAMES]

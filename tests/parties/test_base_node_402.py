"""The CiA 402 master of the `canopen` library enables, homes and moves the virtual joint in every mode it knows."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from canopen.profiles.p402 import BaseNode402

from jointctl.hil.canopen.records import PowerState


def wait(true: Callable[[], bool], timeout_s: float = 5.0) -> bool:
    give_up_s = time.monotonic() + timeout_s
    while not true():
        if time.monotonic() > give_up_s:
            return False
        time.sleep(0.005)
    return True


@pytest.fixture
def node(joint: Any) -> Iterator[Any]:
    network = joint.network()
    node = BaseNode402(joint.node_id, str(joint.eds))
    network.add_node(node)
    node.nmt.state = "PRE-OPERATIONAL"
    node.sdo[0x1800][5].raw = 20  # ms: the library waits for the statusword as soon as it came twice by itself
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    assert wait(lambda: node.state == "SWITCH ON DISABLED")
    yield node
    network.disconnect()


def test_every_state_that_can_be_asked_for(joint: Any, node: Any) -> None:
    for state in (
        "READY TO SWITCH ON",
        "SWITCHED ON",
        "OPERATION ENABLED",
        "SWITCHED ON",
        "READY TO SWITCH ON",
        "SWITCH ON DISABLED",
        "OPERATION ENABLED",
        "SWITCH ON DISABLED",
    ):
        node.state = state
        assert wait(lambda state=state: node.state == state)
    node.sdo[0x605A].raw = 6
    node.state = "OPERATION ENABLED"
    node.state = "QUICK STOP ACTIVE"
    node.state = "OPERATION ENABLED"  # transition 16
    assert joint.device.device[0].state == PowerState.OPERATION_ENABLED
    for mode in ("VELOCITY", "INTERPOLATED POSITION"):
        with pytest.raises(TypeError, match="not suppported"):
            node.op_mode = mode


def test_a_fault_is_seen_and_reset(joint: Any, node: Any) -> None:
    node.state = "OPERATION ENABLED"
    joint.device.device[0].inject_fault_code = 0x2340
    assert wait(node.is_faulted)
    assert node.emcy.wait(0x2340, 2.0) is not None or node.emcy.log[-1].code == 0x2340
    assert node.sdo[0x1003][1].raw == 0x2340
    joint.device.device[0].inject_fault_code = 0
    node.reset_from_fault()
    assert wait(lambda: node.state == "OPERATION ENABLED")


@pytest.mark.parametrize("method", [33, 34, 35, 37])
def test_homing(joint: Any, node: Any, method: int) -> None:
    node.sdo[0x6098].raw = method
    node.sdo[0x607C].raw = 1234
    assert not node.is_homed()
    assert node.homing(timeout=10)
    assert wait(lambda: abs(node.sdo[0x6064].raw - 1234) < 200)
    assert node.is_homed()


def test_homing_that_fails_is_told(joint: Any, node: Any) -> None:
    node.sdo[0x6098].raw = 0
    assert not node.homing(timeout=5)


def test_profile_position(joint: Any, node: Any) -> None:
    node.op_mode = "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    for target in (20_000, -5_000):
        node.sdo[0x607A].raw = target
        node.controlword = 0x1F
        assert wait(lambda: node.statusword & 0x1000)
        node.controlword = 0x0F
        assert wait(lambda: not node.statusword & 0x1000)
        assert wait(lambda: node.statusword & 0x0400)
        assert node.sdo[0x6064].raw == pytest.approx(target, abs=150)
    node.state = "SWITCH ON DISABLED"


@pytest.mark.parametrize(("mode", "target"), [("PROFILED VELOCITY", 30_000), ("CYCLIC SYNCHRONOUS VELOCITY", -30_000)])
def test_velocity(joint: Any, node: Any, mode: str, target: int) -> None:
    node.op_mode = mode
    node.state = "OPERATION ENABLED"
    node.sdo[0x60FF].raw = target
    assert wait(lambda: node.sdo[0x606C].raw == pytest.approx(target, rel=0.02))
    node.sdo[0x60FF].raw = 0
    assert wait(lambda: abs(node.sdo[0x606C].raw) < 200)


@pytest.mark.parametrize("mode", ["PROFILED TORQUE", "CYCLIC SYNCHRONOUS TORQUE"])
def test_torque(joint: Any, node: Any, mode: str) -> None:
    node.op_mode = mode
    node.state = "OPERATION ENABLED"
    node.sdo[0x6087].raw = 200  # per mille a second
    node.sdo[0x6071].raw = 20
    began_s = time.monotonic()
    assert wait(lambda: node.sdo[0x6077].raw == 20)
    if mode == "PROFILED TORQUE":
        assert time.monotonic() - began_s > 0.08  # the slope: 20 per mille at 200 per mille/s
    assert wait(lambda: node.sdo[0x606C].raw > 500)


def test_cyclic_position_by_pdo_and_sync(joint: Any, node: Any) -> None:
    node.nmt.state = "PRE-OPERATIONAL"
    node.rpdo[4].clear()
    node.rpdo[4].add_variable(0x607A)
    node.rpdo[4].trans_type = 1
    node.rpdo[4].enabled = True
    node.rpdo[4].save()
    node.nmt.state = "OPERATIONAL"
    node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
    node.state = "OPERATION ENABLED"
    for target in range(0, 4001, 40):
        node.rpdo[4][0].raw = target
        node.rpdo[4].transmit()
        node.network.sync.transmit()
        time.sleep(0.002)
    assert wait(lambda: node.sdo[0x6064].raw == pytest.approx(4000, abs=50))


def test_the_program_in_the_documentation(joint: Any) -> None:
    page = (joint.eds.parents[1] / "docs" / "virtual-joint.md").read_text()
    blocks = [part.split("```")[0] for part in page.split("```text\n")[1:]]
    program = next(block for block in blocks if "import canopen" in block)
    for shown, here in (('"virtual0"', repr(joint.channel)), ("(1,", f"({joint.node_id},"), ('"configs/', '"')):
        assert shown in program
        program = program.replace(shown, here, 1)
    names: dict[str, Any] = {}
    exec(program.replace('"virtual_joint.eds"', repr(str(joint.eds))), names)
    try:
        assert wait(lambda: names["node"].sdo[0x606C].raw == pytest.approx(20_000, rel=0.02))
        names["node"].state = "SWITCH ON DISABLED"
    finally:
        names["network"].disconnect()


def test_node_guarding_and_blocks_over_a_real_bus(joint: Any, node: Any) -> None:
    node.nmt.start_node_guarding(0.02)
    assert node.nmt.wait_for_heartbeat(timeout=2.0) == "OPERATIONAL"
    node.nmt.stop_node_guarding()
    text = b"the elbow of the left arm, as its owner calls it " * 5
    with node.sdo.open(0x2100, 0, "wb", size=len(text), block_transfer=True) as stream:
        stream.write(text)
    with node.sdo.open(0x2100, 0, "rb", block_transfer=True) as stream:
        assert stream.read() == text
    assert joint.status & 0x4F == 0x40

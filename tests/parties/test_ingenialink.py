"""PyPI's `ingenialink`, a drive maker's own master, enables and moves the virtual joint; skipped where not installed.

Its servo class works on a node of the `canopen` library and knows a drive by an XML dictionary, written here from the
EDS.  Its network class is left out: it opens the adapters of its own list only (and SocketCAN).
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import canopen
import pytest

TYPES = {2: "s8", 3: "s16", 4: "s32", 5: "u8", 6: "u16", 7: "u32", 9: "str"}
KNOWN = {0x6040: "DRV_STATE_CONTROL", 0x6041: "DRV_STATE_STATUS"}  # the names that the library asks for

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("ingenialink") is None, reason="ingenialink is not installed"),
    pytest.mark.filterwarnings("ignore"),
]


def xml_dictionary(eds: Path, node_id: int) -> str:
    """Every object of the EDS as a register of subnode 1, named like "0x60FF:0"."""
    registers = []
    for item in canopen.import_od(str(eds), node_id=node_id).values():
        for variable in [item] if isinstance(item, canopen.objectdictionary.ODVariable) else item.values():
            name = KNOWN.get(variable.index, f"0x{variable.index:04X}:{variable.subindex}")
            registers.append(
                f'<Register access="{"rw" if variable.writable else "r"}" dtype="{TYPES[variable.data_type]}" '
                f'address="0x{variable.index:04X}{variable.subindex:02X}" address_type="NVM_NONE" subnode="1" '
                f'units="none" id={quoteattr(name)}/>'
            )
    return (
        '<?xml version="1.0"?><IngeniaDictionary><Header><Version>2</Version></Header><Body>'
        '<Device Interface="CAN" firmwareVersion="0.1.0" ProductCode="1" RevisionNumber="65536" PartNumber="joint">'
        f"<Registers>{''.join(registers)}</Registers></Device>"
        '<Errors><Error id="0x2340" affected_module="drive" error_type="cyclic">'
        '<Labels><Label lang="en_US">short circuit</Label></Labels></Error></Errors></Body></IngeniaDictionary>'
    )


@pytest.fixture
def servo(joint: Any, tmp_path: Path) -> Iterator[Any]:
    from ingenialink.canopen.servo import CanopenServo

    path = tmp_path / "joint.xdf"
    path.write_text(xml_dictionary(joint.eds, joint.node_id))
    network = joint.network()
    node = network.add_node(joint.node_id)
    node.nmt.start_node_guarding(0.05)  # as the library's network does
    try:
        yield CanopenServo(joint.node_id, node, str(path))
    finally:
        node.nmt.stop_node_guarding()
        network.disconnect()


def settles(servo: Any, register: str, value: int, tolerance: int) -> bool:
    give_up_s = time.monotonic() + 5.0
    while time.monotonic() < give_up_s:
        if abs(servo.read(register) - value) <= tolerance:
            return True
    return False


def test_enable_move_and_disable(servo: Any) -> None:
    from ingenialink.enums.servo import ServoState

    assert servo.read("0x1008:0") == "jointctl virtual joint"
    assert servo.get_state() == ServoState.DISABLED
    servo.write("0x6060:0", 3)
    servo.enable()  # goes from Ready to Switch On to Operation Enabled with one controlword 0x0F
    assert servo.get_state() == ServoState.ENABLED
    servo.write("0x60FF:0", 25_000)
    assert settles(servo, "0x606C:0", 25_000, 500)
    servo.write("0x60FF:0", 0)
    assert settles(servo, "0x606C:0", 0, 200)
    servo.write("0x6060:0", 10)
    servo.write("0x6071:0", 25)
    assert settles(servo, "0x6077:0", 25, 0)
    servo.write("0x6071:0", 0)
    servo.disable()
    assert servo.get_state() == ServoState.DISABLED


def test_a_fault_is_reset_by_enable_and_refusals_are_told(servo: Any, joint: Any) -> None:
    from ingenialink.enums.servo import ServoState
    from ingenialink.exceptions import ILError

    joint.device.device[0].inject_fault_code = 0x2340
    time.sleep(0.05)
    assert servo.get_state() == ServoState.FAULT
    joint.device.device[0].inject_fault_code = 0
    servo.enable()
    assert servo.get_state() == ServoState.ENABLED
    servo.disable()
    with pytest.raises(ILError, match="0x06090030"):
        servo.write("0x6060:0", 2)

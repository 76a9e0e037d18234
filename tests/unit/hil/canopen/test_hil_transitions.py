"""Every controlword in every state of the virtual drive, against the table of CiA 402-2 (transitions 2 to 16)."""

from __future__ import annotations

import struct

import pytest

from jointctl.hil.canopen.records import PowerState
from tests.virtual_drive import NODE, Rig

S = PowerState
STATES = [
    S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON, S.SWITCHED_ON, S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE,
    S.FAULT_REACTION_ACTIVE, S.FAULT,
]  # fmt: skip
STATUS = {
    S.SWITCH_ON_DISABLED: (0x4F, 0x40), S.READY_TO_SWITCH_ON: (0x6F, 0x21), S.SWITCHED_ON: (0x6F, 0x23),
    S.OPERATION_ENABLED: (0x6F, 0x27), S.QUICK_STOP_ACTIVE: (0x6F, 0x07), S.FAULT_REACTION_ACTIVE: (0x4F, 0x0F),
    S.FAULT: (0x4F, 0x08),
}  # fmt: skip
# bits 3..0 with their mask, as CiA 402-2 writes them
COMMANDS = {
    "shutdown": (0x07, 0x06),
    "switch on": (0x0F, 0x07),
    "enable operation": (0x0F, 0x0F),
    "disable voltage": (0x02, 0x00),
    "quick stop": (0x06, 0x02),
}
LEGAL = {
    (S.SWITCH_ON_DISABLED, "shutdown"): S.READY_TO_SWITCH_ON,  # 2
    (S.READY_TO_SWITCH_ON, "switch on"): S.SWITCHED_ON,  # 3
    (S.READY_TO_SWITCH_ON, "enable operation"): S.OPERATION_ENABLED,  # 3 and 4 at once
    (S.READY_TO_SWITCH_ON, "disable voltage"): S.SWITCH_ON_DISABLED,  # 7
    (S.READY_TO_SWITCH_ON, "quick stop"): S.SWITCH_ON_DISABLED,  # 7
    (S.SWITCHED_ON, "enable operation"): S.OPERATION_ENABLED,  # 4
    (S.SWITCHED_ON, "shutdown"): S.READY_TO_SWITCH_ON,  # 6
    (S.SWITCHED_ON, "disable voltage"): S.SWITCH_ON_DISABLED,  # 10
    (S.SWITCHED_ON, "quick stop"): S.SWITCH_ON_DISABLED,  # 10
    (S.OPERATION_ENABLED, "switch on"): S.SWITCHED_ON,  # 5
    (S.OPERATION_ENABLED, "shutdown"): S.READY_TO_SWITCH_ON,  # 8
    (S.OPERATION_ENABLED, "disable voltage"): S.SWITCH_ON_DISABLED,  # 9
    (S.OPERATION_ENABLED, "quick stop"): S.QUICK_STOP_ACTIVE,  # 11
    (S.QUICK_STOP_ACTIVE, "disable voltage"): S.SWITCH_ON_DISABLED,  # 12
    (S.QUICK_STOP_ACTIVE, "enable operation"): S.OPERATION_ENABLED,  # 16, with 605A = 5
}


@pytest.fixture(scope="module")
def rig() -> Rig:
    made = Rig(step_s=1e-3)
    made.set(0x605A, 0, 5, 2)  # Quick Stop Active stays
    made.set(0x605C, 0, 0, 2)  # no ramps: a transition is over at once
    return made


def reach(rig: Rig, state: PowerState) -> None:
    """Into `state` by the bus, last controlword 0x00 or the one of the way there."""
    device = rig.device.device[0]
    device.inject_fault_code = 0
    rig.control(0x00, 0x80, 0x00)
    assert rig.state() == S.SWITCH_ON_DISABLED
    if state == S.FAULT:
        device.inject_fault_code = 0x2340
        rig.run(2)
        device.inject_fault_code = 0
    elif state == S.FAULT_REACTION_ACTIVE:
        rig.control(0x06, 0x07, 0x0F)
        rig.device.plant_state[0].joint_velocity_radps = 2.0  # the ramp down lasts
        device.inject_fault_code = 0x2340
        rig.run(2)
        device.inject_fault_code = 0
    elif state != S.SWITCH_ON_DISABLED:
        way = [S.READY_TO_SWITCH_ON, S.SWITCHED_ON, S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE]
        rig.control(*(0x06, 0x07, 0x0F, 0x02)[: way.index(state) + 1])
    assert rig.state() == state
    mask, value = STATUS[state]
    assert rig.get(0x6041) & mask == value


def expected(state: PowerState, word: int) -> PowerState:
    if state in (S.FAULT, S.FAULT_REACTION_ACTIVE) or word & 0x80:
        return state
    for name, (mask, value) in COMMANDS.items():
        if word & mask == value:
            return LEGAL.get((state, name), state)
    return state


@pytest.mark.parametrize("state", STATES, ids=lambda s: s.name)
@pytest.mark.parametrize("word", [*range(16), *range(0x80, 0x90), 0x40, 0x0810, 0xF800, 0xF806])
def test_every_controlword_in_every_state(rig: Rig, state: PowerState, word: int) -> None:
    reach(rig, state)
    rig.set(0x6040, 0, word, 2)
    assert rig.get(0x6040) == word  # readable
    if state == S.FAULT and word & 0x80:  # the rising edge of bit 7, whatever else is set (transition 15)
        assert rig.state() == S.SWITCH_ON_DISABLED
    else:
        assert rig.state() == expected(state, word)
    if state == S.FAULT_REACTION_ACTIVE:
        rig.run(400)
        assert rig.state() == S.FAULT  # 14, by itself


def test_the_table_has_every_transition_that_a_master_may_ask_for() -> None:
    assert len(LEGAL) == 15
    assert {state for state, _ in LEGAL} == set(STATES) - {S.FAULT, S.FAULT_REACTION_ACTIVE}


@pytest.mark.parametrize("state", STATES, ids=lambda s: s.name)
def test_a_controlword_by_pdo_does_the_same_as_by_sdo(rig: Rig, state: PowerState) -> None:
    rig.operational()
    for word in (0x00, 0x02, 0x06, 0x07, 0x0F):
        reach(rig, state)
        rig.send(0x200 + NODE, struct.pack("<H", word))
        assert rig.state() == expected(state, word), hex(word)
        assert rig.get(0x6040) == word
        rig.run(400 if state == S.FAULT_REACTION_ACTIVE else 1)


@pytest.mark.parametrize("option", [0, 1, 2])
def test_quick_stop_is_not_left_for_operation_enabled_when_it_ends_by_itself(option: int) -> None:
    rig = Rig(step_s=1e-3)
    rig.set(0x605A, 0, option, 2)
    rig.control(0x06, 0x07, 0x0F)
    rig.device.plant_state[0].joint_velocity_radps = 2.0
    rig.set(0x6040, 0, 0x02, 2)
    rig.set(0x6040, 0, 0x0F, 2)
    assert rig.state() == (S.SWITCH_ON_DISABLED if option == 0 else S.QUICK_STOP_ACTIVE)
    rig.device.plant_state[0].joint_velocity_radps = 0.0
    rig.run(1000)
    assert rig.state() == S.SWITCH_ON_DISABLED

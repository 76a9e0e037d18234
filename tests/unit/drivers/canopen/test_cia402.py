"""The CiA 402 state machine against the tables of the standard, restated here."""

from __future__ import annotations

import pytest

from jointctl.drivers.canopen.cia import (
    SUPPORTED_MODE_BIT,
    ControlWord,
    Mode,
    State,
    state_of_word,
    state_text,
)
from jointctl.drivers.canopen.cyclic import control_word, decode_state, drive_state
from jointctl.firmware_py.states import DriveRequest, DriveState

# mask, value: CiA 402-2, table "state coding"
TABLE = {
    State.NOT_READY_TO_SWITCH_ON: (0x4F, 0x00), State.SWITCH_ON_DISABLED: (0x4F, 0x40),
    State.READY_TO_SWITCH_ON: (0x6F, 0x21), State.SWITCHED_ON: (0x6F, 0x23), State.OPERATION_ENABLED: (0x6F, 0x27),
    State.QUICK_STOP_ACTIVE: (0x6F, 0x07), State.FAULT_REACTION_ACTIVE: (0x4F, 0x0F), State.FAULT: (0x4F, 0x08),
}  # fmt: skip


def test_every_statusword_decodes_as_the_table_says() -> None:
    for word in range(0x10000):
        matching = [state for state, (mask, value) in TABLE.items() if word & mask == value]
        assert len(matching) <= 1
        assert decode_state(word) == (matching[0] if matching else State.UNDEFINED), hex(word)


def test_the_plain_function_says_the_same_in_words() -> None:
    assert all(state_of_word(word) is State(decode_state(word)) for word in range(0x80))
    assert state_text(0x0237) == "operation enabled"
    assert state_text(0x0250) == "switch on disabled"


def test_every_state_is_reached() -> None:
    assert {State(decode_state(word)) for word in range(0x80)} == set(State)


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (State.NOT_READY_TO_SWITCH_ON, DriveState.UNKNOWN), (State.SWITCH_ON_DISABLED, DriveState.OFF),
        (State.READY_TO_SWITCH_ON, DriveState.STARTING), (State.SWITCHED_ON, DriveState.PREPARED),
        (State.OPERATION_ENABLED, DriveState.ENABLED), (State.QUICK_STOP_ACTIVE, DriveState.STOPPING),
        (State.FAULT_REACTION_ACTIVE, DriveState.FAULT_BRAKING), (State.FAULT, DriveState.FAULT),
        (State.UNDEFINED, DriveState.UNKNOWN),
    ],
)  # fmt: skip
def test_the_loops_view(state: State, expected: DriveState) -> None:
    assert drive_state(int(state)) == expected


ENABLE_WORDS = {
    State.SWITCH_ON_DISABLED: 0x06,  # transition 2
    State.READY_TO_SWITCH_ON: 0x07,  # 3
    State.SWITCHED_ON: 0x0F,  # 4
    State.OPERATION_ENABLED: 0x0F,
}


@pytest.mark.parametrize("state", State)
def test_control_words(state: State) -> None:
    assert control_word(int(state), DriveRequest.OFF) == 0x00
    assert control_word(int(state), DriveRequest.ENABLE) == ENABLE_WORDS.get(state, 0x00)
    prepare = {**ENABLE_WORDS, State.SWITCHED_ON: 0x07, State.OPERATION_ENABLED: 0x07}  # 3 and, from enabled, 5
    assert control_word(int(state), DriveRequest.PREPARE) == prepare.get(state, 0x00)
    braking = state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
    assert control_word(int(state), DriveRequest.QUICK_STOP) == (0x02 if braking else 0x00)


def test_no_fault_is_ever_reset_and_nothing_enables_out_of_a_fault_or_a_quick_stop() -> None:
    for state in State:
        for request in (*map(int, DriveRequest), -1, 3, 99):
            word = control_word(int(state), request)
            assert not word & 0x80
            if request != DriveRequest.ENABLE:
                assert word & 0x0F != 0x0F
            if state in (State.FAULT, State.FAULT_REACTION_ACTIVE, State.QUICK_STOP_ACTIVE, State.UNDEFINED):
                assert word & 0x0F in (0x00, 0x02)


def test_the_way_up_and_down_through_a_drive_that_follows_the_standard() -> None:
    transitions = {
        (State.SWITCH_ON_DISABLED, 0x06): State.READY_TO_SWITCH_ON,
        (State.READY_TO_SWITCH_ON, 0x07): State.SWITCHED_ON,
        (State.SWITCHED_ON, 0x0F): State.OPERATION_ENABLED,
        (State.OPERATION_ENABLED, 0x02): State.QUICK_STOP_ACTIVE,
        (State.OPERATION_ENABLED, 0x00): State.SWITCH_ON_DISABLED,
        (State.SWITCHED_ON, 0x00): State.SWITCH_ON_DISABLED,
        (State.READY_TO_SWITCH_ON, 0x00): State.SWITCH_ON_DISABLED,
        (State.QUICK_STOP_ACTIVE, 0x00): State.SWITCH_ON_DISABLED,
    }

    def reach(state: State, request: DriveRequest) -> State:
        for _ in range(6):
            state = transitions.get((state, int(control_word(int(state), request))), state)
        return state

    up = [s for s in State if s in ENABLE_WORDS or s is State.QUICK_STOP_ACTIVE]
    assert {reach(s, DriveRequest.ENABLE) for s in up} == {State.OPERATION_ENABLED}
    assert {reach(s, DriveRequest.OFF) for s in up} == {State.SWITCH_ON_DISABLED}
    assert reach(State.OPERATION_ENABLED, DriveRequest.QUICK_STOP) is State.QUICK_STOP_ACTIVE
    assert reach(State.SWITCHED_ON, DriveRequest.QUICK_STOP) is State.SWITCH_ON_DISABLED
    assert reach(State.FAULT, DriveRequest.ENABLE) is State.FAULT


def test_numbers_of_the_standard() -> None:
    assert {w.name: int(w) for w in ControlWord} == {
        "DISABLE_VOLTAGE": 0x00, "QUICK_STOP": 0x02, "SHUTDOWN": 0x06,
        "SWITCH_ON": 0x07, "ENABLE_OPERATION": 0x0F, "FAULT_RESET": 0x80,
    }  # fmt: skip
    assert sorted(int(m) for m in Mode) == [1, 3, 4, 6, 8, 9, 10]
    assert {int(m): bit for m, bit in SUPPORTED_MODE_BIT.items()} == {1: 0, 3: 2, 4: 3, 6: 5, 8: 7, 9: 8, 10: 9}

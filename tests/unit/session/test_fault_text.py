"""What the user is told of each fault: what happened with numbers, code and name, likely cause, next step."""

from __future__ import annotations

import math

import pytest

from jointctl.firmware_py.records import ENCODER_RESTARTED
from jointctl.firmware_py.states import Fault
from jointctl.tools.session.fault_words import (
    FAULT_TEXTS,
    SERIAL_FAULT_TEXTS,
    TWO_ENCODER_TEXTS,
    fault_text,
    serial_fault_text,
)

FAULTS = [fault for fault in Fault if fault is not Fault.NONE]
WITH_STATUSWORD = (
    Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED, Fault.ENABLE_TIMEOUT, Fault.OFF_TIMEOUT, Fault.DRIVE_STAYS_ENABLED,
)  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("value", [0.0, -1.5, 663.0, 1e9, math.nan, math.inf])
def test_every_fault_tells_what_happened_why_and_what_to_do(fault: Fault, value: float) -> None:
    text = fault_text(fault, value, 0)
    for part in (text.happened, text.cause, text.next_step):
        assert part.strip() == part != ""
        assert "{" not in part
        assert "\n" not in part
    assert "error code" not in text.happened
    assert "error code is 2310h, continuous overcurrent" in fault_text(fault, value, 0x2310).happened


@pytest.mark.parametrize("fault", WITH_STATUSWORD)
def test_a_statusword_is_told_as_such_and_with_its_state(fault: Fault) -> None:
    """It was told as a decimal number."""
    assert "(statusword 0297h, quick stop active)" in fault_text(fault, float(0x0297), 0).happened
    assert "(statusword 0218h, fault)" in fault_text(fault, float(0x0218), 0).happened


@pytest.mark.parametrize("fault", WITH_STATUSWORD)
def test_a_serial_line_has_no_statusword(fault: Fault) -> None:
    assert "(SR {word})" in SERIAL_FAULT_TEXTS[fault].happened


@pytest.mark.parametrize("fault", [Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED])
@pytest.mark.parametrize(
    ("code", "communication"),
    [(0, False), (0x80FF, False), (0x8110, True), (0x8130, True), (0x8250, True), (0x8300, False), (0x7300, False)],
)
def test_a_drive_that_did_not_hear_us_does_not_send_the_user_to_its_sto_wiring(
    fault: Fault, code: int, communication: bool
) -> None:
    text = fault_text(fault, float(0x0297), code)
    assert ("heard our frames too seldom" in text.cause) is communication
    assert (text.cause == FAULT_TEXTS[fault].cause) is not communication
    assert fault_text(Fault.STALE_SAMPLE, 51.0, code).cause == FAULT_TEXTS[Fault.STALE_SAMPLE].cause


@pytest.mark.parametrize("fault", FAULTS)
def test_an_error_is_told_as_that_of_the_node_that_has_it(fault: Fault) -> None:
    """The encoder's EMCY was told as the drive's."""
    told = fault_text(fault, 6.0, 0, 0x5000, two_encoders=True).happened
    assert "the encoder node's error code is 5000h" in told
    assert "drive's error code" not in told
    assert "encoder node restarted" in fault_text(fault, 6.0, 0, ENCODER_RESTARTED, two_encoders=True).happened
    told = fault_text(fault, 6.0, 0x5000, two_encoders=True).happened
    assert "the drive's error code is 5000h" in told
    assert "encoder node" not in told


@pytest.mark.parametrize("fault", FAULTS)
def test_a_missing_sample_of_two_encoders_may_be_that_of_either(fault: Fault) -> None:
    two, one = fault_text(fault, 6.0, 0, two_encoders=True), fault_text(fault, 6.0, 0)
    assert (two != one) is (fault in TWO_ENCODER_TEXTS) is (fault in (Fault.STALE_SAMPLE, Fault.NO_SAMPLES))
    if two != one:
        assert "encoder" in two.happened
        assert "the joint's encoder" in two.cause
        assert "not believed" in fault_text(fault, 6.0, 0, 0x5000, two_encoders=True).cause


@pytest.mark.parametrize(("status", "words"), [(0x8110, "stayed away"), (0x8100, "switched off without being asked")])
def test_a_status_with_the_servo_on_does_not_pass_for_a_motor_that_was_switched_off(status: int, words: str) -> None:
    text = serial_fault_text(Fault.DRIVE_NOT_ENABLED, float(status))
    assert text is not None
    assert words in text.happened

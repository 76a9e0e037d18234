"""The exit code of each error class is a promise to scripts."""

from __future__ import annotations

import pytest

from jointctl.drivers import errors


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("UsageError", 2),
        ("ConfigurationError", 3),
        ("BusError", 4),
        ("NoDeviceError", 5),
        ("DeviceError", 6),
        ("MotionFault", 7),
        ("DataError", 8),
        ("MarginError", 9),
    ],
)
def test_exit_codes(name: str, code: int) -> None:
    error = getattr(errors, name)("rate_Hz (=0) must be above 0", "set rate_Hz")
    assert isinstance(error, errors.JointctlError)
    assert error.exit_code == code
    assert (error.message, error.hint) == ("rate_Hz (=0) must be above 0", "set rate_Hz")
    assert str(error) == "rate_Hz (=0) must be above 0 (set rate_Hz)"


def test_message_is_one_line_and_hint_may_be_empty() -> None:
    error = errors.BusError("first\n   second")
    assert error.message == "first second"
    assert error.hint == ""
    assert str(error) == "first second"

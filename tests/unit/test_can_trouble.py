"""Error frames of SocketCAN, and the state of an interface, in words and with the command that mends it."""

from __future__ import annotations

import errno
from typing import Any

import pytest

from drivers.can.error_frames import BUS_OFF, CONTROLLER, COUNTERS, NO_ACK, PROTOCOL, error_frame_text, trouble
from drivers.can.link_state import LinkState, link_problem, link_state, parse_link, send_problem


@pytest.mark.parametrize(
    ("identifier", "data", "text", "worst"),
    [
        (BUS_OFF, b"", "bus-off", "bus-off"),
        (NO_ACK, b"", "no acknowledge", "no acknowledge"),
        (CONTROLLER, b"\0\x20", "error passive (transmit)", "error passive"),
        (CONTROLLER, b"\0\x10", "error passive (receive)", "error passive"),
        (CONTROLLER, b"\0\x08", "error warning (transmit)", ""),
        (CONTROLLER, b"\0\x40", "error active again", ""),
        (CONTROLLER, b"\0\x01", "receive buffer overflow", "buffer overflow"),
        (PROTOCOL, b"\0\0\x04", "protocol violation (bit stuffing)", "bus error"),
        (COUNTERS, b"\0\0\0\0\0\0\x60\x07", "transmit errors 96, receive errors 7", ""),
        (0, b"", "unspecified error", ""),
        (BUS_OFF | CONTROLLER, b"\0\x20", "bus-off; error passive (transmit)", "bus-off"),
    ],
)
def test_error_frames(identifier: int, data: bytes, text: str, worst: str) -> None:
    assert error_frame_text(identifier | 0x20000000, data) == text
    assert trouble(identifier | 0x20000000, data) == worst


def real_interface(**data: Any) -> dict[str, Any]:
    """As `ip -details -statistics -json link show dev can0` prints it (iproute2 6.1)."""
    info_data = {"state": "ERROR-ACTIVE", "berr_counter": {"tx": 0, "rx": 0}, "restart_ms": 0,
                 "bittiming": {"bitrate": 1000000, "sample_point": "0.750"}, "clock": 80000000}  # fmt: skip
    return {
        "ifname": "can0", "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"], "txqlen": 10,
        "linkinfo": {"info_kind": "can", "info_data": {**info_data, **data},
                     "info_xstats": {"restarts": 0, "bus_error": 3, "error_passive": 1, "bus_off": 0}},
    }  # fmt: skip


def test_a_healthy_interface() -> None:
    link = parse_link(real_interface())
    assert link == LinkState("can0", "can", True, "ERROR-ACTIVE", 0, 0, 1_000_000, 0, 10, link.counts)
    assert link.counts["bus_error"] == 3
    assert link_problem(link) is None
    assert link_problem(link, 1_000_000) is None


def test_error_warning_is_no_problem_yet() -> None:
    assert link_problem(parse_link(real_interface(state="ERROR-WARNING"))) is None


@pytest.mark.parametrize(
    ("data", "words", "cure"),
    [
        ({"state": "ERROR-PASSIVE", "berr_counter": {"tx": 128, "rx": 0}}, "passive (transmit errors 128", "60 ohm"),
        ({"state": "BUS-OFF"}, "bus-off", "up type can bitrate 1000000 restart-ms 100"),
        ({"state": "STOPPED"}, "in state STOPPED", "ip link set can0 down"),
        ({"bittiming": {"bitrate": 500000}}, "runs at 500000 bit/s, the configuration says 1000000", "bitrate 1000000"),
    ],
)  # fmt: skip
def test_problems_come_with_their_cure(data: dict[str, Any], words: str, cure: str) -> None:
    found = link_problem(parse_link(real_interface(**data)), 1_000_000)
    assert found is not None
    assert words in found[0]
    assert cure in found[1]


def test_a_virtual_interface_tells_less() -> None:
    raw = {"ifname": "vcan0", "flags": ["NOARP", "UP"], "txqlen": 1000, "linkinfo": {"info_kind": "vcan"}}
    assert link_problem(parse_link(raw), 1_000_000) is None
    down = link_problem(parse_link({**raw, "flags": ["NOARP"]}))
    assert down is not None
    assert "vcan0 is down" in down[0]


def test_an_interface_that_does_not_exist() -> None:
    assert link_state("jc_none0") is None


@pytest.mark.parametrize(
    ("code", "words", "cure"),
    [(errno.ENOBUFS, "queue of can0 is full", "txqueuelen 1000"), (errno.ENETDOWN, "went down", "ip link set can0 up"),
     (errno.ENODEV, "has gone", "plug the adapter")],
)  # fmt: skip
def test_failed_sends(code: int, words: str, cure: str) -> None:
    found = send_problem("can0", code)
    assert found is not None
    assert words in found[0]
    assert cure in found[1]
    assert send_problem("can0", errno.EAGAIN) is None

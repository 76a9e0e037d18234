"""Error frames of SocketCAN, and the state of an interface, in words and with the command that mends it."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any

import can
import pytest

from jointctl.drivers.can.socketcan import (
    BUS_OFF,
    CONTROLLER,
    COUNTERS,
    NO_ACK,
    PROTOCOL,
    LinkState,
    error_frame_text,
    interface_blamed,
    link_problem,
    link_state,
    parse_link,
    send_problem,
    trouble,
)
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.errors import BusError, JointctlError, NoDeviceError
from jointctl.tools.inspection.subject import Subject
from jointctl.tools.output import Output
from jointctl.tools.session.canopen_drive import CanopenSession
from jointctl.tools.session.session import Session
from jointctl.tools.verbs.clear_fault import clear_fault
from jointctl.tools.verbs.info import node_info as info
from jointctl.tools.verbs.scan import scan
from tests.configurations import shipped


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
    assert link == LinkState("can0", "can", True, "ERROR-ACTIVE", 0, 0, 1_000_000, 10, link.counts)
    assert link.counts["bus_error"] == 3
    assert link_problem(link) is None
    assert link_problem(link, 1_000_000) is None


def test_error_warning_is_no_problem_yet() -> None:
    assert link_problem(parse_link(real_interface(state="ERROR-WARNING"))) is None


@pytest.mark.parametrize(
    ("data", "words", "remedy"),
    [
        ({"state": "ERROR-PASSIVE", "berr_counter": {"tx": 128, "rx": 0}}, "passive (transmit errors 128", "60 ohm"),
        ({"state": "BUS-OFF"}, "bus-off", "up type can bitrate 1000000 restart-ms 100"),
        ({"state": "STOPPED"}, "in state STOPPED", "ip link set can0 down"),
        ({"bittiming": {"bitrate": 500000}}, "runs at 500000 bit/s, the configuration says 1000000", "bitrate 1000000"),
    ],
)  # fmt: skip
def test_problems_come_with_their_cure(data: dict[str, Any], words: str, remedy: str) -> None:
    found = link_problem(parse_link(real_interface(**data)), 1_000_000)
    assert found is not None
    assert words in found[0]
    assert remedy in found[1]


def test_a_virtual_interface_tells_less() -> None:
    raw = {"ifname": "vcan0", "flags": ["NOARP", "UP"], "txqlen": 1000, "linkinfo": {"info_kind": "vcan"}}
    assert link_problem(parse_link(raw), 1_000_000) is None
    down = link_problem(parse_link({**raw, "flags": ["NOARP"]}))
    assert down is not None
    assert "vcan0 is down" in down[0]


def test_an_interface_that_does_not_exist() -> None:
    assert link_state("jc_none0") is None


SILENCE = NoDeviceError("node 1 does not answer", hint="power, wiring")


@pytest.mark.parametrize(
    ("data", "words", "remedy"),
    [
        ({"bittiming": {"bitrate": 500000}}, "runs at 500000 bit/s, the configuration says 1000000", "bitrate 1000000"),
        ({"state": "BUS-OFF"}, "can0 is bus-off", "restart-ms 100"),
        ({"state": "ERROR-PASSIVE"}, "can0 is error passive", "60 ohm"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("failure", [SILENCE, BusError("the bus failed during commissioning")])
def test_silence_on_a_sick_interface_tells_its_trouble_and_the_cure(
    data: dict[str, Any], words: str, remedy: str, failure: JointctlError, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointctl.drivers.can.socketcan.link_state", lambda channel: parse_link(real_interface(**data)))
    with pytest.raises(type(failure)) as caught, interface_blamed("socketcan", "can0", 1_000_000):
        raise failure
    assert caught.value.message.startswith(f"{failure.message}; CAN interface can0 ")
    assert words in caught.value.message
    assert remedy in caught.value.hint
    assert caught.value.hint.endswith(failure.hint)


@pytest.mark.parametrize(
    ("interface", "state"), [("socketcan", "ERROR-ACTIVE"), ("jointctl", "BUS-OFF"), ("socketcan", "")]
)
def test_silence_on_a_sound_interface_or_another_bus_stays_as_it_is(
    interface: str, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = parse_link(real_interface(state=state)) if state else None  # None: no such interface, or no program `ip`
    monkeypatch.setattr("jointctl.drivers.can.socketcan.link_state", lambda channel: link)
    with pytest.raises(NoDeviceError) as caught, interface_blamed(interface, "can0", 1_000_000):
        raise SILENCE
    assert caught.value is SILENCE


@pytest.mark.parametrize("verb", ["scan", "info", "commission", "clear_fault"])
def test_who_hears_nobody_on_an_interface_of_another_bit_rate_says_so(
    empty_bus: Any, settings_of_virtual_joint: CanopenSettings, verb: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    link = parse_link(real_interface(bittiming={"bitrate": 500000}))
    monkeypatch.setattr("jointctl.drivers.can.socketcan.link_state", lambda channel: link)
    monkeypatch.setattr(
        "jointctl.tools.inspection.subject.open_python_can",
        lambda *_: can.Bus(interface="virtual", channel=empty_bus.channel),
    )
    monkeypatch.setattr(CanopenSession, "open", lambda *_: empty_bus.drive(settings_of_virtual_joint))
    config, output = shipped(bus__interface="socketcan", bus__channel="can0"), Output(quiet=True)
    subject = Subject("socketcan", "can0", 1_000_000, 1)
    verbs: dict[str, Callable[[], Any]] = {
        "scan": lambda: scan(subject, output, listen_s=0.0),
        "info": lambda: info(subject, output),
        "commission": lambda: Session.commissioned(config, drive, None),
        "clear_fault": lambda: clear_fault(config, output),
    }
    drive = empty_bus.drive(settings_of_virtual_joint)
    told = "; CAN interface can0 runs at 500000 bit/s, the configuration says 1000000"
    with pytest.raises(NoDeviceError, match=told):
        verbs[verb]()
    drive.close()


@pytest.mark.parametrize(
    ("code", "words", "remedy"),
    [(errno.ENOBUFS, "queue of can0 is full", "txqueuelen 1000"), (errno.ENETDOWN, "went down", "ip link set can0 up"),
     (errno.ENODEV, "has gone", "plug the adapter")],
)  # fmt: skip
def test_failed_sends(code: int, words: str, remedy: str) -> None:
    found = send_problem("can0", code)
    assert found is not None
    assert words in found[0]
    assert remedy in found[1]
    assert send_problem("can0", errno.EAGAIN) is None

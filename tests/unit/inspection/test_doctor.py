"""`jointctl doctor` on a bus: what it finds, what it says about it, and that it only ever reads."""

from __future__ import annotations

import io
import json
import struct
from collections import deque
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from jointctl.drivers.can.socketcan import parse_link
from jointctl.drivers.errors import BusError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.inspection import health
from jointctl.tools.inspection.health import (
    NOTE,
    OK,
    PROBLEM,
    SDO_READS,
    Finding,
    adapters,
    bus_budget,
    drive_finding,
    interface_state,
    sdo_round_trips_us,
)
from jointctl.tools.output import Output
from jointctl.tools.verbs import doctor as doctor_module
from jointctl.tools.verbs.doctor import doctor, findings
from tests.unit.inspection.system_files import write


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(shipped_config("virtual"))


def changed(config: Config, **values: Any) -> Config:
    """The configuration with another bus or rate."""
    bus = {key: values[key] for key in ("interface", "channel", "bitrate_bitps") if key in values}
    loop = {key: values[key] for key in ("rate_Hz", "priority") if key in values}
    return config.model_copy(
        update={"bus": config.bus.model_copy(update=bus), "loop": config.loop.model_copy(update=loop)}
    )


class SdoBus:
    """A node that answers reads of 1000h, all or some; everything sent is kept."""

    def __init__(self, node: int, answers: int = SDO_READS) -> None:
        self.node = node
        self.answers = answers
        self.sent: list[can.Message] = []
        self.waiting: deque[can.Message] = deque()
        self.closed = False

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self.sent.append(message)
        for identifier, data in (
            (0x181, bytes(8)),
            (0x580 + self.node, struct.pack("<BHBI", 0x43, 0x1018, 1, 7)),
            (0x580 + self.node, struct.pack("<BHBI", 0x43, 0x1000, 0, 0x00020192)),
        )[: 3 if len(self.sent) <= self.answers else 2]:
            self.waiting.append(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.waiting.popleft() if self.waiting else None

    def shutdown(self) -> None:
        self.closed = True


@pytest.fixture
def short_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "_SDO_TIMEOUT_S", 0.01)


class TestBus:
    def test_interfaces_are_found_by_their_type(self, config: Config, tmp_path: Path) -> None:
        for name, kind, state in (("can0", "280", "up"), ("eth0", "1", "up"), ("vcan1", "280", "unknown")):
            write(tmp_path, f"sys/class/net/{name}/type", kind + "\n")
            write(tmp_path, f"sys/class/net/{name}/operstate", state + "\n")
        found = {f.topic: f for f in adapters(config, tmp_path)}["CAN interfaces"]
        assert (found.status, found.text) == (OK, "can0 (up), vcan1 (unknown)")

    @pytest.mark.parametrize(("interface", "status"), [("socketcan", PROBLEM), ("jointctl", NOTE), ("slcan", NOTE)])
    def test_no_interface_is_a_problem_only_where_needed(
        self, config: Config, tmp_path: Path, interface: str, status: str
    ) -> None:
        found = {f.topic: f for f in adapters(changed(config, interface=interface), tmp_path)}["CAN interfaces"]
        assert (found.status, found.text) == (status, "none")

    @pytest.mark.parametrize(
        ("rate_Hz", "bitrate", "status"),
        [(1000.0, 1_000_000, OK), (2807.0, 1_000_000, OK), (2808.0, 1_000_000, PROBLEM), (1000.0, 500_000, OK),
         (1000.0, 357_000, OK), (1000.0, 356_000, PROBLEM)],
    )  # fmt: skip
    def test_budget(self, config: Config, rate_Hz: float, bitrate: int, status: str) -> None:
        found = bus_budget(changed(config, rate_Hz=rate_Hz, bitrate_bitps=bitrate))
        assert found.status == status
        assert found.numbers["load"] == pytest.approx(285.0 * rate_Hz / bitrate)

    @pytest.mark.parametrize(("rate_Hz", "status"), [(499.0, OK), (500.0, OK), (501.0, PROBLEM), (1000.0, PROBLEM)])
    def test_budget_of_the_plain_python_loop(self, config: Config, rate_Hz: float, status: str) -> None:
        found = bus_budget(changed(config, interface="slcan", rate_Hz=rate_Hz))
        assert found.status == status
        assert "plain Python loop" in found.text

    def test_only_reads_of_1000_are_sent(self) -> None:
        bus = SdoBus(5)
        times = sdo_round_trips_us(bus, 5)
        assert len(times) == SDO_READS
        assert all(time_us > 0.0 for time_us in times)
        assert {(m.arbitration_id, bytes(m.data)) for m in bus.sent} == {(0x605, b"\x40\x00\x10\x00\0\0\0\0")}

    @pytest.mark.usefixtures("short_timeout")
    @pytest.mark.parametrize(
        ("answers", "status", "asked"), [(0, PROBLEM, 1), (SDO_READS - 1, NOTE, SDO_READS), (SDO_READS, OK, SDO_READS)]
    )
    def test_the_drive(
        self, config: Config, answers: int, status: str, asked: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        bus = SdoBus(config.drive.node, answers)
        monkeypatch.setattr(health, "open_python_can", lambda *_: bus)
        found = drive_finding(config)
        assert (found.status, len(bus.sent), bus.closed) == (status, asked, True)

    def test_a_bus_that_fails_is_a_problem(self, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
        bus = SdoBus(1)

        def fail(*_: Any) -> None:
            raise can.CanOperationError("bus off")

        monkeypatch.setattr(bus, "send", fail)
        monkeypatch.setattr(health, "open_python_can", lambda *_: bus)
        found = drive_finding(config)
        assert (found.status, bus.closed) == (PROBLEM, True)
        assert "bus off" in found.text

    def test_no_bus_is_a_note_with_the_cure(self, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*_: Any) -> None:
            raise BusError("no virtual bus", "start one")

        monkeypatch.setattr(health, "open_python_can", fail)
        assert drive_finding(config) == Finding("drive", NOTE, "not asked: no virtual bus", "start one")

    @pytest.mark.parametrize(
        ("data", "queue", "found"),
        [
            ({"state": "ERROR-ACTIVE"}, 1000, [("interface", OK)]),
            ({"state": "ERROR-ACTIVE"}, 10, [("interface", OK), ("transmit queue", NOTE)]),
            ({"state": "ERROR-WARNING"}, 1000, [("interface", NOTE)]),
            ({"state": "ERROR-PASSIVE"}, 1000, [("interface", PROBLEM)]),
            ({"state": "BUS-OFF"}, 1000, [("interface", PROBLEM)]),
            ({"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 500_000}}, 1000, [("interface", PROBLEM)]),
        ],
    )
    def test_the_state_of_the_interface(
        self, config: Config, data: Any, queue: int, found: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        link = {"ifname": "can0", "flags": ["UP"], "txqlen": queue, "linkinfo": {"info_kind": "can", "info_data": data}}
        monkeypatch.setattr(health, "link_state", lambda name: parse_link(link))
        told = list(interface_state(changed(config, interface="socketcan", channel="can0")))
        assert [(finding.topic, finding.status) for finding in told] == found
        assert all(finding.cure for finding in told if finding.status != OK)
        assert list(interface_state(config)) == []  # another kind of bus

    def test_a_missing_interface(self, config: Config) -> None:
        (found,) = interface_state(changed(config, interface="socketcan", channel="jc_none0"))
        assert found.status == PROBLEM
        assert "ip link set jc_none0 up" in found.cure

    @pytest.mark.parametrize(("rate_Hz", "status"), [(100.0, OK), (4000.0, NOTE)])
    def test_a_slow_answer_limits_the_rate(
        self, config: Config, rate_Hz: float, status: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(health, "open_python_can", lambda *_: SdoBus(config.drive.node))
        monkeypatch.setattr(health, "sdo_round_trips_us", lambda *_: [1000.0] * SDO_READS)
        found = drive_finding(changed(config, rate_Hz=rate_Hz))
        assert (found.status, found.numbers["allowed_rate_Hz"]) == (status, 600.0)


class TestReport:
    def report(self, config: Config, found: list[Finding], monkeypatch: pytest.MonkeyPatch, **how: bool) -> Any:
        monkeypatch.setattr(doctor_module, "findings", lambda *_, **__: iter(found))
        stdout, stderr = io.StringIO(), io.StringIO()
        code = doctor(config, Output(stdout=stdout, stderr=stderr, **how))
        return code, stdout.getvalue(), stderr.getvalue()

    @pytest.mark.parametrize(("status", "code"), [(OK, 0), (NOTE, 0), (PROBLEM, 1)])
    def test_exit_code_and_table(self, config: Config, status: str, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
        found = [Finding("Python", OK, "3.11"), Finding("x", status, "a [b]", "do [c]")]
        result, stdout, stderr = self.report(config, found, monkeypatch)
        assert result == code
        assert "a [b]" in stdout
        assert "do [c]" in stdout
        assert "Python" in stderr

    def test_json(self, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
        found = [Finding("x", PROBLEM, "bad", "cure", {"p50_us": np.float64(1.5)})]
        code, stdout, stderr = self.report(config, found, monkeypatch, json=True, quiet=True)
        data = json.loads(stdout)
        assert (code, stderr, data["healthy"]) == (1, "", False)
        assert data["findings"] == [
            {"topic": "x", "status": "problem", "text": "bad", "cure": "cure", "numbers": {"p50_us": 1.5}}
        ]

    def test_on_this_computer(self, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(health, "start_time_s", lambda cache: 1.0)
        elsewhere = changed(config, channel="nobody-listens-here")
        found = list(findings(elsewhere, wake_cycles=10))
        topics = [f.topic for f in found]
        assert len(set(topics)) == len(topics) >= 15
        assert {"Python", "SCHED_FIFO", "memory lock", "timer slack", "bus budget", "drive"} <= set(topics)
        assert all(f.text for f in found)
        assert all(f.cure for f in found if f.status == PROBLEM)

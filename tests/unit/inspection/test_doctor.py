"""`jointctl doctor`: what it finds on a bus and about the computer, and that it only ever reads."""

from __future__ import annotations

import json
import os
import struct
import subprocess
from collections import deque
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from jointctl.drivers.can.socketcan import parse_link
from jointctl.drivers.errors import BusError
from jointctl.tools.configuration.config import Config
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
    kernel_cache,
    kernel_findings,
    quick_stop_finding,
    sdo_round_trips_us,
    wake_up,
)
from jointctl.tools.verbs import doctor as doctor_module
from jointctl.tools.verbs.doctor import doctor, findings
from jointctl.tools.wake_up import cores_awake, fifo, wake_up_lateness_ns
from tests.sessions import output


# --- A folder with files as /sys and /proc have them ---
def write(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


# --- `jointctl doctor` on a bus: what it finds, what it says about it, and that it only ever reads ---
@pytest.fixture
def config(virtual_config: Config) -> Config:
    return virtual_config


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
        found = {f.topic: f for f in adapters(config.changed(bus__interface=interface), tmp_path)}["CAN interfaces"]
        assert (found.status, found.text) == (status, "none")

    @pytest.mark.parametrize(
        ("rate_Hz", "bitrate", "status"),
        [(1000.0, 1_000_000, OK), (2807.0, 1_000_000, OK), (2808.0, 1_000_000, PROBLEM), (1000.0, 500_000, OK),
         (1000.0, 357_000, OK), (1000.0, 356_000, PROBLEM)],
    )  # fmt: skip
    def test_budget(self, config: Config, rate_Hz: float, bitrate: int, status: str) -> None:
        found = bus_budget(config.changed(loop__rate_Hz=rate_Hz, bus__bitrate_bitps=bitrate))
        assert found.status == status
        assert found.numbers["load"] == pytest.approx(285.0 * rate_Hz / bitrate)

    @pytest.mark.parametrize(("rate_Hz", "status"), [(499.0, OK), (500.0, OK), (501.0, PROBLEM), (1000.0, PROBLEM)])
    def test_budget_of_the_plain_python_loop(self, config: Config, rate_Hz: float, status: str) -> None:
        found = bus_budget(config.changed(bus__interface="slcan", loop__rate_Hz=rate_Hz))
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
        told = list(interface_state(config.changed(bus__interface="socketcan", bus__channel="can0")))
        assert [(finding.topic, finding.status) for finding in told] == found
        assert all(finding.remedy for finding in told if finding.status != OK)
        assert list(interface_state(config)) == []  # another kind of bus

    def test_a_missing_interface(self, config: Config) -> None:
        (found,) = interface_state(config.changed(bus__interface="socketcan", bus__channel="jc_none0"))
        assert found.status == PROBLEM
        assert "ip link set jc_none0 up" in found.remedy

    @pytest.mark.parametrize(("rate_Hz", "status"), [(100.0, OK), (4000.0, NOTE)])
    def test_a_slow_answer_limits_the_rate(
        self, config: Config, rate_Hz: float, status: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(health, "open_python_can", lambda *_: SdoBus(config.drive.node))
        monkeypatch.setattr(health, "sdo_round_trips_us", lambda *_: [1000.0] * SDO_READS)
        found = drive_finding(config.changed(loop__rate_Hz=rate_Hz))
        assert (found.status, found.numbers["allowed_rate_Hz"]) == (status, 600.0)


def quick_stop(joint: Any, config: Config, monkeypatch: pytest.MonkeyPatch, **changes: Any) -> list[Finding]:
    end = lambda *_, **__: can.Bus(interface="virtual", channel=joint.channel)  # noqa: E731
    monkeypatch.setattr("jointctl.tools.inspection.subject.open_python_can", end)
    return list(quick_stop_finding(config.changed(**changes)))


class TestQuickStop:
    """How fast the drive brakes by itself, at the joint."""

    def test_a_fast_one_is_well_and_nothing_is_written(
        self, joint: Any, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (found,) = quick_stop(joint, config, monkeypatch)
        assert (found.topic, found.status, found.remedy) == ("quick stop", OK, "")
        assert found.text == (
            "the drive's own quick stop (605A = 2) brakes with 12 rad/s2 at the joint (6085 = 1000000)"
        )
        assert found.numbers["radps2"] == pytest.approx(11.98, abs=0.01)
        assert {data[0] for identifier, data in joint.requests if identifier == 0x601} == {0x40}

    def test_a_slow_one_is_a_note_with_what_is_expected(
        self, joint: Any, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        joint.answers[0x6085, 0] = 66_755
        (found,) = quick_stop(joint, config, monkeypatch)
        assert (found.status, "6085" in found.remedy) == (NOTE, True)
        assert "brakes with 0.8 rad/s2 at the joint (6085 = 66755), 1.2 s and 0.62 rad from" in found.text
        assert found.text.endswith("slower than sequence.brake_radps2 (=2); 6085 should be 166887 or more")

    @pytest.mark.parametrize("missing", [0x6085, 0x605A])
    def test_one_that_is_not_known_is_a_note(
        self, joint: Any, config: Config, missing: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        joint.unread[missing, 0] = 0x06020000
        (found,) = quick_stop(joint, config, monkeypatch)
        assert (found.status, found.numbers) == (NOTE, {})
        assert "not known" in found.text

    def test_a_node_that_does_not_answer_has_none(
        self, empty_bus: Any, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("jointctl.tools.inspection.subject.TIMEOUT_S", 0.01)
        assert quick_stop(empty_bus, config, monkeypatch) == []


class TestReport:
    def report(self, config: Config, found: list[Finding], monkeypatch: pytest.MonkeyPatch, **how: bool) -> Any:
        monkeypatch.setattr(doctor_module, "findings", lambda *_, **__: iter(found))
        shown, stdout, stderr = output(**how)
        return doctor(config, shown), stdout.getvalue(), stderr.getvalue()

    @pytest.mark.parametrize(("status", "code"), [(OK, 0), (NOTE, 0), (PROBLEM, 1)])
    def test_exit_code_and_table(self, config: Config, status: str, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
        found = [Finding("Python", OK, "3.11"), Finding("x", status, "a [b]", "do [c]")]
        result, stdout, stderr = self.report(config, found, monkeypatch)
        assert result == code
        assert "a [b]" in stdout
        assert "do [c]" in stdout
        assert "Python" in stderr

    def test_json(self, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
        found = [Finding("x", PROBLEM, "bad", "remedy", {"p50_us": np.float64(1.5)})]
        code, stdout, stderr = self.report(config, found, monkeypatch, json=True, quiet=True)
        data = json.loads(stdout)
        assert (code, stderr, data["healthy"]) == (1, "", False)
        assert data["findings"] == [
            {"topic": "x", "status": "problem", "text": "bad", "remedy": "remedy", "numbers": {"p50_us": 1.5}}
        ]

    def test_on_this_computer(self, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(health, "start_time_s", lambda cache: 1.0)
        elsewhere = config.changed(bus__channel="nobody-listens-here")
        found = list(findings(elsewhere, wake_cycles=10))
        topics = [f.topic for f in found]
        assert len(set(topics)) == len(topics) >= 15
        assert {"Python", "SCHED_FIFO", "memory lock", "timer slack", "bus budget", "drive"} <= set(topics)
        assert all(f.text for f in found)
        assert all(f.remedy for f in found if f.status == PROBLEM)


# --- What `jointctl doctor` finds out about the computer: scheduling, wake-ups, the compile cache ---
class TestComputer:
    @pytest.mark.parametrize(("text", "status"), [("1\n", OK), ("0\n", NOTE), (None, NOTE)])
    def test_preempt_rt(self, tmp_path: Path, text: str | None, status: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(health.platform, "version", lambda: "#1 SMP PREEMPT_DYNAMIC")
        if text is not None:
            write(tmp_path, "sys/kernel/realtime", text)
        kernel = next(kernel_findings(tmp_path))
        assert kernel.status == status
        assert ("not PREEMPT_RT" in kernel.text) == (status == NOTE)
        assert bool(kernel.remedy) == (status == NOTE)

    @pytest.mark.parametrize(
        ("version", "options", "advised"),
        [
            ("#1 SMP PREEMPT_DYNAMIC Debian", "quiet preempt=voluntary", True),
            ("#1 SMP PREEMPT_DYNAMIC Debian", "quiet preempt=full", False),
            ("#1 SMP Debian", "quiet", False),  # could not
        ],
    )
    def test_full_preemption_is_advised_where_the_kernel_can(
        self, tmp_path: Path, version: str, options: str, advised: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(health.platform, "version", lambda: version)
        write(tmp_path, "proc/cmdline", options + "\n")
        kernel = next(kernel_findings(tmp_path))
        assert ("preempt=full" in kernel.remedy) is advised
        assert ("preempt=full" in kernel.text) is ("preempt=full" in options)

    @pytest.mark.parametrize(("clock", "status"), [("tsc", OK), ("hpet", NOTE), ("acpi_pm", NOTE)])
    def test_clock_source(self, tmp_path: Path, clock: str, status: str) -> None:
        write(tmp_path, "sys/devices/system/clocksource/clocksource0/current_clocksource", clock + "\n")
        found = {f.topic: f for f in kernel_findings(tmp_path)}["clock source"]
        assert (found.status, found.text, bool(found.remedy)) == (status, clock, status == NOTE)

    @pytest.mark.parametrize(
        ("governors", "status"), [([], OK), (["performance"] * 2, OK), (["performance", "powersave"], NOTE)]
    )
    def test_governor(self, tmp_path: Path, governors: list[str], status: str) -> None:
        for core, governor in enumerate(governors):
            write(tmp_path, f"sys/devices/system/cpu/cpu{core}/cpufreq/scaling_governor", governor)
        found = {f.topic: f for f in kernel_findings(tmp_path)}["CPU governor"]
        assert found.status == status
        assert ("cpupower" in found.remedy) == (status == NOTE)

    def test_fifo_is_left_again(self) -> None:
        before = os.sched_getscheduler(0)
        with fifo(1) as refused:
            assert refused or os.sched_getscheduler(0) == os.SCHED_FIFO
        assert os.sched_getscheduler(0) == before

    def test_a_refused_priority_is_told_and_not_raised(self) -> None:
        with fifo(1000) as refused:
            assert refused


class TestWakeUp:
    def test_one_value_a_cycle_and_none_early(self) -> None:
        late_ns = wake_up_lateness_ns(1000.0, 20)
        assert late_ns.shape == (20,)
        assert (late_ns >= 0).all()

    @pytest.mark.parametrize(("rate_Hz", "cycles"), [(0.0, 1), (-1.0, 1), (float("nan"), 1), (1000.0, 0)])
    def test_bad_input(self, rate_Hz: float, cycles: int) -> None:
        with pytest.raises(ValueError, match=r"\(=.*\) must be"):
            wake_up_lateness_ns(rate_Hz, cycles)

    @pytest.mark.parametrize(("worst_us", "status"), [(499, OK), (500, OK), (501, NOTE), (3000, NOTE)])
    def test_the_worst_decides(
        self, virtual_config: Config, worst_us: int, status: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        late = np.array([10_000] * 99 + [worst_us * 1000])
        monkeypatch.setattr(health, "wake_up_lateness_ns", lambda rate, cycles: late)
        found = next(wake_up(virtual_config, 100))
        assert found.status == status
        assert (found.numbers["p50_us"], found.numbers["max_us"]) == (10.0, worst_us)
        assert bool(found.remedy) == (status == NOTE)


class TestCache:
    def test_no_folder(self) -> None:
        (found,) = kernel_cache(None, False)
        assert found.status == PROBLEM
        assert "JOINTCTL_CACHE_DIR" in found.remedy

    def test_cold_is_not_started_unless_asked(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        started: list[Path | None] = []
        monkeypatch.setattr(health, "start_time_s", lambda cache: float(not started.append(cache)))
        (found,) = kernel_cache(tmp_path, False)
        assert (found.status, found.numbers["warm"], started) == (NOTE, False, [])
        write(tmp_path, "firmware_py_1/run_loop-0123456789ab.entry", "12345678")
        found, warm = kernel_cache(tmp_path, False)
        assert (found.status, found.numbers) == (OK, {"files": 1, "bytes": 8, "warm": True})
        assert (warm.topic, warm.numbers, started) == ("warm start", {"start_s": 1.0}, [None])
        assert [f.topic for f in kernel_cache(tmp_path, True)] == ["kernel cache", "warm start", "cold start"]
        assert isinstance(started[-1], Path)
        assert started[-1] != tmp_path
        found = list(kernel_cache(tmp_path / "firmware_py_2", True))
        assert [f.topic for f in found] == ["kernel cache", "cold start", "warm start"]
        assert started[-1] == started[-2]  # warm, because the cold start has just filled it

    def test_a_start_that_fails_is_a_problem(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def failing(cache: Path | None) -> float:
            raise subprocess.CalledProcessError(1, "python", stderr=b"Traceback\nImportError: no numba\n")

        monkeypatch.setattr(health, "start_time_s", failing)
        write(tmp_path, "x/run_loop-0123456789ab.entry", "1")
        assert list(kernel_cache(tmp_path, False))[1].text == "the loop cannot be started: ImportError: no numba"

    def test_the_probe_gets_the_other_cache(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        calls: list[dict[str, Any]] = []
        monkeypatch.setattr(health.subprocess, "run", lambda command, **rest: calls.append(rest))
        monkeypatch.setenv("JOINTCTL_CACHE_DIR", "unchanged")
        assert health.start_time_s() >= 0.0
        assert health.start_time_s(tmp_path) >= 0.0
        assert [call["env"]["JOINTCTL_CACHE_DIR"] for call in calls] == ["unchanged", str(tmp_path)]
        assert calls[0]["check"]


# Cores are kept awake only while the block lasts; without the right, the refusal is told and nothing else happens.
def open_files() -> set[str]:
    return {
        os.readlink(f"/proc/self/fd/{fd}")
        for fd in os.listdir("/proc/self/fd")
        if os.path.exists(f"/proc/self/fd/{fd}")
    }


def test_zero_latency_is_asked_for_and_held_until_the_block_ends_or_fails(tmp_path: Path) -> None:
    device = tmp_path / "latency"
    device.touch()
    with pytest.raises(ZeroDivisionError), cores_awake(device) as refused:  # noqa: PT012
        assert refused == ""
        assert device.read_bytes() == b"\0\0\0\0"
        assert str(device) in open_files()
        _ = 1 / 0
    assert str(device) not in open_files()


def test_a_refusal_is_told(tmp_path: Path) -> None:
    with cores_awake(tmp_path / "absent") as refused:
        assert refused == f"{tmp_path / 'absent'}: No such file or directory"
    with cores_awake(Path("/dev/full")) as refused:
        assert refused == "/dev/full: No space left on device"

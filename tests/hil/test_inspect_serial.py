"""doctor, info and monitor on a serial drive: they read, tell what is amiss, and write nothing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.port_users import port_users
from jointctl.tools.inspection.elmo_health import latency_finding, port_finding
from jointctl.tools.inspection.health import NOTE, OK, PROBLEM


def findings(finished: Any) -> dict[str, Any]:
    return {row["topic"]: row for row in json.loads(finished.out)["findings"]}


def assert_untouched(bench: Any) -> None:
    m = bench.device.interpreter.m
    assert (int(m.motor_on), int(m.unit_mode), float(m.peak_A)) == (0, 5, 10.0)  # as after power-on


def test_info_tells_everything_in_words_and_in_units_of_the_joint(serial_bench: Any) -> None:
    serial_bench.device.interpreter.m.motor_fault = 0x20000
    finished = serial_bench.bench.run("info", serial_bench.config(), "--json")
    assert finished.code == 0, finished.err
    told = json.loads(finished.out)
    facts = {fact["name"]: fact for fact in told["facts"]}
    assert told["version"].startswith("Whistle")
    assert facts["PX"]["number"] == pytest.approx(0.1, abs=1e-3)
    assert facts["HL[2]"]["number"] == pytest.approx(10.0, abs=1e-3)
    assert facts["PL[1]"]["meaning"] == "121 Nm"
    assert "overspeed" in facts["MF"]["meaning"]
    assert "fault latched" in facts["SR"]["meaning"]
    assert facts["EC"]["meaning"] == "none"
    assert facts["SN[4]"]["meaning"].startswith("not reported: EC")  # firmwares differ: no failure
    assert serial_bench.bench.run("info", "serial.toml").out.count("\n") > len(facts)
    assert_untouched(serial_bench)


def test_monitor_asks_again_and_again(serial_bench: Any) -> None:
    finished = serial_bench.bench.run("monitor", serial_bench.config(), "--json", "--count", "3")
    lines = [json.loads(line) for line in finished.out.splitlines()]
    assert [round(line["position_rad"], 3) for line in lines] == [0.1] * 3
    assert lines[0]["text"] == "servo off, UM 5"
    serial_bench.device.interpreter.m.motor_fault = 0x200000
    finished = serial_bench.bench.run("monitor", "serial.toml", "--duration", "0.5", "--changes")
    assert finished.out.count("\n") == 1
    assert "motor stuck" in finished.out
    assert_untouched(serial_bench)


def test_doctor_measures_the_line_and_reads_the_drive(serial_bench: Any) -> None:
    finished = serial_bench.bench.run("doctor", serial_bench.config(), "--json")
    found = findings(finished)
    assert found["serial port"]["status"] == OK
    assert found["line budget"]["numbers"]["highest_rate_Hz"] == pytest.approx(202.1, abs=0.1)
    # a bound by the characters alone: no computer is faster than the line
    assert found["round trip"]["numbers"]["cycle_s"] > 40 * 10 / 115_200
    assert "echo on" in found["drive limits"]["text"]
    assert found["drive state"]["text"] == "servo off, UM 5"
    assert "bus budget" not in found
    assert_untouched(serial_bench)


def test_doctor_tells_a_wrong_baud_rate_and_a_fault(serial_bench: Any) -> None:
    wrong = serial_bench.bench.run("doctor", serial_bench.config(drive__baud_rate_bitps=230_400), "--json")
    assert wrong.code == 1
    assert findings(wrong)["drive"]["remedy"].startswith("most likely the baud rate")
    serial_bench.device.interpreter.m.motor_fault = 0x1
    fault = findings(serial_bench.bench.run("doctor", serial_bench.config(), "--json"))["drive state"]
    assert (fault["status"], "feedback" in fault["text"], "clear-fault" in fault["remedy"]) == (PROBLEM, True, True)


def test_while_a_run_has_the_line_they_say_so(serial_bench: Any) -> None:
    run = serial_bench.bench.start("run", serial_bench.config(), "-y").saw("  tracking")
    for verb in ("info", "monitor"):
        finished = serial_bench.bench.run(verb, "serial.toml")
        finished.refused(4, "a run has", f"pid {run.process.pid}", "one user at a time")
    assert "a run has" in findings(serial_bench.bench.run("doctor", "serial.toml", "--json"))["drive"]["text"]
    assert run.process.poll() is None


def test_a_port_is_named_with_what_is_wrong_with_it(tmp_path: Path) -> None:
    assert "No such file" in port_finding(str(tmp_path / "none")).text
    (tmp_path / "file").write_text("")
    assert "is no device" in port_finding(str(tmp_path / "file")).text
    assert port_finding("/dev/null").status in (OK, NOTE)


def test_without_permission_the_group_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    finding = port_finding("/dev/null")
    assert (finding.status, "dialout" in finding.remedy) == (PROBLEM, True)


@pytest.mark.parametrize(("latency", "status"), [("1", OK), ("2", PROBLEM), ("16", PROBLEM), (None, OK)])
def test_the_latency_timer_of_an_adapter(tmp_path: Path, latency: str | None, status: str) -> None:
    folder = tmp_path / "sys/bus/usb-serial/devices/ttyUSB7"
    folder.mkdir(parents=True)
    if latency is not None:
        (folder / "latency_timer").write_text(latency + "\n")
    finding = latency_finding("/dev/ttyUSB7", tmp_path)
    assert finding.status == status
    assert ("latency_timer" in finding.remedy) == (status == PROBLEM)


def test_users_of_a_port_are_found_and_the_maker_of_a_terminal_is_none() -> None:
    leader, follower = os.openpty()
    path = os.ttyname(follower)
    program = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", program, path], **pipes) as other:  # type: ignore[call-overload]
        other.stdout.readline()
        found = port_users(path)
        other.stdin.close()
    assert [user.pid for user in found] == [other.pid]
    assert port_users(path) == []
    os.close(leader)
    os.close(follower)

"""The plain Python loop over a serial CAN adapter: `slcan` of python-can on a pty, its far end on the virtual bus.

An adapter of this kind serves one program at a time: commissioning hands it to the loop and takes it back.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import signal
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from tests.configurations import SLOW_LOOP
from tests.hil.serial_bench import end_line_guards


class SlcanAdapter:
    """The firmware of a serial CAN adapter (Lawicel's ASCII protocol): C, O, L, S0..S8, V, N, t, T, r, R.

    `port` is what programs open: a link, so that it can be gone.  `opened` counts O commands, `rates` keeps the S
    commands; frames pass while open.  `loose`: who has opened the CAN channel is the last one that finds the port.
    """

    def __init__(self, channel: str, port: Path) -> None:
        self._master, self._slave = pty.openpty()  # the slave stays open here: a program that leaves is no hang-up
        tty.setraw(self._slave)
        end_line_guards(os.ttyname(self._slave))  # of a test that had a terminal of this name before
        self._link = port
        self.loose = False
        self.plug_in()
        self.port = str(port)
        self._bus = can.Bus(interface="jointctl", channel=channel)
        self._open = False
        self.opened = 0
        self.rates: list[str] = []
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._threads = [threading.Thread(target=target, daemon=True) for target in (self._from_host, self._from_bus)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(5.0)
        self._bus.shutdown()
        os.close(self._master)
        os.close(self._slave)

    def plug_in(self) -> None:
        self._link.symlink_to(os.ttyname(self._slave))

    def _write(self, data: bytes) -> None:
        with self._lock:
            os.write(self._master, data)

    def _from_host(self) -> None:
        waiting = b""
        while not self._ended.is_set():
            if not select.select([self._master], [], [], 0.1)[0]:
                continue
            waiting += os.read(self._master, 4096)
            *lines, waiting = waiting.split(b"\r")
            for line in lines:
                self._write(self._answer(line.decode()))

    def _answer(self, line: str) -> bytes:
        command = line[:1]
        if command in ("O", "L"):
            self._open, self.opened = True, self.opened + 1
            if self.loose:
                self.loose = False
                self._link.unlink()
        elif command == "C":
            self._open = False
        elif command == "S":
            self.rates.append(line)
        elif command == "V":
            return b"V1013\r"
        elif command == "N":
            return b"N0001\r"
        elif command in ("t", "r", "T", "R") and self._open:
            digits = 3 if command in "tr" else 8
            length = int(line[1 + digits])
            data = None if command in "rR" else bytes.fromhex(line[2 + digits : 2 + digits + 2 * length])
            message = can.Message(
                arbitration_id=int(line[1 : 1 + digits], 16), is_extended_id=digits == 8, is_remote_frame=data is None,
                dlc=length, data=data,
            )  # fmt: skip
            self._bus.send(message, 0.1)
            return b"z\r" if digits == 3 else b"Z\r"
        elif command:
            return b"\a"
        return b"\r"

    def _from_bus(self) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(can.CanError):
                message = self._bus.recv(0.1)
                if message is not None and self._open and not message.is_extended_id:
                    text = f"t{message.arbitration_id:03X}{message.dlc}{bytes(message.data).hex().upper()}\r"
                    self._write(text.encode())


@pytest.fixture
def config(bench: Any) -> str:
    return bench.config(bus__bitrate_bitps=500_000, **SLOW_LOOP)


@pytest.fixture
def adapter(bench: Any, config: str) -> Iterator[SlcanAdapter]:
    bench.joint(config)
    adapter = SlcanAdapter(bench.channel, bench.folder / "ttyACM0")
    yield adapter
    adapter.close()


def over(adapter: SlcanAdapter) -> tuple[str, ...]:
    return ("-i", "slcan", "-c", adapter.port)


def test_a_run_over_slcan(bench: Any, config: str, adapter: SlcanAdapter) -> None:
    done = bench.run("run", config, "-y", *over(adapter))
    assert done.code == 0, done.err
    assert "plain Python loop over slcan" in done.err
    assert "holds" in done.err
    assert set(adapter.rates) == {"S6"}  # 500 kbit/s
    assert adapter.opened >= 3  # commissioning, the loop, making safe: one after the other
    records = bench.log().records
    tracking = records[records.phase == 3]
    assert len(tracking) > 10
    assert (records.fault == 0).all()
    assert bench.disabled()


def longer(bench: Any, config: str) -> str:
    """A run that somebody has to end."""
    path = bench.folder / config
    path.write_text(path.read_text().replace("duration_s = 1.0", "duration_s = 30.0"))
    return config


def test_a_killed_loop_over_slcan_is_made_safe(bench: Any, config: str, adapter: SlcanAdapter) -> None:
    run = bench.start("run", longer(bench, config), "-y", *over(adapter)).saw("tracking")
    os.kill(run.child("loop_process"), signal.SIGKILL)
    run.finished(60.0).refused(7, "killed by signal 9", "switch on disabled")
    assert bench.disabled()


def test_others_are_kept_off_the_adapter_but_not_stop(bench: Any, config: str, adapter: SlcanAdapter) -> None:
    run = bench.start("run", longer(bench, config), "-y", *over(adapter)).saw("tracking")
    opened = adapter.opened
    scan = bench.run("scan", *over(adapter), "-b", "500000")
    scan.refused(4, "in use by another program", "pid")
    assert adapter.opened == opened
    assert run.process.poll() is None
    stop = bench.run("stop", config, *over(adapter))
    ended = run.finished(60.0)
    assert ended.code != 0
    assert "Traceback" not in ended.err + stop.err
    assert bench.disabled()


def test_an_adapter_that_is_gone_when_the_loop_opens_it(bench: Any, config: str, adapter: SlcanAdapter) -> None:
    adapter.loose = True
    ended = bench.run("run", config, "-y", *over(adapter))
    ended.refused(
        7, "loop process ended with code 4", "no such device: slcan", "cannot be opened again", "own watchdog"
    )
    assert bench.disabled()


def test_its_twin_is_back_when_the_drive_is_made_safe(bench: Any, config: str, adapter: SlcanAdapter) -> None:
    adapter.loose = True
    run = bench.start("run", config, "-y", *over(adapter)).saw("loop: no such device")
    adapter.plug_in()
    ended = run.finished(60.0)
    ended.refused(7, "loop process ended with code 4", "drive state now: switch on disabled")
    assert "own watchdog" not in ended.err
    assert bench.disabled()


def test_scan_and_info_over_slcan(bench: Any, adapter: SlcanAdapter) -> None:
    scan = bench.run("scan", *over(adapter), "-b", "500000", "--listen", "0.2")
    assert (scan.code, "jointctl virtual joint" in scan.out) == (0, True), scan
    info = bench.run("info", *over(adapter), "-b", "500000", "-t", "1")
    assert (info.code, "Max torque" in info.out) == (0, True), info

"""The plain Python loop with the virtual joint: "virtual" of python-can in threads, udp_multicast in processes.

The multicast group has the scope of this computer's own interface (ff11::), so that nothing goes out on the network.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import struct
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from jointctl.drivers.can.open import open_python_can
from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.session.loop_memory import SharedBlock
from jointctl.tools.session.portable_loop import run_portable_loop, warm_up
from jointctl.tools.virtual_joint import PumpedDevice, new_device, serve_virtual_joint
from tests.configurations import SLOW_LOOP, written
from tests.sessions import constants_of

RATE_HZ = SLOW_LOOP["loop__rate_Hz"]
PERIOD_NS = round(1e9 / RATE_HZ)


@pytest.fixture
def config(tmp_path: Path) -> Config:
    """The shipped virtual joint with a loop at 100 Hz."""
    bus = {"bus__interface": "virtual", "bus__channel": f"portable-{os.getpid()}-{time.monotonic_ns()}"}
    return load_config(written(tmp_path / "joint.toml", **{**SLOW_LOOP, **bus, "trajectory__duration_s": 1.0}))


def open_bus(config: Config) -> can.BusABC:
    return open_python_can(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps)


def read_device_type(bus: can.BusABC, node: int) -> int | None:
    bus.send(can.Message(arbitration_id=0x600 + node, is_extended_id=False, data=bytes([0x40, 0, 0x10, 0, 0, 0, 0, 0])))
    give_up = time.monotonic() + 5.0
    while time.monotonic() < give_up:
        message = bus.recv(0.1)
        if message is not None and message.arbitration_id == 0x580 + node:
            return int(struct.unpack_from("<I", message.data, 4)[0])
    return None


class TestPump:
    def test_boots_answers_and_stops(self, config: Config) -> None:
        with contextlib.closing(_Closing(open_bus(config))) as client:
            with serve_virtual_joint(config) as joint:
                assert isinstance(joint, PumpedDevice)
                assert read_device_type(client.bus, config.drive.node) == 0x00020192
                with pytest.raises(RuntimeError, match="running already"):
                    joint.start()
            assert joint.words[2] == 1
            client.drain()
            client.bus.send(can.Message(arbitration_id=0x601, is_extended_id=False, data=b"\x40\x00\x10\0\0\0\0\0"))
            assert client.bus.recv(0.1) is None

    def test_frames_that_are_no_classic_can_are_ignored(self, config: Config) -> None:
        with contextlib.closing(_Closing(open_bus(config))) as client, serve_virtual_joint(config) as joint:
            client.bus.send(can.Message(arbitration_id=0x601, is_fd=True, is_extended_id=False, data=bytes(12)))
            assert read_device_type(client.bus, config.drive.node) == 0x00020192
            assert joint.words[2] == 0

    @pytest.mark.parametrize("errors", [3, 10_000])
    def test_only_a_bus_that_stays_dead_ends_it(self, config: Config, errors: int) -> None:
        bus = _FailingBus(errors)
        with PumpedDevice(new_device(config), bus) as joint:
            give_up = time.monotonic() + 10.0
            while bus.received < errors + 5 and joint.words[2] == 0 and time.monotonic() < give_up:
                time.sleep(0.01)
            assert joint.words[2] == (2 if errors > 100 else 0)
        assert joint.words[1] >= 1  # the boot-up message was lost


class _Closing:
    """A bus of the test."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus

    def drain(self) -> None:
        while self.bus.recv(0.0) is not None:
            pass

    def close(self) -> None:
        self.bus.shutdown()


class _FailingBus:
    """Takes nothing, and fails to receive for a while."""

    def __init__(self, errors: int) -> None:
        self._errors = errors
        self.received = 0

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("full")

    def recv(self, timeout: float | None = None) -> None:
        self.received += 1
        if self.received <= self._errors:
            raise can.CanOperationError("down")
        time.sleep(0.001)


def test_a_run_in_threads_on_the_bus_of_one_process(config: Config) -> None:
    warm_up()
    block = SharedBlock.create(1, CanopenPort)
    with contextlib.closing(_Closing(open_bus(config))) as loop_end, serve_virtual_joint(config):
        drive = CanopenDrive(open_bus(config), canopen_settings(config))
        try:
            report = drive.commission()
            block.constants[:] = constants_of(config, start_position_rad=report.start_position_rad)
            reset_axis(block.constants[0], block.state[0])
            block.port[:] = drive.port()
            block.words[Word.SUPERVISOR_NS] = time.monotonic_ns()
            loop_end.drain()  # as the loop process does until the run begins: boot-up and the watchdog's proof
            drive.start_cyclic()
            arguments = (loop_end.bus, block, PERIOD_NS, 6_000_000, 2000)
            thread = threading.Thread(target=run_portable_loop, args=arguments)
            thread.start()
            while thread.is_alive():
                block.words[Word.SUPERVISOR_NS] = time.monotonic_ns()
                thread.join(0.02)
            assert (block.state[0].phase, block.state[0].fault) == (AxisPhase.FINISHED, Fault.NONE)
            assert drive.make_safe() == "switch on disabled"
        finally:
            drive.close()
    records = block.ring[: int(block.words[Word.HEAD])]
    tracking = records[records.phase == AxisPhase.TRACKING]
    assert len(tracking) > 10
    assert abs(tracking.error_rad).max() < 0.3
    assert abs(records.measured_torque_Nm).max() > 1.0
    os.close(block.fd)


# --- two processes on udp_multicast ---
@pytest.fixture
def multicast(bench: Any) -> Iterator[str]:
    """One session of tests at a time: every multicast group of one port shares the frames."""
    with open(Path(tempfile.gettempdir()) / f"jointctl-multicast-{os.getuid()}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        bus = {"bus__interface": "udp_multicast", "bus__channel": "ff11::7079:7468"}
        yield bench.config(**{**SLOW_LOOP, **bus, "trajectory__duration_s": 1.0})
        bench.end()


def test_the_whole_run_over_udp_multicast(bench: Any, multicast: str) -> None:
    joint = bench.joint_process(multicast)
    done = bench.run("run", multicast, "-y", "--json")
    assert done.code == 0, done.err
    assert "plain Python loop over udp_multicast" in done.err
    result = json.loads(done.out)
    assert result["fault"] is None
    assert result["drive_state"] == "switch on disabled"
    assert 1.0 - (2 + result["skipped_cycles"]) / RATE_HZ <= result["tracked_s"] <= 1.0 + 2.0 / RATE_HZ
    assert result["error"]["range_rad"]["greatest"] < 0.3
    assert 0.0 < result["bus_load"] < 0.05  # 285 bits at 100 Hz on 1 Mbit/s; own echoes would double it
    joint.signal(signal.SIGTERM)
    assert joint.finished(10.0).code == 0


def test_a_killed_loop_ends_disabled_by_the_drives_own_watchdog(bench: Any, multicast: str) -> None:
    bench.joint_process(multicast)
    run = bench.start("run", multicast, "-y").saw("\n  approach\n")
    os.kill(run.child("loop_process"), signal.SIGKILL)
    done = run.finished(60.0)
    done.refused(7, "killed by signal 9")
    assert "switch on disabled" in done.err or "fault" in done.err


def test_an_interrupt_ramps_down(bench: Any, multicast: str) -> None:
    bench.joint_process(multicast)
    run = bench.start("run", multicast, "-y", "--json").saw("\n  tracking\n")
    run.signal(signal.SIGINT)
    done = run.finished(60.0)
    assert done.code == 130, done.err
    assert json.loads(done.out)["drive_state"] == "switch on disabled"
    assert "ramping" in done.err

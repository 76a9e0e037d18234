"""The loop in plain Python, for python-can interfaces that the compiled loop cannot read: same kernels, same memory.

`drivers.canopen.cyclic` makes and takes the frames, and the cycle is that of the compiled loop (`firmware_py.cycle`) as
plain Python; only waiting, sending and receiving are written here.  The supervisor cannot tell the two loops apart.

Limits; the figures are of a 2-core virtual machine over udp_multicast, virtual joint in a second Python process:
* Round trip and work take about 0.5 ms of a cycle (p99 0.65 ms).  Idle, and with SCHED_FIFO also beside three busy
  processes, 200 and 500 Hz held: no slot skipped, wake-up p99 0.06 ms, worst 3.9 ms.  1000 Hz skipped 3 of 5368.
* Without SCHED_FIFO beside the same load 200 Hz held with a wake-up p99 of 2.3 ms, but 500 Hz skipped 993 of 2738 and
  used samples up to 5 cycles old; load inside the process makes Python late by tens of ms (p99 38-57 ms).
  Slots are then skipped, the phase of the schedule is kept, and skipped_max_s and sample_age_max_s decide whether the
  run goes on.  An adapter adds its own latency, so that more than HIGHEST_RATE_HZ is refused.
* Many adapters serve one program at a time: commissioning hands the bus to this loop and takes it back, so that
  `jointctl stop`, `monitor` and `log.frames` beside the run need an interface that several programs can open.
* An interface that blocks in `send` or `recv` in spite of the time-out delays the cycle; the heartbeat then stays away
  and the drive stops the joint by itself.
* The sleep is clock_nanosleep of Linux: other operating systems are not served yet.
* "virtual" of python-can lives within one process, and the loop is a process of its own: it reaches nobody there.
"""

from __future__ import annotations

import contextlib
import os
import time
from typing import Protocol

import can
import numpy as np

from jointctl.drivers.can.frames import ERROR_FLAG, Frame
from jointctl.drivers.can.virtual_bus import decode, encode
from jointctl.drivers.canopen.cyclic import (
    FRAME_SLOTS,
    SLOT_OFFSET,
    SLOT_RECEIVED,
    SLOT_RPDO,
    SLOT_SYNC,
    CanopenPort,
    accept_frame,
    answer_owed,
    begin_cycle,
    end_cycle,
    note_wake,
)
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.cycle import Clock, Exchange, Histogram, run_cycles, slept_ns
from jointctl.firmware_py.libc import NANOSECONDS, sleep_until_ns
from jointctl.firmware_py.schema import INT32_MAX, new
from jointctl.firmware_py.states import DriveRequest
from jointctl.tools.session.loop_memory import FOREVER, SharedBlock, quantile_s

HIGHEST_RATE_HZ = 500.0
PROBE_PERIOD_NS, PROBE_CYCLES = 2_000_000, 100
_FRAMES_AT_ONCE = 256  # a flooded bus must not keep a cycle from its end
_UNKNOWN_ERROR = 5  # EIO


def check_portable_rate(interface: str, rate_Hz: float) -> None:
    """Refuse a rate that plain Python does not hold."""
    if rate_Hz > HIGHEST_RATE_HZ:
        raise ConfigurationError(
            f"loop.rate_Hz (={rate_Hz:g}) must be at most {HIGHEST_RATE_HZ:g} over bus.interface (={interface}): "
            "this interface runs in the plain Python loop",
            "socketcan and jointctl run in the compiled loop",
        )


def portable_note(interface: str, rate_Hz: float, held_Hz: float) -> str:
    """What the user should know when this loop starts; `held_Hz` as measured."""
    short = "" if rate_Hz <= held_Hz else f", LESS than loop.rate_Hz (={rate_Hz:g}): expect skipped cycles"
    return (
        f"plain Python loop over {interface}: this computer holds about {held_Hz:.0f} Hz now{short}; "
        f"expect wake-ups late by tens of ms under load; rate limited to {HIGHEST_RATE_HZ:g} Hz"
    )


def held_rate_Hz(receive_share: float) -> float:
    """The rate at which wake-up and work, at their 99th percentile, leave `receive_share` of a period to the drive.

    Measured for a fifth of a second on a bus that takes everything; the adapter's own latency comes on top.
    """
    block = SharedBlock.create(1, CanopenPort)
    try:
        run_portable_loop(_SilentBus(), block, PROBE_PERIOD_NS, 0, max_cycles=PROBE_CYCLES)
        busy_s = sum(quantile_s(block.histograms[row]) for row in (Histogram.WAKE, Histogram.WORK))
    finally:
        os.close(block.fd)
    return min(HIGHEST_RATE_HZ, (1.0 - receive_share) / busy_s)


class FrameBus(Protocol):
    """What the loop needs of a python-can bus."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None: ...
    def recv(self, timeout: float | None = None) -> can.Message | None: ...


class PortableExchange:
    """`drivers.canopen.exchange` on a python-can bus.  Nothing that the bus raises gets out: it counts as a bus error.
    The link of its `receive` and `send` is None.

    A cycle fails if a frame could not be sent, receiving failed, or an error frame came; `port.consecutive_failures`
    and `sample.bus_errors` count failed cycles in a row.
    """

    def __init__(self, bus: FrameBus, block: SharedBlock, period_ns: int, receive_ns: int) -> None:
        self._bus = bus
        self._ports, self._samples, self._commands = block.port, block.sample, block.command
        self._axes = list(zip(block.port, block.sample, block.command, strict=True))
        self._frames = new(Frame, FRAME_SLOTS)
        self._received = self._frames[SLOT_RECEIVED]
        self._bytes = self._frames.view(np.uint8).reshape(FRAME_SLOTS, -1)
        self._send_timeout_s = 0.25 * period_ns / NANOSECONDS
        self._least_wait_ns = receive_ns // 2
        self._failed = False
        # some interfaces echo a program's own frames; counted again, they would double the bus load
        names = ("sync_id", "rpdo_id", "offset_rpdo_id", "own_heartbeat_id")
        self._own = frozenset(int(identifier) for name in names for identifier in self._ports[name])

    def _fail(self, error: Exception) -> None:
        code = getattr(error, "error_code", None) or getattr(error, "errno", None)
        self._ports.last_errno = code if isinstance(code, int) and abs(code) <= INT32_MAX else _UNKNOWN_ERROR
        self._failed = True

    def _send(self, slot: int) -> None:
        message = decode(self._bytes[slot].tobytes(), 0.0, "")
        assert message is not None  # what the codec makes is a frame
        try:
            self._bus.send(message, self._send_timeout_s)
        except Exception as error:  # a third-party interface may raise anything; with torque applied the loop goes on
            self._ports.send_failures += 1
            self._fail(error)

    def _receive(self, timeout_s: float) -> can.Message | None:
        try:
            message: can.Message | None = self._bus.recv(timeout_s)
        except Exception as error:  # as above
            self._fail(error)
            return None
        return message

    def _accept(self, message: can.Message, now_ns: int) -> bool:
        """True if it was a TPDO with a new sample."""
        if message.is_error_frame:
            self._received.can_id = ERROR_FLAG
            self._received.length = 0
            self._failed = True
        elif message.is_fd or message.arbitration_id in self._own:
            return False
        else:
            try:
                self._bytes[SLOT_RECEIVED] = np.frombuffer(encode(message), np.uint8)
            except ValueError:  # no classic CAN frame
                self._ports.malformed += 1
                return False
        found = False
        for port, sample, _ in self._axes:
            found |= bool(accept_frame(port, self._received, sample, now_ns))
        return found

    def receive(self, link: None, samples: np.ndarray, now_ns: int, until_ns: int) -> int:
        """Send SYNC and wait for the TPDOs until `until_ns`, half the window at least; returns the time waited [ns].

        Frames that came since the last cycle are taken first, so that a late TPDO is not mistaken for the answer.
        The least wait keeps a late wake-up from costing the sample as well.
        """
        for port, _, _ in self._axes:
            note_wake(port, now_ns)
        for _ in range(_FRAMES_AT_ONCE):
            message = self._receive(0.0)
            if message is None:
                break
            self._accept(message, now_ns)
        owed = self._owed()  # as in `drivers.canopen.exchange`
        for slot in range(SLOT_SYNC, self._begin()):
            self._send(slot)
        started_ns = arrived_ns = time.monotonic_ns()
        until_ns = max(until_ns, started_ns + self._least_wait_ns)
        while arrived_ns < until_ns:
            answer = self._receive((until_ns - arrived_ns) * 1e-9)
            arrived_ns = time.monotonic_ns()
            if answer is None or (self._accept(answer, arrived_ns) and not owed and not self._owed()):
                break  # time-out, failure, or the sample
        for port, sample, _ in self._axes:
            port.consecutive_failures = port.consecutive_failures + 1 if self._failed else 0
            sample.bus_errors = port.consecutive_failures
        self._failed = False
        return arrived_ns - started_ns

    def _owed(self) -> bool:
        return any(answer_owed(port) for port, _, _ in self._axes)

    def _begin(self) -> int:
        return int(min([begin_cycle(port, self._frames) for port, _, _ in self._axes]))

    def send(self, link: None, samples: np.ndarray, commands: np.ndarray) -> int:
        """Send the RPDO of each drive; a failure counts in the next cycle."""
        for port, sample, command in self._axes:
            end_cycle(port, self._frames, sample, command)
            if port.offset_rpdo_id:
                self._send(SLOT_OFFSET)
            self._send(SLOT_RPDO)
        return 0

    def switch_off(self) -> None:
        """RPDOs with controlword 0 (disable voltage), and the SYNC at which a synchronous RPDO takes effect."""
        self._commands.request = DriveRequest.OFF
        self._commands.torque_Nm = 0.0
        with contextlib.suppress(Exception):
            self.send(None, self._samples, self._commands)
            self._begin()
            self._send(SLOT_SYNC)


def throw_away(bus: FrameBus) -> None:
    """What waits at the bus; a bus that fails is reported by the loop."""
    with contextlib.suppress(Exception):
        while bus.recv(0.0) is not None:
            pass


def run_portable_loop(
    bus: FrameBus, block: SharedBlock, period_ns: int, receive_ns: int, max_cycles: int = FOREVER
) -> int:
    """The compiled loop's `run_cycles` in plain Python on a python-can bus: until FINISHED or `max_cycles` slots.

    `block.port` must have its identifiers by now.  Should anything raise, the drive gets "disable voltage" once,
    no heartbeat follows, so that its consumer stops the joint even if it did not hear, and the exception goes on.
    """
    can_exchange = PortableExchange(bus, block, period_ns, receive_ns)
    exchange = Exchange(can_exchange.receive, can_exchange.send, None)
    clock = Clock(lambda _: time.monotonic_ns(), slept_ns)
    try:
        return run_cycles(block.memory(), exchange, clock, sleep_until_ns, period_ns, receive_ns, max_cycles)
    except BaseException:
        can_exchange.switch_off()
        raise


class _SilentBus:
    """Takes everything and has nothing to say."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        pass

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return None


def warm_up() -> None:
    """Compile or load every kernel of the loop, on memory of its own and without a bus."""
    block = SharedBlock.create(1, CanopenPort)
    try:
        accept_frame(block.port[0], new(Frame)[0], block.sample[0], 0)
        block.sample[:] = np.zeros_like(block.sample)
        run_portable_loop(_SilentBus(), block, 1_000_000, 0, max_cycles=1)
    finally:
        os.close(block.fd)

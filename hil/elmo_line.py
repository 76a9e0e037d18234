"""The virtual Elmo drive on a pseudo-terminal, in real time and with the times of a serial line.

`line.path` is what a program opens as its serial port.  A character takes ten bits in either direction: a command acts
when its last character has arrived, its echo and reply come as fast as the baud rate allows.  The characters of a
reply are handed over together when its last one is due, because nobody acts on half a reply.  If the program has
set another baud rate than the drive's, every character is garbled in both directions.

The drive goes on without the program, as a real one does: with the line cut it keeps its last torque command.

Not modelled: parity and framing errors, the latency timer of USB adapters, overrun of the drive's receive buffer
(bounded here to `RECEIVE_MAX` characters, later ones are lost).
"""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import time
import tty
from collections import deque
from dataclasses import dataclass

from jointctl.hil.elmo_drive import ElmoInterpreter

BITS_PER_CHARACTER = 10
RECEIVE_MAX = 512
LONGEST_WAIT_S = 0.005
TURNAROUND_S = 100e-6  # from a command to its reply
_CR, _SEMICOLON = 0x0D, 0x3B
_GARBLED_IN, _GARBLED_OUT = 0xA5, 0xD2  # different, or the echo would come back whole
_SPEEDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[:1] == "B" and name[1:].isdigit()}


@dataclass
class LineFaults:
    """What is wrong with the line; may be changed while it runs."""

    mute: bool = False  # the drive says nothing at all
    garbage_every: int = 0  # every n-th reply has a character replaced; 0 = none
    half_every: int = 0  # every n-th reply ends early, without its `;`
    stuck_reply: bytes = b""  # every value reply is this one


class ElmoDevice:
    """A drive with its joint on a pseudo-terminal: `with ElmoDevice(interpreter, 115200) as device: device.path`."""

    def __init__(self, interpreter: ElmoInterpreter, baud_rate_bitps: int) -> None:
        self.interpreter = interpreter
        self.baud_rate_bitps = baud_rate_bitps
        self.faults = LineFaults()
        self.commands = 0
        self.last_command = b""
        self._character_s = BITS_PER_CHARACTER / baud_rate_bitps
        self._incoming: deque[tuple[float, int]] = deque()
        self._outgoing: deque[tuple[float, bytes]] = deque()
        self._received = bytearray()
        self._received_until_s = 0.0
        self._sent_until_s = 0.0
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._origin_s = 0.0
        self._master = self._slave = -1
        self.path = ""
        self.plug_in()

    # --- life ---

    def __enter__(self) -> ElmoDevice:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Compile if need be, then serve in a thread."""
        if self._thread is not None:
            raise RuntimeError("the device is running already")
        self._warm_up()
        self._origin_s = time.monotonic() - float(self.interpreter.state[0].time_s)
        self._thread = threading.Thread(target=self._run, name="elmo", daemon=True)
        self._thread.start()

    def _warm_up(self) -> None:
        """Compile or load everything on a copy: a first call in the middle of a run would stall the line."""
        real = self.interpreter
        copy = ElmoInterpreter(real.settings, real.constants.copy(), real.state.copy())
        for line in (b"UM=1", b"MO=1", b"TC=0", b"PX", b"ST", b"MO=0"):
            copy.execute(line)
        copy.advance_to(float(copy.state[0].time_s) + 1.5 * float(copy.constants[0].step_s))

    def stop(self) -> None:
        """End the thread and take the port away; the joint stays where it is."""
        if self._thread is not None:
            self._ended.set()
            self._thread.join()
            self._thread = None
        self.vanish()

    def vanish(self) -> None:
        """The adapter is unplugged: the port is gone, the drive goes on."""
        with self._lock:
            for fd in (self._master, self._slave):
                if fd >= 0:
                    with contextlib.suppress(OSError):
                        os.close(fd)
            self._master = self._slave = -1

    def plug_in(self) -> None:
        """The port (again), under a new `path`."""
        with self._lock:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self.path = os.ttyname(self._slave)

    def restart_drive(self) -> None:
        """The drive loses its supply for a moment."""
        with self._lock:
            self.interpreter.restart()
            self._incoming.clear()
            self._outgoing.clear()
            self._received.clear()

    # --- the line ---

    def _run(self) -> None:
        while not self._ended.is_set():
            with self._lock:
                now_s = time.monotonic()
                self._take(now_s)
                self._serve(now_s)
                self._advance(now_s)
                self._hand_over(now_s)
                wait_s = self._next_wait_s(time.monotonic())
                master = self._master
            if master < 0:
                self._ended.wait(LONGEST_WAIT_S)
                continue
            with contextlib.suppress(OSError, ValueError):
                select.select([master], [], [], wait_s)

    def _advance(self, time_s: float) -> None:
        self.interpreter.advance_to(time_s - self._origin_s)

    def _wrong_speed(self) -> bool:
        speed = termios.tcgetattr(self._slave)[5]
        # a terminal that nobody has set up yet says 38400; programs set it before they talk
        return _SPEEDS.get(speed, 0) != self.baud_rate_bitps

    def _take(self, now_s: float) -> None:
        """What the program has written, each character with the time at which it arrives."""
        if self._master < 0:
            return
        try:
            data = os.read(self._master, RECEIVE_MAX)
        except OSError:  # nothing there
            return
        garble = _GARBLED_IN if self._wrong_speed() else 0
        for byte in data[: RECEIVE_MAX - len(self._incoming)]:
            self._received_until_s = max(now_s, self._received_until_s) + self._character_s
            self._incoming.append((self._received_until_s, byte ^ garble))

    def _serve(self, now_s: float) -> None:
        while self._incoming and self._incoming[0][0] <= now_s:
            arrival_s, byte = self._incoming.popleft()
            if self.interpreter.echo:
                self._say(arrival_s, bytes((byte,)))
            if byte not in (_CR, _SEMICOLON):
                if len(self._received) < RECEIVE_MAX:
                    self._received.append(byte)
                continue
            line = bytes(self._received)
            self._received.clear()
            self._advance(arrival_s)
            self.commands += 1
            self.last_command = line
            reply = self._spoilt(self.interpreter.execute(line))
            self._say(arrival_s + TURNAROUND_S, reply)

    def _spoilt(self, reply: bytes) -> bytes:
        faults, number = self.faults, self.commands
        if faults.stuck_reply and len(reply) > 1:
            reply = faults.stuck_reply
        if faults.half_every and number % faults.half_every == 0:
            reply = reply[: len(reply) // 2]
        if faults.garbage_every and number % faults.garbage_every == 0 and reply:
            reply = b"\xfe" + reply[1:]
        return reply

    def _say(self, from_s: float, data: bytes) -> None:
        if not data or self.faults.mute:
            return
        self._sent_until_s = max(from_s, self._sent_until_s) + len(data) * self._character_s
        self._outgoing.append((self._sent_until_s, data))

    def _hand_over(self, now_s: float) -> None:
        due = b""
        while self._outgoing and self._outgoing[0][0] <= now_s:
            due += self._outgoing.popleft()[1]
        if due and self._master >= 0:
            if self._wrong_speed():
                due = bytes(byte ^ _GARBLED_OUT for byte in due)
            with contextlib.suppress(OSError):  # nobody reads: what does not fit is lost
                os.write(self._master, due)

    def _next_wait_s(self, now_s: float) -> float:
        """Until the next command is complete or the next reply is due."""
        times = [arrival_s for arrival_s, byte in self._incoming if byte in (_CR, _SEMICOLON)][:1]
        times += [due_s for due_s, data in self._outgoing if data[-1] == _SEMICOLON][:1]
        if not times and self._outgoing:
            times = [self._outgoing[-1][0]]
        if not times and self._incoming:
            times = [self._incoming[-1][0]]
        return min(max(min(times, default=now_s + LONGEST_WAIT_S) - now_s, 0.0), LONGEST_WAIT_S)

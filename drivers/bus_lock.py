"""One controller for each bus or serial line of a computer, how `jointctl stop` reaches it and ends its program.

A program that controls a bus holds its lock before it sends anything to the drive, until it ends: SYNC gives a
controller away only while its loop runs, not at commissioning nor while the user is asked.

The lock is an abstract Unix socket.  The kernel takes it back however the program ends, and it belongs to the network
namespace, as SocketCAN's interfaces do.  A thread answers on it, in single lines of JSON:

    {"ask": "who"}   ->  {"controls": NAME, "pid": 123}       and "starts": true while it looks for others itself
    {"ask": "stop"}  ->  {"controls": NAME, "pid": 123, "within_s": 8.0}   at once, after `on_stop` was called
                         and the connection is closed when the lock is given back
                         {"controls": NAME, "pid": 123, "refused": "..."}  to another user, root excepted

A name proves nothing: who holds it without that answer keeps no one off the bus, the lock then takes the next of its
names.  Of programs that start at the same moment, and so see each other, the one with the first of the names stays.

Each process of a controller also has a descriptor with the lock's name (`marker_fd`, a memory file), which the
kernel lists: so the processes are found though they hang, and though the one that answers has died.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import select
import selectors
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from jointctl.drivers.can.open import port_path
from jointctl.drivers.can.virtual_bus import socket_path
from jointctl.drivers.errors import BusError
from jointctl.drivers.port_users import keep_from_forks, program_name
from jointctl.drivers.stop_note import EXHAUSTED, LOCKS, remove_old, settle, stopped, write_note

# --- Unix sockets between programs of one computer: a name, the process at the other end, lines of JSON ---


ANSWER_S = 1.0  # a program that lives answers at once


def listener(address: bytes, waiting: int = 128) -> socket.socket:
    """A stream socket that holds `address` until it is closed; `OSError` where that cannot be, EADDRINUSE if taken."""
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        server.bind(address)
        server.listen(waiting)
    except OSError:
        server.close()
        raise
    return server


def process_behind(peer: socket.socket) -> tuple[int, int]:
    """(process, user) at the other end, as the kernel knows it."""
    pid, user, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return pid, user


def may_ask(peer: socket.socket) -> bool:
    """Whether the process at the other end is of this user or root."""
    _, user = process_behind(peer)
    return user in (os.geteuid(), 0)


def send_line(peer: socket.socket, message: dict[str, Any]) -> None:
    peer.sendall(json.dumps(message).encode() + b"\n")


def parsed_line(data: bytes) -> dict[str, Any] | None:
    """The message in a line; None where it is none."""
    try:
        message = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


# --- The lock ---


NAMES = 8  # of one lock: as many programs would have to hold the others
_RELEASE_S = 0.05  # a process that was just started holds a copy until it has become another program
_IN_PROCESS = "virtual"  # python-can's bus of this name ends with the process: no one else can be on it
_LONGEST = 256  # bytes of a request
_CALLERS = 64  # that are served at once; the oldest gives way
STOP_WITHIN_S = 8.0  # how long a program may take to end after a stop, unless it says otherwise


class BusLock(contextlib.AbstractContextManager["BusLock"]):
    """Held until `close`; `BusError` names the program that has it.  No lock where the system has no such sockets.

    `on_stop` is called in a thread of the lock when the user asks for a stop, once.  `remarks`: what was found and does
    not keep this program off.  `stopped`: whether the user has asked before it was held.  `name`: as `lock_name`.
    """

    def __init__(
        self, interface: str, channel: str, on_stop: Callable[[], None] | None = None, within_s: float = STOP_WITHIN_S
    ) -> None:
        self.marker_fd: int | None = None  # to be handed to every process that acts for this program
        self.remarks: list[str] = []
        self.stopped = False
        self._delivers = False  # whether a stop that comes reaches what the program does
        self._place = f"{interface}:{channel}"
        self._on_stop, self._within_s = on_stop, within_s
        self._server: socket.socket | None = None
        self._number = -1  # of the name that this lock has
        self._starts = True  # it may still leave to another one that starts
        self._thread: threading.Thread | None = None
        self._process = os.getpid()
        self.name = lock_name(interface, channel) if _has_lock(interface) else ""
        if not self.name:
            return
        try:
            self._take_free_name()
            self._wake, self._woken = socket.socketpair()
        except OSError as error:
            if self._server is not None:
                self._server.close()
            if error.errno in EXHAUSTED:
                raise
            self.stopped = stopped(self.name)  # no such sockets here
            return
        self._thread = threading.Thread(target=self._serve, name="bus lock", daemon=True)
        self._thread.start()
        try:
            self._refuse_others()
            self._starts = False
            self._marker = keep_from_forks(os.fdopen(os.memfd_create(self.name), "rb", buffering=0))
            self.marker_fd = self._marker.fileno()
            self.stopped = stopped(self.name)
        except BaseException:
            self.close()
            raise

    def deliver(self) -> None:
        """From now on the program does what a stop has asked for: those that have come need not be noted any more.

        Before, it may yet leave with an error that says nothing of a stop.
        """
        self._delivers = True

    def settle(self) -> None:
        """The program ends because of a stop, of this bus or of another one that it has: it knows of all of them."""
        if self.name:
            settle(self.name)

    def close(self) -> None:
        """Leave the bus to others; may be called twice.  A process that is forked has nothing of it to leave.

        The `_woken` that it inherits wakes the program's own thread: no stop would reach the program any more.
        """
        if os.getpid() != self._process:
            return
        if self._thread is not None:
            self._woken.send(b"x")
            self._thread.join()
            self._thread = None
            self._wake.close()
            self._woken.close()
        if self.marker_fd is not None:
            self._marker.close()
            self.marker_fd = None

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take_free_name(self) -> None:
        """The first name that no one has; others may have all of them."""
        for number in range(NAMES):
            try:
                self._server, self._number = keep_from_forks(listener(_address(self.name, number))), number
                return
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise

    def _refuse_others(self) -> None:
        """`BusError` where another controller has the bus, or processes of one that has died."""
        holders = _holders(self.name, but=self._number)
        with contextlib.ExitStack() as stack:
            for holder in holders:
                stack.callback(holder.close)
                holder.send("who")
            wait_for_answers(holders)
            for holder in holders:
                if holder.is_controller and not (0 <= self._number < holder.number and holder.gives_way()):
                    raise self._refusal(holder.pid, f"another program controls {self._place}")
            strangers = [holder.pid for holder in holders if not holder.left]
        if marked_processes(self.name):
            time.sleep(_RELEASE_S)
        if marked := marked_processes(self.name):
            text = f"another program that does not answer still controls {self._place}"
            raise self._refusal(marked[0], text)
        self.remarks += [
            f"{_program(pid)} has the name of the lock of {self._place} and is no controller: it is ignored"
            for pid in strangers
        ]
        if self._server is None:
            self.remarks.append(f"{self._place} cannot be locked: a second controller of another user is not kept off")

    def _refusal(self, pid: int, text: str) -> BusError:
        return BusError(
            f"{text} ({_program(pid)})",
            "only one controller may use a bus: end it first; `jointctl stop` switches its drive off and ends it",
        )

    # --- the thread ---

    def _serve(self) -> None:
        """Answer the callers; returns when `close` wakes it."""
        signal.pthread_sigmask(signal.SIG_BLOCK, set(signal.valid_signals()) - {signal.SIGKILL, signal.SIGSTOP})
        callers: dict[socket.socket, bytes] = {}
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake, selectors.EVENT_READ)
            if self._server is not None:
                self._server.setblocking(False)
                selector.register(self._server, selectors.EVENT_READ)
            while True:
                ready = [key.fileobj for key, _ in selector.select()]
                if self._wake in ready:
                    break
                for end in ready:
                    if end is self._server:
                        self._take_caller(callers, selector)
                    elif isinstance(end, socket.socket) and not self._listen_to(end, callers):
                        selector.unregister(end)
                        del callers[end]
                        end.close()
        if self._server is not None:  # first, so that no one is accepted and then not answered
            self._server.close()
        for caller in callers:
            caller.close()

    def _take_caller(self, callers: dict[socket.socket, bytes], selector: selectors.BaseSelector) -> None:
        assert self._server is not None
        with contextlib.suppress(OSError):
            caller = keep_from_forks(self._server.accept()[0])
            caller.setblocking(False)
            if len(callers) >= _CALLERS:
                oldest = next(iter(callers))
                selector.unregister(oldest)
                del callers[oldest]
                oldest.close()
            callers[caller] = b""
            selector.register(caller, selectors.EVENT_READ)

    def _listen_to(self, caller: socket.socket, callers: dict[socket.socket, bytes]) -> bool:
        """What one caller has sent; False where it has gone, or sends what is no request."""
        try:
            part = caller.recv(_LONGEST)
        except BlockingIOError:
            return True
        except OSError:
            return False
        data = callers[caller] + part
        callers[caller] = data
        if not part or len(data) > _LONGEST:
            return False
        if not data.endswith(b"\n"):
            return True
        callers[caller] = b""
        message = parsed_line(data)
        if message is None:
            return False
        answer: dict[str, Any] = {"controls": self.name, "pid": os.getpid()}
        if self._starts:
            answer["starts"] = True
        with contextlib.suppress(OSError):  # it has gone; its stop counts all the same
            if message.get("ask") == "stop":
                if not may_ask(caller):
                    answer["refused"] = "this program belongs to another user"
                else:
                    answer["within_s"] = self._within_s
                    if self._delivers:
                        settle(self.name)
                    if self._on_stop is not None:
                        self._on_stop()
                        self._on_stop = None
            send_line(caller, answer)
        return True


class Holder:
    """A program that holds one of the names of a lock, asked without waiting."""

    def __init__(self, name: str, number: int) -> None:
        """`OSError` where no one has the name."""
        self._name, self.number = name, number
        self._answer: dict[str, Any] | None = None
        self._data, self._left = b"", False
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self.socket.setblocking(False)
            self.socket.connect(_address(name, number))
            self.pid, _ = process_behind(self.socket)
        except OSError:
            self.socket.close()
            raise

    def close(self) -> None:
        self.socket.close()

    def send(self, ask: str) -> None:
        """Never waits."""
        with contextlib.suppress(OSError):
            send_line(self.socket, {"ask": ask})

    def poll(self) -> bool:
        """Whether there is nothing more to come: it has answered, or left."""
        try:
            part = self.socket.recv(_LONGEST)
        except BlockingIOError:
            return self._answer is not None
        except OSError:
            part = b""
        self._left = not part
        self._data += part
        if self._answer is None and self._data.endswith(b"\n"):
            self._answer = parsed_line(self._data)
        return self._answer is not None or not part

    def gives_way(self) -> bool:
        """Whether it leaves within `ANSWER_S`: it starts as we do, and we have the name before its own."""
        give_up_s = time.monotonic() + ANSWER_S
        while self.is_controller and (self._answer or {}).get("starts") is True and time.monotonic() < give_up_s:
            time.sleep(POLL_S)
            self.send("who")
            self._answer, self._data = None, b""
            wait_for_answers([self], give_up_s - time.monotonic())
        return self._left

    @property
    def is_controller(self) -> bool:
        """Whether it has answered as the holder of this lock does, about itself."""
        answer = self._answer or {}
        return answer.get("controls") == self._name and answer.get("pid") == self.pid

    @property
    def within_s(self) -> float | None:
        """How long it may take to stop, by its own word; None where it has not acknowledged."""
        within = (self._answer or {}).get("within_s")
        return float(within) if self.is_controller and isinstance(within, (int, float)) else None

    @property
    def refused(self) -> str:
        """Why it does not stop; "" where it has not refused."""
        return str((self._answer or {}).get("refused", "")) if self.is_controller else ""

    @property
    def left(self) -> bool:
        """Whether it has given the lock back, or has died."""
        self.poll()
        return self._left


def _holders(name: str, but: int = -1) -> list[Holder]:
    """All programs that hold a name of this lock, without that of the number `but`."""
    found = []
    for number in range(NAMES):
        with contextlib.suppress(OSError):
            if number != but:
                found.append(Holder(name, number))
    return found


def lock_holders(interface: str, channel: str) -> list[Holder]:
    """The programs that hold a name of this bus's lock; to be closed."""
    return _holders(lock_name(interface, channel)) if _has_lock(interface) else []


def _has_lock(interface: str) -> bool:
    return sys.platform == "linux" and interface != _IN_PROCESS


def stop_is_noted(interface: str, channel: str) -> bool:
    """For a program that has not got so far as to be asked."""
    return _has_lock(interface) and stopped(lock_name(interface, channel))


def wait_for_answers(holders: Iterable[Holder], timeout_s: float = ANSWER_S) -> None:
    """Until each has answered or left, `timeout_s` at most."""
    waiting = list(holders)
    give_up_s = time.monotonic() + timeout_s
    with selectors.DefaultSelector() as selector:
        for holder in waiting:
            selector.register(holder.socket, selectors.EVENT_READ, holder)
        while selector.get_map() and (left_s := give_up_s - time.monotonic()) > 0.0:
            for key, _ in selector.select(left_s):
                if key.data.poll():
                    selector.unregister(key.fileobj)


def marked_processes(name: str, proc: Path = Path("/proc")) -> list[int]:
    """Processes that act for the holder of this lock, ourselves not among them; of this user, or all for root."""
    pids = (int(folder.name) for folder in proc.glob("[0-9]*"))
    return [pid for pid in pids if pid != os.getpid() and is_marked(pid, name, proc)]


def is_marked(pid: int, name: str, proc: Path = Path("/proc")) -> bool:
    """Whether the process has the marker of this lock, `LOCKS`: of any; False where this user may not look."""
    mark = f"/memfd:{name}" if name == LOCKS else f"/memfd:{name} "
    with contextlib.suppress(OSError):
        for link in (proc / str(pid) / "fd").iterdir():
            with contextlib.suppress(OSError):
                if os.readlink(link).startswith(mark):
                    return True
    return False


def lock_name(interface: str, channel: str) -> str:
    """Of the bus itself, whatever links lead to it, and whatever else has its name in another mount namespace."""
    place = f"{interface}:{channel}"
    if interface == "jointctl":
        path = socket_path(channel)
        place = f"{interface}:{path}"  # until it is there
        with contextlib.suppress(OSError):
            found = os.stat(path)  # with its time: the number of a socket file that is gone is given to the next one
            place = f"{interface}:{found.st_dev:x}:{found.st_ino:x}:{found.st_ctime_ns:x}"
    elif interface == "socketcan":
        with contextlib.suppress(OSError):
            place = f"{interface}:{socket.if_indextoname(socket.if_nametoindex(channel))}"  # of an altname
    elif interface == "serial" or port_path(channel).startswith("/"):
        place = f"{interface}:{os.path.realpath(port_path(channel))}"
    return LOCKS + hashlib.sha256(place.encode()).hexdigest()[:32]


def _address(name: str, number: int) -> bytes:
    return b"\0" + (name if number == 0 else f"{name}-{number}").encode()


def _program(pid: int) -> str:
    """`jointctl, pid 1234`; without a name where it has just gone."""
    try:
        return f"{program_name(pid)}, pid {pid}"
    except OSError:
        return f"pid {pid}"


# --- How a stop ends the program that has the lock: it ends by itself, or by force ---
# The request is sent at once, and no one waits for an answer before the drive is stopped.  A program that acknowledges
# it has its own time to brake and to switch off; one that does not, or takes longer, is ended by signal with all its
# processes.  After `end` nothing of it can enable the drive.


LOOKS = 3  # at all buses, after their controllers have ended
LONGEST_S = 300.0  # that a program may ask for: four time-outs of a stop are at most 60 s each
REFUSED_S = 2.0  # for a program of another user, which ends by itself when it sees its drive stopped
TERM_S = 1.0  # between SIGTERM and SIGKILL
KILL_S = 2.0
POLL_S = 0.02
ARMED = (
    "its drive keeps its watchdog, and may report a lost heartbeat (8130h): the next run takes it over; a fault that "
    "remains is reset by `jointctl clear-fault`"
)


class StopCall(contextlib.AbstractContextManager["StopCall"]):
    """Asks the program that controls the bus to stop, at once; then `end` it.  To be used in a `with` block.

    A program that was started before, and takes the lock of the bus later, finds the note of this stop and ends.
    """

    def __init__(self, interface: str, channel: str) -> None:
        self._place, self._name = (interface, channel), lock_name(interface, channel)
        self._unnoted: OSError | None = None
        self._noted_ns, self.unended = 0, ""  # of our note; who goes on, and may enable the drive again
        self._note()
        self._ask()

    def _note(self) -> None:
        """The first one is for all that run, each further one for those that were started since."""
        try:
            if _has_lock(self._place[0]):
                self._noted_ns = write_note(self._name, self._noted_ns)
        except OSError as error:
            self._unnoted = error

    def _ask(self) -> None:
        self._holders = lock_holders(*self._place)
        for holder in self._holders:
            holder.send("stop")

    def __exit__(self, *_: object) -> None:
        for holder in self._holders:
            holder.close()

    def end(self, note: Callable[[str], None], ended: Callable[[], None]) -> bool:
        """The processes of a controller have ended when this returns, or `note` got why not.  Whether there was one.

        `ended` is called where there was: it may have enabled the drive before.
        """
        wait_for_answers(self._holders)
        marked = marked_processes(self._name)
        if marked and not any(holder.is_controller for holder in self._holders):  # it may have come after the request
            self._ask_again()
            wait_for_answers(self._holders)
        controllers = [holder for holder in self._holders if holder.is_controller]
        for holder in controllers:
            if holder.within_s is not None:
                note(f"stopping the program that controls the bus (pid {holder.pid})")
        waited_for = [holder for holder in controllers if holder.within_s is not None or holder.refused]
        times_s = (REFUSED_S if holder.refused else holder.within_s or 0.0 for holder in waited_for)
        give_up_s = time.monotonic() + min(max(times_s, default=0.0), LONGEST_S)
        while time.monotonic() < give_up_s:
            waited_for = [holder for holder in waited_for if not holder.left]
            if not waited_for and not any(is_marked(pid, self._name) for pid in marked):
                break
            time.sleep(POLL_S)
        goes_on = "the program that controls the bus (pid {0.pid}) cannot be ended: {0.refused}"
        self.unended = "; ".join(goes_on.format(holder) for holder in waited_for if holder.refused)
        self._end_by_force(note)
        if controllers or marked:
            ended()
        return bool(controllers or marked)

    def again(self, note: Callable[[str], None], ended: Callable[[], None]) -> bool:
        """As `end`, for what has been started since, or has taken the lock after the first request."""
        self._note()
        self._ask_again()
        return self.end(note, ended)

    def clear_away(self, note: Callable[[str], None]) -> None:
        """Notes that count no longer; `note` gets why ours could not be written."""
        if self._unnoted is not None:
            note(
                f"the stop cannot be noted for a program that is just starting ({self._unnoted}): "
                "look whether there is one, and stop again when it runs"
            )
        elif _has_lock(self._place[0]):
            with contextlib.suppress(OSError):
                remove_old(self._name)

    def _ask_again(self) -> None:
        self.__exit__()
        self._ask()

    def _end_by_force(self, note: Callable[[str], None]) -> None:
        """SIGTERM, then SIGKILL, to every process that still acts for the controller."""
        if not (pids := marked_processes(self._name)):
            return
        note(f"it does not end by itself: ending process {', '.join(map(str, pids))}; {ARMED}")
        for number, wait_s in ((signal.SIGTERM, TERM_S), (signal.SIGKILL, KILL_S)):
            pids = _signalled(marked_processes(self._name), self._name, number, wait_s)
        if pids:
            self.unended = f"process {', '.join(map(str, pids))} cannot be ended"


def end_programs(
    calls: Sequence[StopCall], note: Callable[[str], None], ended: Callable[[], None] = lambda: None
) -> bool:
    """Of all buses, until no controller is found on any: while one ends, another may come on a bus that was free.

    Whether there was one.  What holds for several buses, as of the one program that controls an arm, is noted once.
    """
    noted: set[str] = set()

    def note_once(text: str) -> None:
        if text not in noted:
            noted.add(text)
            note(text)

    found = [call.end(note_once, ended) for call in calls]
    for _ in range(LOOKS):
        again = [call.again(note_once, ended) for call in calls]
        if not any(again):
            break
        found += again
    for call in calls:
        call.clear_away(note_once)
    return any(found)


def _signalled(pids: list[int], name: str, number: signal.Signals, wait_s: float) -> list[int]:
    """Those that still live `wait_s` after the signal.  A descriptor of a process cannot come to mean another one."""
    with contextlib.ExitStack() as stack:
        ends: dict[int, int] = {}
        for pid in pids:
            with contextlib.suppress(OSError):
                end = os.pidfd_open(pid)
                stack.callback(os.close, end)
                if is_marked(pid, name):  # it is still the one that was found
                    ends[end] = pid
                    signal.pidfd_send_signal(end, number)
        give_up_s = time.monotonic() + wait_s
        while ends and (left_s := give_up_s - time.monotonic()) > 0.0:
            for end in select.select(list(ends), [], [], left_s)[0]:
                del ends[end]
        return list(ends.values())

"""The virtual drives of a bus in real time, on a descriptor that carries 16-byte frames (AF_CAN, AF_UNIX SEQPACKET).

One compiled loop without the interpreter lock, in one thread, for all drives of an arm, on whatever bus: their joints
move on together.
SDO requests go through a socket pair to a second, Python thread, and its responses come back the same way: the core
first acts on what was written, then sends the response, so that a master which has its answer finds the controlword
carried out.  The loop is the only sender on the bus.  On that way the first spare byte of a frame is the number of the
first drive on its bus: drives of two buses may have the same node.
"""

from __future__ import annotations

import errno as errno_codes
import socket
import threading
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import (
    EAGAIN,
    EINTR,
    MSG_DONTWAIT,
    MSG_NOSIGNAL,
    POLLIN,
    errno,
    load_acquire,
    monotonic_ns,
    ppoll,
    recv,
    send,
    store_release,
)
from jointctl.firmware_py.schema import new
from jointctl.hil.arm_plant import ArmPlant, no_arm_plant
from jointctl.hil.bus_timing import OLDEST_STAMP_NS, STAMPED_LAG_NS, sent_ns_of, stamp_answers
from jointctl.hil.canopen.device import Cia402Device
from jointctl.hil.canopen.device_core import accept_frame, advance, advance_together
from jointctl.hil.canopen.records import Device, NmtState, int64
from jointctl.hil.faults import append_frame, fault_rows, pass_frame, step_faults, take_due
from jointctl.hil.virtual_bus import FRAME_SIZE, FrameQueue, store_release_word

ENETDOWN = errno_codes.ENETDOWN
STOP_WORD = 0  # not zero: leave the loop
SEND_ERRORS_WORD = 1  # frames that could not be sent
ENDED_WORD = 2  # 1 = stopped, 2 = the bus has gone
WORDS = 3

_LONGEST_WAIT_NS = 2_000_000  # faults of the plant are seen at least this often
_SDO_LOOK_S = 0.1
_FRAMES_AT_ONCE = 64  # received from a bus before timers are looked at again
_BUS_BYTE = 5  # of a frame between the core and the Python thread
_GONE = -1  # in the place of a descriptor


class DeviceMemory(NamedTuple):
    """What the loop works on; arrays of records with one element a drive."""

    devices: Any  # Device[N]
    plant_constants: Any  # PlantConstants[N]
    plant_states: Any  # PlantState[N]
    queues: Any  # FrameQueue[N], to the bus
    arm: Any  # ArmPlant of several drives; None = a single joint, and nothing of arms is compiled
    faults: Any  # FaultConstants[N, M], see `hil.faults`; None = none, and nothing of them is compiled
    fault_memories: Any  # FaultMemory[N]
    bus: np.ndarray  # int64[N]: of each drive the first one on the same bus
    fds: np.ndarray  # int64[N]: of the bus, where the drive is the first one on it
    words: np.ndarray  # int64[WORDS]
    frame: np.ndarray  # uint8[FRAME_SIZE], as the next two scratch
    polls: np.ndarray  # int32[2 N + 2]
    timespec: np.ndarray  # int64[2]


class _Joint(NamedTuple):
    """Drive and plant, what the drive sends, and the way to the Python thread."""

    device: Any  # Device
    plant_c: Any  # PlantConstants
    plant_s: Any  # PlantState
    queue: Any  # FrameQueue
    service_fd: int
    bus: int  # number of the first drive on the same bus


@kernel
def _flush(fd: int, queue: FrameQueue, words: np.ndarray) -> None:
    """Send the queue; what the bus does not take is lost and counted, as on a real bus."""
    for i in range(queue.count):
        address = np.uintp(queue.frames[i].ctypes.data)
        sent = send(np.int32(fd), address, np.uintp(FRAME_SIZE), np.int32(MSG_DONTWAIT | MSG_NOSIGNAL))
        if sent != FRAME_SIZE:
            store_release(words, SEND_ERRORS_WORD, load_acquire(words, SEND_ERRORS_WORD) + 1)
    queue.count = 0


@kernel
def _flush_all(faults: Any, now_ns: int, of: DeviceMemory) -> None:
    """As `_flush` for every drive, through the faults of its wire; late frames go out when they are due."""
    for index in range(len(of.devices)):
        queue, fd = of.queues[index], of.fds[of.bus[index]]
        if faults is None:
            _flush(fd, queue, of.words)
        else:
            memory, node_id = of.fault_memories[index], int64(of.devices[index].node_id)
            take_due(memory, False, now_ns, False, memory.to_controller)
            for i in range(queue.count):
                pass_frame(faults[index], memory, queue.frames[i], False, node_id, now_ns, memory.to_controller)
            queue.count = 0
            _flush(fd, memory.to_controller, of.words)


@kernel
def _receive(fd: int, frame: np.ndarray) -> int:
    """Bytes received into `frame`; 0 = nothing waits, -1 = the other end has gone."""
    got = recv(np.int32(fd), np.uintp(frame.ctypes.data), np.uintp(FRAME_SIZE), np.int32(MSG_DONTWAIT))
    if got == 0:
        return -1
    if got < 0:
        code = errno()
        # an interface that goes down may come up again: a drive outlives its bus
        return 0 if code in (EAGAIN, EINTR, ENETDOWN) else -1
    return got


@kernel
def _is_sync(device: Device, frame: np.ndarray) -> bool:
    return int64(frame[0]) | int64(frame[1]) << 8 == int64(device.communication.sync_cob_id) & 0x7FF


@kernel
def _take_frame(joint: _Joint, frame: np.ndarray, now_ns: int) -> None:
    """One frame at the drive's end: SDO requests go to the Python thread, all others to the core."""
    device: Device = joint.device
    identifier = int64(frame[0]) | int64(frame[1]) << 8 | int64(frame[3]) << 24
    to_encoder = device.encoder.node_id != 0 and identifier == 0x600 + device.encoder.node_id
    if not to_encoder and identifier != 0x600 + device.node_id:
        accept_frame(device, joint.plant_c, joint.plant_s, frame, now_ns, joint.queue)
        return
    advance(device, joint.plant_c, joint.plant_s, now_ns, joint.queue)
    if to_encoder or (device.nmt != NmtState.STOPPED and device.nmt != NmtState.BOOT_UP):
        frame[_BUS_BYTE] = joint.bus
        address = np.uintp(frame.ctypes.data)
        send(np.int32(joint.service_fd), address, np.uintp(FRAME_SIZE), np.int32(MSG_DONTWAIT | MSG_NOSIGNAL))


@kernel
def _take_frames(joint: _Joint, ready: FrameQueue, now_ns: int) -> None:
    """`_take_frame` for all that the wire's faults let through."""
    for i in range(ready.count):
        _take_frame(joint, ready.frames[i], now_ns)
    ready.count = 0


@kernel
def _wait_for_frames(of: DeviceMemory, service_fd: int, wait_ns: int) -> None:
    """Sleep until a frame of a bus or an SDO answer waits, `wait_ns` at most."""
    polls, timespec = of.polls, of.timespec
    polls[0] = service_fd
    polls[1] = POLLIN
    count = 1
    for bus in range(len(of.devices)):
        if of.bus[bus] == bus:
            polls[2 * count] = of.fds[bus]  # a negative one is ignored
            polls[2 * count + 1] = POLLIN
            count += 1
    timespec[0] = 0
    timespec[1] = wait_ns
    ppoll(np.uintp(polls.ctypes.data), np.uintp(count), np.uintp(timespec.ctypes.data), np.uintp(0))


@kernel
def _advance_all(of: DeviceMemory, arm: Any, until_ns: int) -> None:
    if arm is None:
        advance(of.devices[0], of.plant_constants[0], of.plant_states[0], until_ns, of.queues[0])
    else:
        advance_together(of.devices, of.plant_constants, of.plant_states, until_ns, of.queues, arm)


@kernel
def _let_faults_act(of: DeviceMemory, faults: Any, service_fd: int, now_ns: int) -> None:
    """Those of drive and plant begin and end; frames that the wire has kept come out of it."""
    if faults is None:
        return
    for index in range(len(of.devices)):
        memory = of.fault_memories[index]
        joint = _Joint(
            of.devices[index], of.plant_constants[index], of.plant_states[index], of.queues[index], service_fd,
            of.bus[index],
        )  # fmt: skip
        step_faults(faults[index], memory, joint.device, joint.plant_c, joint.plant_s, now_ns)
        take_due(memory, True, now_ns, False, memory.ready)
        _take_frames(joint, memory.ready, now_ns)


@kernel
def _take_from_bus(of: DeviceMemory, faults: Any, service_fd: int, bus: int, now_ns: int) -> bool:
    """One frame of the controller, through the wire's faults, as of the time it was sent; whether it carried one."""
    frame = of.frame
    sent_ns = sent_ns_of(frame, now_ns)
    if faults is not None:
        for index in range(len(of.devices)):
            step_faults(
                faults[index], of.fault_memories[index], of.devices[index], of.plant_constants[index],
                of.plant_states[index], sent_ns,
            )  # fmt: skip
    if len(of.devices) > 1:  # a single joint moves on when it takes the frame
        _advance_all(of, of.arm, sent_ns)
    for index in range(bus, len(of.devices)):
        if of.bus[index] != bus:
            continue
        joint = _Joint(
            of.devices[index], of.plant_constants[index], of.plant_states[index], of.queues[index], service_fd,
            of.bus[index],
        )  # fmt: skip
        if faults is None:
            _take_frame(joint, frame, sent_ns)
        else:
            memory = of.fault_memories[index]
            pass_frame(faults[index], memory, frame, True, int64(joint.device.node_id), sent_ns, memory.ready)
            _take_frames(joint, memory.ready, sent_ns)
        if sent_ns != now_ns and _is_sync(joint.device, frame):
            stamp_answers(joint.queue, frame)
    return sent_ns != now_ns


@kernel
def _take_sdo_answer(of: DeviceMemory, now_ns: int) -> None:
    """An answer of the Python thread: the core first acts on what was written, then the frame goes out."""
    frame = of.frame
    bus = int64(frame[_BUS_BYTE])
    frame[_BUS_BYTE] = 0
    node_id = (int64(frame[0]) | int64(frame[1]) << 8) - 0x580
    for index in range(bus, len(of.devices)):
        device = of.devices[index]
        if of.bus[index] == bus and (node_id == device.node_id or node_id == device.encoder.node_id):
            device.next_due_ns = 0
            _advance_all(of, of.arm, now_ns)
            append_frame(of.queues[index], frame)


@kernel
def _next_due_ns(devices: np.ndarray) -> int:
    due_ns = int64(devices[0].next_due_ns)
    for index in range(1, len(devices)):
        due_ns = min(due_ns, int64(devices[index].next_due_ns))
    return due_ns


@kernel
def _all_gone(of: DeviceMemory) -> bool:
    """Whether no bus is left."""
    for bus in range(len(of.devices)):
        if of.bus[bus] == bus and of.fds[bus] != _GONE:
            return False
    return True


@kernel
def run_device(service_fd: int, of: DeviceMemory) -> int:
    """Serve the buses until the stop word; returns the value of ENDED_WORD."""
    faults, words, frame, timespec = of.faults, of.words, of.frame, of.timespec
    stamped_ns = int64(-OLDEST_STAMP_NS)  # when the last frame with a time came
    ended = 1
    while load_acquire(words, STOP_WORD) == 0 and ended == 1:
        now_ns = monotonic_ns(timespec)
        lag_ns = STAMPED_LAG_NS if now_ns - stamped_ns < OLDEST_STAMP_NS else 0
        _let_faults_act(of, faults, service_fd, now_ns - lag_ns)
        wait_ns = max(0, min(_next_due_ns(of.devices) + lag_ns - now_ns, _LONGEST_WAIT_NS))
        _wait_for_frames(of, service_fd, wait_ns)
        woken_ns = monotonic_ns(timespec)
        drained = False
        for _ in range(_FRAMES_AT_ONCE):
            if drained:
                break
            drained = True
            for bus in range(len(of.devices)):  # a frame of each in turn: so they are taken about as they were sent
                if of.bus[bus] != bus or of.fds[bus] == _GONE:
                    continue
                got = _receive(of.fds[bus], frame)
                if got < 0:
                    of.fds[bus] = _GONE
                    ended = 2 if _all_gone(of) else 1
                if got <= 0:
                    continue
                drained = False
                if got != FRAME_SIZE:
                    continue
                now_ns = monotonic_ns(timespec)
                if _take_from_bus(of, faults, service_fd, bus, now_ns):
                    stamped_ns = now_ns
                _flush_all(faults, now_ns, of)
        while _receive(service_fd, frame) == FRAME_SIZE:
            _take_sdo_answer(of, monotonic_ns(timespec))
            _flush_all(faults, monotonic_ns(timespec), of)
        # after the frames, which may be older: the plant does not go back
        if drained or lag_ns == 0:
            _advance_all(of, of.arm, woken_ns - lag_ns)
            _flush_all(faults, woken_ns, of)
    store_release(words, ENDED_WORD, ended)
    return ended


def _on_bus(frame: bytes, bus: int) -> bytes:
    return frame[:_BUS_BYTE] + bytes([bus]) + frame[_BUS_BYTE + 1 :]


class RealtimeDevice:
    """Runs the drives of a bus on a connected socket: `start`, `stop`, or a `with` block.  The descriptor stays the
    caller's.  Several drives: those of one `Cia402Device.row`, with the arm that connects their joints; `fd` may be
    one a drive, the same for all of a bus.
    """

    def __init__(
        self, devices: Cia402Device | Sequence[Cia402Device], fd: int | Sequence[int], arm: ArmPlant | None = None
    ) -> None:
        self._devices = [devices] if isinstance(devices, Cia402Device) else list(devices)
        self._arm = no_arm_plant() if arm is None and len(self._devices) > 1 else arm
        self.plant_states = self._devices[0].whole_row.plant_states
        fds = [fd] * len(self._devices) if isinstance(fd, int) else list(fd)
        self._fds, self._bus = np.array(fds), np.array([fds.index(one) for one in fds])
        self.words = np.zeros(WORDS, np.int64)
        rows, self.fault_memory = fault_rows([device.faults for device in self._devices])
        self._faults = rows if rows.size else None
        self._threads: list[threading.Thread] = []
        self._core_end: socket.socket | None = None

    def _run(self, service_fd: int) -> None:
        row = self._devices[0].whole_row
        polls = np.zeros(2 * len(self._devices) + 2, np.int32)
        memory = DeviceMemory(
            *row, new(FrameQueue, len(self._devices)), self._arm, self._faults, self.fault_memory, self._bus,
            self._fds.copy(), self.words, np.zeros(FRAME_SIZE, np.uint8), polls, np.zeros(2, np.int64),
        )  # fmt: skip
        run_device(service_fd, memory)

    def _serve(self, service: socket.socket) -> None:
        """Answer SDO requests until the other end closes; an unfinished transfer is looked at now and then."""
        with service:
            while True:
                service.settimeout(_SDO_LOOK_S if any(device.sdo.busy for device in self._devices) else None)
                responses: list[tuple[int, bytes]] = []
                try:
                    frame = service.recv(FRAME_SIZE)
                except TimeoutError:
                    for bus, device in zip(self._bus, self._devices, strict=True):
                        responses += [(bus, response) for response in device.expire_sdo(time.monotonic_ns())]
                else:
                    if not frame:
                        return
                    bus, frame = frame[_BUS_BYTE], _on_bus(frame, 0)
                    for its_bus, device in zip(self._bus, self._devices, strict=True):
                        if its_bus == bus and device.is_addressed(frame):
                            answers = device.answer_sdo(frame, time.monotonic_ns())
                            responses += [(bus, response) for response in answers]
                for bus, response in responses:
                    service.send(_on_bus(response, bus))

    def compile(self) -> None:
        """Compile, or load from the cache, what `start` runs; nothing is sent."""
        self.words[:] = 0
        self.words[STOP_WORD] = 1
        self._run(-1)
        self.words[:] = 0

    def start(self) -> None:
        """Compile if need be, then boot: the boot-up message is sent."""
        if self._threads:
            raise RuntimeError("the device is running already")
        self.compile()
        self._core_end, python_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._threads = [
            threading.Thread(target=self._run, args=(self._core_end.fileno(),), name="device", daemon=True),
            threading.Thread(target=self._serve, args=(python_end,), name="device-sdo", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End both threads; the plant stays where it is.  Harmless when not running."""
        if not self._threads or self._core_end is None:
            return
        store_release_word(self.words, STOP_WORD, 1)
        self._threads[0].join()
        self._core_end.close()
        self._threads[1].join()
        self._threads = []

    def __enter__(self) -> RealtimeDevice:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

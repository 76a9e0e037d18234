"""The virtual drive on a bus in the process of a test, as fast as it is asked."""

from __future__ import annotations

import dataclasses
import itertools
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import can

from jointctl.drivers.canopen import network
from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.network import LISTEN_S
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.canopen.switch_off import stop_node
from jointctl.hil.canopen.device import Cia402Device

_FRAME = struct.Struct("<IB3x8s")
_channels = itertools.count()
DEVICE_TIME_FACTOR = 50.0
PASS_TIME, TIME_PASSED = 0x1FFFFFF0, 0x1FFFFFF1  # extended identifiers: no frames of CANopen
network.NOTIFIER_S = 0.005  # a receiving thread is waited for whenever a driver is closed


@contextmanager
def sent_every_10_ms(interface: str, channel: str, identifier: int, data: bytes = b"") -> Iterator[None]:
    """A frame of another program, again and again; the thread that sends has ended when its bus is closed."""
    with can.Bus(interface=interface, channel=channel) as bus:
        sender = bus.send_periodic(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), 0.01)
        try:
            yield
        finally:
            sender.stop()
            sender.thread.join()


def pass_time(seconds: float) -> can.Message:
    return can.Message(arbitration_id=PASS_TIME, data=struct.pack("<d", seconds))


class DeviceOnBus:
    """The virtual drive on python-can's in-process bus, in a thread.

    Its time moves on 1 ms with every frame, and with every wait of the driver by that time, however busy the computer
    is: the driver's end asks for it with a frame of its own, and goes on when it has heard all that was said meanwhile.

    `answers` replaces the value in expedited SDO upload responses, (index, sub) -> value; `mute` lists objects whose
    next requests stay unanswered; `requests` are the frames that came in.  `sequences` are answers used up one by one
    before the true ones; `refused` are downloads answered with that SDO abort code, `unread` are uploads; `deaf_frames`
    frames are lost.  `settings` are what `opened` gives the driver.
    """

    def __init__(self, device: Cia402Device | None, settings: CanopenSettings | None = None) -> None:
        self.device, self.settings = device, settings
        self.channel = f"device {next(_channels)}"
        self.now_ns = 1_000_000
        self.answers: dict[tuple[int, int], int] = {}
        self.mute: list[tuple[int, int]] = []
        self.refused: dict[tuple[int, int], int] = {}
        self.unread: dict[tuple[int, int], int] = {}
        self.sequences: dict[tuple[int, int], list[int]] = {}
        self.deaf_frames = 0
        self.requests: list[tuple[int, bytes]] = []
        self._drives: list[tuple[CanopenDrive, threading.Event]] = []
        self._bus = can.Bus(interface="virtual", channel=self.channel)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> DeviceOnBus:
        if self.device is not None:
            # nobody's frame: everything is compiled before a master counts the time of its first request
            self.device.handle(_FRAME.pack(0x7E5, 0, b""), self.now_ns)
        self._thread.start()
        return self

    def stop(self) -> None:
        """From here on the device only moves when the test moves it."""
        self._ended.set()
        with can.Bus(interface="virtual", channel=self.channel) as bus:
            bus.send(pass_time(0.0))  # it is waiting for a frame
        self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._bus.shutdown()

    def _run(self) -> None:
        while not self._ended.is_set():
            message = self._bus.recv(0.05)
            if message is None:
                continue
            if message.arbitration_id == PASS_TIME:
                self._pass_time(struct.unpack("<d", message.data)[0])
                self._bus.send(can.Message(arbitration_id=TIME_PASSED))
                continue
            data = bytes(message.data)
            self.requests.append((message.arbitration_id, data))
            if self.device is None:
                continue
            if self.deaf_frames:
                self.deaf_frames -= 1
                continue
            if message.arbitration_id == 0x600 + self.device.settings.node_id:
                place = struct.unpack_from("<HB", data, 1)
                if place in self.mute:
                    self.mute.remove(place)
                    continue
                refused = {0x20: self.refused, 0x40: self.unread}.get(data[0] & 0xE0, {})
                if place in refused:
                    abort = struct.pack("<BHBI", 0x80, *place, refused[place])
                    self._reply(_FRAME.pack(0x580 + self.device.settings.node_id, 8, abort))
                    continue
            self.now_ns += 1_000_000
            for frame in self.device.handle(_FRAME.pack(message.arbitration_id, len(data), data), self.now_ns):
                self._reply(frame)

    def _pass_time(self, seconds: float) -> None:
        if self.device is None:
            return
        until_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < until_ns:
            self.now_ns = min(self.now_ns + 10_000_000, until_ns)
            for frame in self.device.advance(self.now_ns):
                self._reply(frame)

    def _reply(self, frame: bytes) -> None:
        identifier, size, payload = _FRAME.unpack(frame)
        if identifier & 0x780 == 0x580 and payload[0] & 0xE2 == 0x42:
            place = struct.unpack_from("<HB", payload, 1)
            if self.sequences.get(place) or place in self.answers:
                value = self.sequences[place].pop(0) if self.sequences.get(place) else self.answers[place]
                value &= 0xFFFFFFFF
                payload = payload[:4] + struct.pack("<I", value)
        self._bus.send(can.Message(arbitration_id=identifier, data=payload[:size], is_extended_id=False))

    def downloads(self, index: int, sub: int = 0) -> list[int]:
        """What was written to an object, in order: expedited downloads."""
        found = []
        for cob_id, data in self.requests:
            if cob_id == 0x601 and data[0] & 0xE2 == 0x22 and struct.unpack_from("<HB", data, 1) == (index, sub):
                found.append(int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little"))
        return found

    def send(self, identifier: int, data: bytes) -> None:
        """A frame of someone else, which the drive takes as well."""
        with can.Bus(interface="virtual", channel=self.channel) as bus:
            bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        self.settle()

    def settle(self) -> None:
        """Until what was sent has been taken and answered, and has come to every driver on this bus."""
        if self._ended.is_set():
            return
        open_ones = [passed for drive, passed in self._drives if drive._network.notifier is not None]
        for passed in open_ones:
            passed.clear()
        with can.Bus(interface="virtual", channel=self.channel) as bus:
            bus.send(pass_time(0.0))
            while (message := bus.recv(60.0)) is not None and message.arbitration_id != TIME_PASSED:
                pass
        for passed in open_ones:
            passed.wait(60.0)

    def stop_drive(self) -> str:
        """What `jointctl stop` does, from another end of this bus; the state in words."""
        bus = can.Bus(interface="virtual", channel=self.channel)
        state = stop_node(bus, 1, sdo_timeout_s=0.15, sleep=lambda s: time.sleep(s / DEVICE_TIME_FACTOR))
        self.settle()  # its last frame may be on the way still
        return state

    def drive(
        self,
        settings: CanopenSettings,
        *,
        listened: bool = True,
        gate: Callable[[], None] = lambda: None,
        echoes: bool = False,
    ) -> CanopenDrive:
        """The real driver on another end of this bus; its waiting is short, but long for the device.

        `listened`: it has listened to the bus for long enough already.  `echoes`: it receives its own frames as well.
        """
        bus = can.Bus(interface="virtual", channel=self.channel, receive_own_messages=echoes)
        passed = threading.Event()

        def hear(message: can.Message) -> None:
            if message.arbitration_id == TIME_PASSED:
                passed.set()

        def sleep(seconds: float) -> None:
            threading.Event().wait(seconds / DEVICE_TIME_FACTOR)
            if self._ended.is_set() or drive._network.notifier is None:
                return
            passed.clear()
            bus.send(pass_time(seconds))
            passed.wait(60.0)

        drive = CanopenDrive(bus, settings, sleep=sleep, gate=gate)
        if listened:
            drive._others._started_s -= LISTEN_S
        drive._network.notifier.add_listener(hear)
        self._drives.append((drive, passed))
        return drive

    @contextmanager
    def opened(self, **changes: Any) -> Iterator[CanopenDrive]:
        """The real driver with some of its settings changed, closed at the end."""
        assert self.settings is not None
        drive = self.drive(dataclasses.replace(self.settings, **changes))
        try:
            yield drive
        finally:
            drive.close()

    @contextmanager
    def commissioned(self, **changes: Any) -> Iterator[CanopenDrive]:
        """As `opened`, and commissioned."""
        with self.opened(**changes) as drive:
            drive.commission()
            yield drive

    def value(self, index: int, sub: int = 0) -> int:
        """What the drive's dictionary holds."""
        return int(self.device.objects.value(index, sub))

    def store(self, index: int, sub: int, number: int) -> None:
        """A default of the drive that is not the virtual one's."""
        size = self.device.objects.entry(index, sub).size
        self.device.objects.store(index, sub, struct.pack("<q", number)[:size])

"""A virtual drive in real time on a descriptor: the compiled loop in one thread, the SDO server in another."""

from __future__ import annotations

import socket
import threading
import time

import numpy as np

from jointctl.firmware_py.schema import new
from jointctl.hil.bus.virtual_bus import FRAME_SIZE, FrameQueue
from jointctl.hil.canopen.device import Cia402Device
from jointctl.hil.device_loop import STOP_WORD, WORDS, run_device, store_release_word
from jointctl.hil.faults.kinds import fault_memory, no_faults

_SDO_LOOK_S = 0.1


class RealtimeDevice:
    """Runs a device on a connected socket: `start`, `stop`, or a `with` block.  The descriptor stays the caller's."""

    def __init__(self, device: Cia402Device, fd: int) -> None:
        self._device = device
        self._fd = fd
        self.words = np.zeros(WORDS, np.int64)
        self._faults = device.faults if len(device.faults) else no_faults()
        self.fault_memory = fault_memory(self._faults)
        self._threads: list[threading.Thread] = []
        self._core_end: socket.socket | None = None

    def _run(self, service_fd: int) -> None:
        device = self._device
        run_device(
            self._fd,
            device.device,
            device.plant_constants,
            device.plant_state,
            new(FrameQueue),
            self._faults,
            self.fault_memory,
            self.words,
            service_fd,
            np.zeros(FRAME_SIZE, np.uint8),
            np.zeros(4, np.int32),
            np.zeros(2, np.int64),
        )

    def _serve(self, service: socket.socket) -> None:
        """Answer SDO requests until the other end closes; an unfinished transfer is looked at now and then."""
        device = self._device
        with service:
            while True:
                service.settimeout(_SDO_LOOK_S if device.sdo.busy else None)
                try:
                    frame = service.recv(FRAME_SIZE)
                except TimeoutError:
                    responses = device.expire_sdo(time.monotonic_ns())
                else:
                    if not frame:
                        return
                    responses = device.answer_sdo(frame, time.monotonic_ns())
                for response in responses:
                    service.send(response)

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

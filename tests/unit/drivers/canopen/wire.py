"""The cyclic exchange with one drive, and the frames that it takes and gives."""

from __future__ import annotations

import math
import struct

import numpy as np

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cia import State
from jointctl.drivers.canopen.cyclic import FRAME_SLOTS, CanopenPort, accept_frame, end_cycle
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest

RAD_PER_COUNT = 2.0 * math.pi / 2**19
STATUSWORDS = {
    State.NOT_READY_TO_SWITCH_ON: 0x0000, State.SWITCH_ON_DISABLED: 0x0250, State.READY_TO_SWITCH_ON: 0x0231,
    State.SWITCHED_ON: 0x0233, State.OPERATION_ENABLED: 0x1637, State.QUICK_STOP_ACTIVE: 0x0217,
    State.FAULT_REACTION_ACTIVE: 0x021F, State.FAULT: 0x0218,
}  # fmt: skip


class Wire:
    """A port of node 5 with its frame memory and records."""

    def __init__(self) -> None:
        self.ports = new(CanopenPort)
        self.port = port = self.ports[0]
        port.node, port.sync_id, port.tpdo_id, port.rpdo_id = 5, 0x80, 0x185, 0x205
        port.emergency_id, port.heartbeat_id, port.own_heartbeat_id = 0x85, 0x705, 0x77F
        port.tpdo_length, port.rpdo_length = 8, 4
        port.status_at, port.position_at, port.torque_at, port.control_at, port.target_at = 0, 2, 6, 0, 2
        port.position_radpcount, port.torque_Nmppermille, port.max_permille = RAD_PER_COUNT, 0.0605, 1000
        port.state, port.heartbeat_cycles = State.UNDEFINED, 3
        self.frames = new(Frame, FRAME_SLOTS)
        self.samples = new(Sample)
        self.sample, self.command = self.samples[0], new(Command)[0]

    def receive(self, identifier: int, data: bytes, now_ns: int = 1) -> bool:
        frame = self.frames[3]
        frame.can_id, frame.length = identifier, len(data)
        frame.payload[:] = 0xEE  # what an earlier frame may have left behind
        frame.payload[: len(data)] = np.frombuffer(data, np.uint8)
        return bool(accept_frame(self.port, frame, self.sample, now_ns))

    def tpdo(self, status: int = 0x0250, counts: int = 0, torque: int = 0) -> bool:
        return self.receive(0x185, struct.pack("<Hih", status, counts, torque))

    def rpdo(self, torque_Nm: float, request: DriveRequest = DriveRequest.ENABLE) -> bytes:
        self.command.torque_Nm, self.command.request = torque_Nm, request
        end_cycle(self.port, self.frames, self.sample, self.command)
        return self.frames[2].tobytes()

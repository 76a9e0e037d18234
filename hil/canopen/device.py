"""The virtual CiA 402 drive for a synchronous user: frames in, frames out, at the times that the caller names."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import canopen
import numpy as np

from jointctl.firmware_py.schema import dtype_of, new
from jointctl.hil.canopen.device_core import accept_frame, advance, power_on
from jointctl.hil.canopen.dictionary import ObjectDictionary, ParameterStore, check_write
from jointctl.hil.canopen.encoder_node import EncoderSettings, VirtualEncoder
from jointctl.hil.canopen.records import Device, NmtState
from jointctl.hil.canopen.sdo import SdoServer
from jointctl.hil.plant_records import PlantConstants, PlantState
from jointctl.hil.virtual_bus import FRAME_SIZE, FrameQueue


@dataclass(frozen=True)
class DeviceSettings:
    """What distinguishes one drive from another; the gains are those of its velocity and position loop.

    The motor's torque constant turns the current limit 6073 into a torque limit; the default makes rated current
    yield rated torque.
    """

    node_id: int = 1
    rated_current_mA: int = 5000
    rated_torque_mNm: float = 500  # motor side
    rated_torque_unit_mNm: float = 1.0  # of 6076
    reduction_ratio: float = 121.0
    motor_torque_constant_NmpA: float | None = None
    vendor_id: int = 0
    product_code: int = 1
    revision: int = 0x00010000
    serial_number: int = 1
    velocity_gain_Nmspr: float = 200.0
    velocity_integral_Nmprad: float = 10_000.0
    position_gain_ps: float = 30.0
    velocity_feed: float = 1.0  # share of the set-point's velocity that CSP feeds forward by itself
    loop_rate_Hz: float = 0.0  # of the loops in CSP and CSV; 0 = each substep of the plant
    parameter_file: Path | None = None  # keeps what 1010 saves; None = as long as the device exists
    torque_direction: int = 1  # -1: positive motor torque drives the joint to negative angles
    second_counts_prad: float = 0.0  # of 60E4:1, on the joint, with the sign of its direction
    second_offset_counts: float = 0.0
    encoder: EncoderSettings | None = None  # an encoder node on the joint
    velocity_unit_radps: float | None = None  # at the joint, of one unit of 60FF; None = counts of 6064 per s
    quick_stop: tuple[int, float] | None = None  # the object with its ramp, and that at the joint [rad/s2]; None = EDS
    torque_limit: tuple[int, int, float] | None = None  # the maker's own: index, sub, what it holds at rated torque
    shown: canopen.ObjectDictionary | None = None  # the objects of another drive, see `ObjectDictionary`

    def __post_init__(self) -> None:
        for name, low, high in (
            ("node_id", 1, 127),
            ("rated_current_mA", 1, 100_000_000),
            ("rated_torque_mNm", 1, 100_000_000),
            ("reduction_ratio", 0.001, 100_000.0),
            ("vendor_id", 0, 0xFFFFFFFF),
            ("product_code", 0, 0xFFFFFFFF),
            ("revision", 0, 0xFFFFFFFF),
            ("serial_number", 0, 0xFFFFFFFF),
            ("velocity_gain_Nmspr", 0.0, 1e6),
            ("velocity_integral_Nmprad", 0.0, 1e8),
            ("position_gain_ps", 0.0, 1e4),
            ("velocity_feed", 0.0, 1.0),
            ("loop_rate_Hz", 0.0, 1e5),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} (={value}) must be in [{low}..{high}]")
        if self.torque_direction not in (1, -1):
            raise ValueError(f"torque_direction (={self.torque_direction}) must be 1 or -1")
        constant = self.motor_torque_constant_NmpA
        if constant is not None and not 0.0 < constant < math.inf:
            raise ValueError(f"motor_torque_constant_NmpA (={constant}) must be greater than 0")

    @property
    def torque_constant_NmpA(self) -> float:
        """The given one, or rated torque per rated current."""
        return self.motor_torque_constant_NmpA or self.rated_torque_mNm / self.rated_current_mA


class DeviceRow(NamedTuple):
    """The records of the drives of one bus, which one compiled loop serves; arrays of one element a drive."""

    devices: Any  # Device[N]
    plant_constants: Any  # PlantConstants[N]
    plant_states: Any  # PlantState[N]

    def part(self, index: int) -> DeviceRow:
        """Of one drive: views, not copies."""
        return DeviceRow(*(array[index : index + 1] for array in self))


def _sdo_frames(node_id: int, responses: list[bytes]) -> list[bytes]:
    """The answers of an SDO server as frames of 16 bytes."""
    return [struct.pack("<IB3x8s", 0x580 + node_id, 8, data) for data in responses]


class Cia402Device:
    """One drive with its plant.  `device`, `plant_constants`, `plant_state`, `queue` are record arrays for kernels.

    `faults` (FaultConstants[N], see `hil.faults`) are carried out by `RealtimeDevice`, not by `handle` and
    `advance`.
    """

    def __init__(
        self,
        eds_path: Path,
        settings: DeviceSettings,
        plant_constants: np.recarray,
        plant_state: np.recarray,
        faults: np.recarray | None = None,
        row: tuple[DeviceRow, int] | None = None,
    ) -> None:
        """`row` with the place in it: the drive is one of several, and its records, the given ones too, lie there."""
        for name, array, record in (
            ("plant_constants", plant_constants, PlantConstants),
            ("plant_state", plant_state, PlantState),
        ):
            if getattr(array, "dtype", None) != dtype_of(record):
                raise TypeError(f"{name} (={type(array).__name__}) must be a record array of {record.__name__}")
        self.settings = settings
        whole, index = row or (DeviceRow(new(Device), plant_constants, plant_state), 0)
        own = whole.part(index) if row is not None else whole
        if row is not None:
            own.plant_constants[:], own.plant_states[:] = plant_constants, plant_state
        self.whole_row = whole
        self.device, self.plant_constants, self.plant_state = own
        self.faults: np.ndarray = np.zeros(0) if faults is None else faults
        self.queue = new(FrameQueue)
        self._frame = np.zeros(FRAME_SIZE, np.uint8)
        counts_per_turn = math.tau * abs(float(self.plant_constants[0].counts_prad))
        self.objects = ObjectDictionary(eds_path, settings.node_id, self.device, settings.shown, counts_per_turn)
        self._configure()
        self.parameters = ParameterStore(self.objects, settings.parameter_file)
        self.objects.restore_strings()
        self.sdo = SdoServer(self.objects, self._write)
        self.encoder = VirtualEncoder(settings.encoder, self.device) if settings.encoder is not None else None
        power_on(self.device[0])
        self._resets = int(self.device[0].application_resets)

    def _configure(self) -> None:
        settings, device, objects = self.settings, self.device[0], self.objects
        device.node_id = settings.node_id
        device.reduction_ratio = settings.reduction_ratio
        device.rated_torque_unit_mNm = settings.rated_torque_unit_mNm
        device.motor_torque_constant_NmpA = settings.torque_constant_NmpA
        device.velocity_gain_Nmspr = settings.velocity_gain_Nmspr
        device.velocity_integral_Nmprad = settings.velocity_integral_Nmprad
        device.position_gain_ps = settings.position_gain_ps
        device.velocity_feed = settings.velocity_feed
        device.loop_period_s = 1.0 / settings.loop_rate_Hz if settings.loop_rate_Hz else 0.0
        device.torque_sign = float(settings.torque_direction)
        device.second_counts_prad = settings.second_counts_prad
        device.second_offset_counts = settings.second_offset_counts
        device.counts_per_rad = self.plant_constants[0].counts_prad
        unit_radps = settings.velocity_unit_radps
        device.velocity_units_prad = device.counts_per_rad
        if unit_radps is not None:
            device.velocity_units_prad = math.copysign(1.0 / unit_radps, device.counts_per_rad)
        objects.set_default(0x608F, 1, round(abs(device.counts_per_rad) * 2.0 * math.pi))
        objects.set_default(0x608F, 2, max(1, round(settings.reduction_ratio)))
        objects.set_default(0x6075, 0, settings.rated_current_mA)
        objects.set_default(0x6076, 0, round(settings.rated_torque_mNm / settings.rated_torque_unit_mNm))
        if settings.quick_stop is not None:
            objects.set_ramp(*settings.quick_stop, abs(device.counts_per_rad))
        if settings.torque_limit is not None and objects.limit_torque_by(*settings.torque_limit):
            device.makers_limit_rated_counts = settings.torque_limit[2]
        identity = (settings.vendor_id, settings.product_code, settings.revision, settings.serial_number)
        for sub, value in enumerate(identity, 1):
            objects.set_default(0x1018, sub, value)

    def _write(self, index: int, sub: int, data: bytes) -> None:
        value = self.objects.check(index, sub, data)
        state = int(self.device[0].state)
        check_write(self.objects, index, sub, value, state)
        if index in (0x1010, 0x1011):
            self.parameters.command(index, sub, value, state)
        else:
            self.objects.store(index, sub, data)

    def is_addressed(self, frame: bytes) -> bool:
        """True for an SDO request to this drive or its encoder node, in whatever state."""
        identifier = struct.unpack_from("<I", frame)[0]
        return bool(identifier == 0x600 + self.settings.node_id) or self._is_for_encoder(frame)

    def is_sdo_request(self, frame: bytes) -> bool:
        """True for a frame that `answer_sdo` is for, in a state in which SDO is alive."""
        identifier = struct.unpack_from("<I", frame)[0]
        if self._is_for_encoder(frame):
            return True
        alive = self.device[0].nmt not in (NmtState.BOOT_UP, NmtState.STOPPED)
        return bool(identifier == 0x600 + self.settings.node_id and alive)

    def _is_for_encoder(self, frame: bytes) -> bool:
        encoder = self.encoder
        return encoder is not None and struct.unpack_from("<I", frame)[0] == 0x600 + encoder.settings.node_id

    def answer_sdo(self, frame: bytes, now_ns: int) -> list[bytes]:
        """SDO response frames; the core notices what was written at its next `advance`."""
        if self.encoder is not None and self._is_for_encoder(frame):
            if not self.encoder.answers_sdo:
                return []
            answers = self.encoder.sdo.handle(frame[8 : 8 + min(frame[4], 8)], now_ns)
            return _sdo_frames(self.encoder.settings.node_id, answers)
        resets = int(self.device[0].application_resets)
        if resets != self._resets:
            self._resets = resets
            self.objects.restore_strings()
            self.sdo = SdoServer(self.objects, self._write)
        size = min(frame[4], 8)
        return _sdo_frames(self.settings.node_id, self.sdo.handle(frame[8 : 8 + size], now_ns))

    def expire_sdo(self, now_ns: int) -> list[bytes]:
        """The abort frame of an SDO transfer whose client has fallen silent, if there is one."""
        return _sdo_frames(self.settings.node_id, self.sdo.expire(now_ns))

    def _take_queue(self) -> list[bytes]:
        queue = self.queue[0]
        frames = [bytes(queue.frames[i]) for i in range(int(queue.count))]
        queue.count = 0
        return frames

    def advance(self, now_ns: int) -> list[bytes]:
        """Run drive and plant up to `now_ns`; the frames (16 bytes each) that were sent in the meantime."""
        advance(self.device[0], self.plant_constants[0], self.plant_state[0], now_ns, self.queue[0])
        return self._take_queue() + self.expire_sdo(now_ns)

    def handle(self, frame: bytes, now_ns: int) -> list[bytes]:
        """Take one frame (16 bytes) from the bus at `now_ns`; the frames sent up to then, then the answers to it."""
        if len(frame) != FRAME_SIZE:
            raise ValueError(f"frame length (={len(frame)}) must be {FRAME_SIZE}")
        sent = self.advance(now_ns)
        if self.is_sdo_request(frame):
            responses = self.answer_sdo(frame, now_ns)
            self.device[0].next_due_ns = 0
            return sent + self.advance(now_ns) + responses
        self._frame[:] = np.frombuffer(frame, np.uint8)
        accept_frame(self.device[0], self.plant_constants[0], self.plant_state[0], self._frame, now_ns, self.queue[0])
        return sent + self._take_queue()

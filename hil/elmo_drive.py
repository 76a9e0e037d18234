"""The virtual Elmo drive with the plant behind it: its inside, and its interpreter, one command in, one reply out.

Written from the description of the protocol, not from the driver: a constant that is wrong on one side cannot
cancel out.  Replies here are without echo; `hil.elmo_line` adds it, with the times of the line.

Not modelled: programs, recorder, homing, PVT, tables, digital outputs, saving to flash (SV is taken and does nothing),
and the limits that real drives put on the order in which HL, LL, VH and VL may be written.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.schema import f8, i4, i8, new, record
from jointctl.hil.plant import encoder_counts, shaft_velocity_radps, step_plant
from jointctl.hil.plant_records import PlantConstants, PlantState

# --- The inside: unit modes, current limiting, the drive's own limits, around the plant ---
#
# Every 50 us substep: speed and position loops (UM 2 and 5), then peak and continuous current limit, then the joint.
#
# Speeds and positions are in encoder counts as the drive counts them, currents in amperes.
# Current limiting: the demand may be above CL[1] for PL[2] seconds, then it is held at CL[1] until it has been below
# for as long.  Not modelled: the heating model behind it, commutation, the bus voltage, the limits of jerk (SF).

UM_TORQUE, UM_SPEED, UM_POSITION = 1, 2, 5
MF_SPEED_ERROR = 0x80
MF_OVERSPEED, MF_POSITION_LIMIT = 0x20000, 0x400000
SPEED_BANDWIDTH_RADPS = 95.0  # tuned as the virtual CANopen drive is
INTEGRAL_SHARE = 0.5  # of that bandwidth: damping 0.7
POSITION_BANDWIDTH_PS = 10.0
SETTLED_COUNTS = 2.0


@record
class ElmoMotor:
    """What the commands set, and what the drive does about it."""

    unit_mode: i4
    motor_on: i4
    motor_fault: i8
    current_sign: i4  # -1: positive current drives the counts down
    torque_A: f8  # TC
    jog_cps: f8  # JV as the last BG took it over
    acceleration_cps2: f8
    deceleration_cps2: f8
    stop_deceleration_cps2: f8  # SD, from ST on until the next BG
    profile_cps: f8  # SP
    target_counts: f8  # PA as the last BG took it over
    continuous_A: f8
    peak_A: f8
    peak_s: f8
    speed_high_cps: f8
    speed_low_cps: f8
    position_high_counts: f8
    position_low_counts: f8
    speed_error_cps: f8
    position_error_counts: f8
    # state
    reference_cps: f8
    integral_A: f8
    over_s: f8  # time above CL[1], at most PL[2]
    limited: i4
    demand_A: f8
    moving: i4
    stopping: i4
    gain_Apcps: f8


@kernel
def switch_off(m: ElmoMotor, fault: int) -> None:
    """Power stage off; the first fault stays."""
    m.motor_on = 0
    m.torque_A = 0.0
    m.demand_A = 0.0
    m.moving = 0
    if m.motor_fault == 0:
        m.motor_fault = fault


@kernel
def _approach(value: float, target: float, up: float, down: float) -> float:
    """One step of `value` towards `target`; `up` when the size grows, `down` when it falls."""
    step = up if abs(target) > abs(value) else down
    return min(max(target, value - step), value + step)


@kernel
def _speed_demand_A(m: ElmoMotor, target_cps: float, speed_cps: float, step_s: float) -> float:
    down_cps2 = m.stop_deceleration_cps2 if m.stopping != 0 else m.deceleration_cps2
    m.reference_cps = _approach(m.reference_cps, target_cps, m.acceleration_cps2 * step_s, down_cps2 * step_s)
    error_cps = m.reference_cps - speed_cps
    if abs(error_cps) > m.speed_error_cps:
        switch_off(m, MF_SPEED_ERROR)
        return 0.0
    rate = m.gain_Apcps * INTEGRAL_SHARE * SPEED_BANDWIDTH_RADPS
    m.integral_A = min(max(m.integral_A + rate * error_cps * step_s, -m.peak_A), m.peak_A)
    return m.gain_Apcps * error_cps + m.integral_A


@kernel
def _profile_cps(m: ElmoMotor, counts: float) -> float:
    """Speed of a trapezoid towards the target, from where the joint is."""
    distance = m.target_counts - counts
    if abs(distance) <= SETTLED_COUNTS and abs(m.reference_cps) < 0.01 * m.profile_cps:
        m.moving = 0
    speed = min(m.profile_cps, math.sqrt(m.deceleration_cps2 * abs(distance)))
    speed = min(speed, POSITION_BANDWIDTH_PS * abs(distance))
    return speed if distance > 0.0 else -speed


@kernel
def _limited_A(m: ElmoMotor, demand_A: float, step_s: float) -> float:
    """Peak limit, and the continuous limit once the peak time is used up."""
    if m.limited == 0:
        m.over_s = min(m.over_s + step_s, m.peak_s) if abs(demand_A) > m.continuous_A else max(m.over_s - step_s, 0.0)
        if m.over_s >= m.peak_s and abs(demand_A) > m.continuous_A:
            m.limited = 1
    elif abs(demand_A) <= m.continuous_A:
        m.over_s -= step_s
        if m.over_s <= 0.0:
            m.limited = 0
    limit = m.continuous_A if m.limited != 0 else m.peak_A
    return min(max(demand_A, -limit), limit)


@kernel
def joint_sign(c: PlantConstants, m: ElmoMotor) -> float:
    """-1: positive current drives the joint to negative angles."""
    return float(m.current_sign) if c.counts_prad > 0.0 else -float(m.current_sign)


@kernel
def advance_motor(m: ElmoMotor, c: PlantConstants, s: PlantState, substeps: int) -> None:
    """Drive and joint together, `substeps` of `c.step_s`."""
    for _ in range(substeps):
        speed_cps = shaft_velocity_radps(c, s) * c.counts_prad
        position_rad = s.motor_position_rad if c.encoder_motor_side != 0 else s.joint_position_rad
        counts = position_rad * c.counts_prad + c.encoder_offset_counts
        demand_A = 0.0
        if m.motor_on != 0:
            if speed_cps > m.speed_high_cps or speed_cps < m.speed_low_cps:
                switch_off(m, MF_OVERSPEED)
            elif counts > m.position_high_counts or counts < m.position_low_counts:
                switch_off(m, MF_POSITION_LIMIT)
            elif m.unit_mode == UM_TORQUE:
                demand_A = m.torque_A
            elif m.unit_mode == UM_SPEED:
                demand_A = m.current_sign * _speed_demand_A(m, m.jog_cps, speed_cps, c.step_s)
                m.moving = int(m.reference_cps != 0.0)
            elif m.unit_mode == UM_POSITION:
                target_cps = _profile_cps(m, counts)
                demand_A = m.current_sign * _speed_demand_A(m, target_cps, speed_cps, c.step_s)
        m.demand_A = _limited_A(m, demand_A, c.step_s)
        step_plant(c, s, joint_sign(c, m) * m.demand_A * c.torque_per_current_NmpA)


@kernel
def position_counts(c: PlantConstants, s: PlantState) -> int:
    """PX."""
    return encoder_counts(c, s)


def status_register(m: ElmoMotor, amplifier: int) -> int:
    """SR: amplifier in bits 0-3, servo on, fault latched, unit mode, current limited, motion status."""
    moving = int(m.moving) if m.motor_on else 0
    on, fault = int(m.motor_on), int(m.motor_fault != 0)
    return amplifier | on << 4 | fault << 6 | int(m.unit_mode) << 7 | int(m.limited) << 13 | moving * 2 << 14


# --- Its language: error codes, the shape of a command, where a setting is kept ---


BAD_COMMAND, BAD_INDEX, NOT_IN_THIS_MODE, SYNTAX, OUT_OF_RANGE = 2, 3, 12, 19, 21
NOT_ASSIGNABLE, OUT_OF_LIMIT, MOTOR_MUST_BE_OFF, MOTOR_MUST_BE_ON, BAD_UNIT_MODE = 23, 28, 57, 58, 60
AMPLIFIER_NOT_READY = 66
COMMAND = re.compile(r"([A-Z]{2})(?:\[(\d{1,4})\])?(?:=(.*))?", re.ASCII)
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
MOTOR_FIELDS = {
    ("CL", 1): "continuous_A", ("PL", 1): "peak_A", ("PL", 2): "peak_s",
    ("HL", 2): "speed_high_cps", ("LL", 2): "speed_low_cps",
    ("HL", 3): "position_high_counts", ("LL", 3): "position_low_counts",
    ("ER", 2): "speed_error_cps", ("ER", 3): "position_error_counts",
    ("SP", 0): "profile_cps", ("AC", 0): "acceleration_cps2", ("DC", 0): "deceleration_cps2",
    ("SD", 0): "stop_deceleration_cps2",
}  # fmt: skip
WHOLE = frozenset(("HL", "LL", "ER", "SP", "AC", "DC", "SD"))
INDEXED = frozenset(("CL", "PL", "HL", "LL", "ER", "VL", "VH", "CA"))


class RefusedCommandError(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True, kw_only=True)
class ElmoDeviceSettings:
    """The virtual drive itself; what the joint is like is in the plant."""

    version: str = "Whistle 1.01.06.22 31Oct2006"
    maximum_current_A: float = 20.0  # MC
    counts_per_turn: int = 524288  # CA[18]
    current_sign: int = 1  # -1: positive current drives the counts down
    power_on_unit_mode: int = UM_POSITION


# --- The command interpreter of the virtual Elmo drive: one command in, one reply out, the plant behind it ---


SUBSTEPS_AT_ONCE_S = 2.0  # after a longer sleep of this process, time is lost rather than caught up


class ElmoInterpreter:
    """`execute(line)` one command without its end; `advance_to(time)` moves drive and joint on."""

    def __init__(self, settings: ElmoDeviceSettings, plant_constants: np.recarray, plant_state: np.recarray) -> None:
        self.settings = settings
        self.constants, self.state = plant_constants, plant_state
        self.motor: Any = new(ElmoMotor)
        self._c, self._s, self.m = plant_constants[0], plant_state[0], self.motor[0]
        self.echo = True
        self.amplifier = 0  # SR bits 0-3: set from outside, as a voltage that is missing would
        self.jog_cps = 0.0
        self.target_counts = 0.0
        self._plain: dict[tuple[str, int], float] = {}
        self.restart()

    @property
    def current_A(self) -> float:
        """Of the motor, as the drive counts it: the plant's is positive towards positive angle."""
        return float(joint_sign(self._c, self.m)) * float(self._s.current_A)

    # --- life ---

    def restart(self) -> None:
        """Power off and on: everything that was not saved is as it was made."""
        c, s, m = self._c, self._s, self.m
        self.motor[:] = new(ElmoMotor)
        m.unit_mode = self.settings.power_on_unit_mode
        m.current_sign = self.settings.current_sign
        per_rad = abs(float(c.counts_prad))
        m.continuous_A, m.peak_A, m.peak_s = 5.0, 10.0, 3.0
        m.speed_high_cps, m.speed_low_cps = 10.0 * per_rad, -10.0 * per_rad
        m.position_high_counts, m.position_low_counts = 1e9, -1e9
        m.speed_error_cps, m.position_error_counts = 5.0 * per_rad, 1e9
        m.profile_cps = 0.2 * per_rad
        m.acceleration_cps2 = m.deceleration_cps2 = m.stop_deceleration_cps2 = 2.0 * per_rad
        inertia = float(c.driven_inertia_kgm2)
        m.gain_Apcps = SPEED_BANDWIDTH_RADPS * inertia / float(c.torque_per_current_NmpA) / per_rad
        m.target_counts = position_counts(c, s)
        self.target_counts = float(m.target_counts)
        self.jog_cps, self.error_code, self.echo = 0.0, 0, True
        self._plain = {("RM", 0): 0.0, ("PM", 0): 1.0}

    def advance_to(self, time_s: float) -> None:
        """Move drive and joint on to `time_s` of the plant's own clock."""
        substeps = int((time_s - float(self._s.time_s)) / float(self._c.step_s))
        limit = int(SUBSTEPS_AT_ONCE_S / float(self._c.step_s))
        if substeps > 0:
            advance_motor(self.m, self._c, self._s, min(substeps, limit))

    # --- commands ---

    def execute(self, line: bytes) -> bytes:
        """The reply with its `;`, or error byte and `?;`."""
        try:
            return self._reply(line.decode("latin-1").strip()).encode() + b";"
        except RefusedCommandError as refusal:
            self.error_code = refusal.code
            return bytes((refusal.code,)) + b"?;"

    def _reply(self, text: str) -> str:
        if not text:
            return ""
        match = COMMAND.fullmatch(text)
        if match is None:
            raise RefusedCommandError(SYNTAX)
        name, index_text, value_text = match.groups()
        if (index_text is not None) != (name in INDEXED):
            known = name in INDEXED or name in _HANDLERS or (name, 0) in {**MOTOR_FIELDS, **self._plain}
            raise RefusedCommandError(BAD_INDEX if known else BAD_COMMAND)
        index = int(index_text or 0)
        value = None
        if value_text is not None:
            if not NUMBER.fullmatch(value_text):
                raise RefusedCommandError(SYNTAX)
            value = float(value_text)
        handler = _HANDLERS.get(name)
        if handler is not None:
            return handler(self, value)
        return self._parameter(name, index, value)

    def _parameter(self, name: str, index: int, value: float | None) -> str:
        field = MOTOR_FIELDS.get((name, index))
        if (name, index) == ("CA", 18):
            return self._constant(value, self.settings.counts_per_turn)
        if (name, index) in (("VL", 2), ("VH", 2)):
            return self._constant(value, round(float(self.m.speed_low_cps if name == "VL" else self.m.speed_high_cps)))
        if field is None and (name, index) not in self._plain:
            raise RefusedCommandError(BAD_INDEX if name in INDEXED else BAD_COMMAND)
        if value is None:
            number = float(getattr(self.m, field)) if field else self._plain[(name, index)]
            return str(round(number)) if name in WHOLE or field is None else f"{number:.4f}"
        self._check(name, index, value)
        if field:
            setattr(self.m, field, value)
        else:
            self._plain[(name, index)] = value
        return ""

    def _check(self, name: str, index: int, value: float) -> None:
        m = self.m
        if name in ("CL", "PL") and (index == 1 or name == "CL"):
            low_enough = value <= (float(m.peak_A) if name == "CL" else self.settings.maximum_current_A)
            if not 0.0 < value <= self.settings.maximum_current_A:
                raise RefusedCommandError(OUT_OF_RANGE)
            if not low_enough or (name == "PL" and value < float(m.continuous_A)):
                raise RefusedCommandError(OUT_OF_LIMIT)
        elif (name in ("AC", "DC", "SD", "SP", "ER") or (name, index) == ("PL", 2)) and value <= 0.0:
            raise RefusedCommandError(OUT_OF_RANGE)
        elif name in ("RM", "PM"):
            if m.motor_on:
                raise RefusedCommandError(MOTOR_MUST_BE_OFF)
            if value not in (0.0, 1.0):
                raise RefusedCommandError(OUT_OF_RANGE)

    @staticmethod
    def _constant(value: float | None, present: float) -> str:
        if value is not None:
            raise RefusedCommandError(NOT_ASSIGNABLE)
        return f"{present:g}" if isinstance(present, float) else str(present)

    def _on(self, value: float | None) -> str:
        if value is None:
            return str(int(self.m.motor_on))
        if value not in (0.0, 1.0):
            raise RefusedCommandError(OUT_OF_RANGE)
        m = self.m
        if value == 0.0:
            if m.motor_on:
                switch_off(m, 0)
        elif not m.motor_on:
            if self.amplifier:
                raise RefusedCommandError(AMPLIFIER_NOT_READY)
            m.motor_fault, m.motor_on, m.stopping = 0, 1, 0
            m.torque_A = m.reference_cps = m.integral_A = m.jog_cps = 0.0
            m.target_counts = position_counts(self._c, self._s)
            self.target_counts = float(m.target_counts)
        return ""

    def _unit_mode(self, value: float | None) -> str:
        if value is None:
            return str(int(self.m.unit_mode))
        if self.m.motor_on:
            raise RefusedCommandError(MOTOR_MUST_BE_OFF)
        if not 1.0 <= value <= 6.0:
            raise RefusedCommandError(OUT_OF_RANGE)
        if value not in (UM_TORQUE, UM_SPEED, UM_POSITION):
            raise RefusedCommandError(BAD_UNIT_MODE)
        self.m.unit_mode = int(value)
        return ""

    def _need(self, *unit_modes: int) -> None:
        if not self.m.motor_on:
            raise RefusedCommandError(MOTOR_MUST_BE_ON)
        if self.m.unit_mode not in unit_modes:
            raise RefusedCommandError(NOT_IN_THIS_MODE)

    def _torque(self, value: float | None) -> str:
        if value is None:
            return f"{float(self.m.torque_A):.3f}"
        self._need(UM_TORQUE)
        if abs(value) > float(self.m.peak_A):
            raise RefusedCommandError(OUT_OF_LIMIT)
        self.m.torque_A = value
        return ""

    def _jog(self, value: float | None) -> str:
        if value is None:
            return str(round(self.jog_cps))
        if not float(self.m.speed_low_cps) <= value <= float(self.m.speed_high_cps):
            raise RefusedCommandError(OUT_OF_RANGE)
        self.jog_cps = value
        return ""

    def _absolute(self, value: float | None) -> str:
        if value is None:
            return str(round(self.target_counts))
        if not float(self.m.position_low_counts) <= value <= float(self.m.position_high_counts):
            raise RefusedCommandError(OUT_OF_LIMIT)
        self.target_counts = value
        return ""

    def _begin(self, value: float | None) -> str:
        self._no_value(value)
        self._need(UM_SPEED, UM_POSITION)
        if self.m.unit_mode == UM_SPEED:
            self.m.jog_cps, self.m.stopping = self.jog_cps, 0
        else:
            self.m.target_counts, self.m.moving, self.m.stopping = self.target_counts, 1, 0
        return ""

    def _stop(self, value: float | None) -> str:
        self._no_value(value)
        m = self.m
        m.jog_cps, m.stopping = 0.0, 1  # JV stays as it was said: another BG would jog again
        if m.unit_mode == UM_POSITION and m.motor_on:
            m.target_counts = position_counts(self._c, self._s)
            m.moving = 0
        elif m.unit_mode == UM_TORQUE:
            m.torque_A = 0.0
        return ""

    def _no_value(self, value: float | None) -> None:
        if value is not None:
            raise RefusedCommandError(NOT_ASSIGNABLE)

    def _read_only(self, value: float | None, text: str) -> str:
        self._no_value(value)
        return text

    def _position(self, value: float | None) -> str:
        if value is None:
            return str(position_counts(self._c, self._s))
        if self.m.motor_on:
            raise RefusedCommandError(MOTOR_MUST_BE_OFF)
        self._c.encoder_offset_counts += round(value) - position_counts(self._c, self._s)
        return ""

    def _echo(self, value: float | None) -> str:
        if value is None:
            return str(int(self.echo))
        if value not in (0.0, 1.0):
            raise RefusedCommandError(OUT_OF_RANGE)
        self.echo = bool(value)
        return ""

    def status(self) -> int:
        """SR."""
        return status_register(self.m, self.amplifier)

    def speed_cps(self) -> float:
        """VX."""
        return float(shaft_velocity_radps(self._c, self._s)) * float(self._c.counts_prad)


_HANDLERS: dict[str, Callable[[ElmoInterpreter, float | None], str]] = {
    "MO": ElmoInterpreter._on,
    "UM": ElmoInterpreter._unit_mode,
    "TC": ElmoInterpreter._torque,
    "JV": ElmoInterpreter._jog,
    "PA": ElmoInterpreter._absolute,
    "BG": ElmoInterpreter._begin,
    "ST": ElmoInterpreter._stop,
    "PX": ElmoInterpreter._position,
    "EO": ElmoInterpreter._echo,
    "VR": lambda d, v: d._read_only(v, d.settings.version),
    "SR": lambda d, v: d._read_only(v, str(d.status())),
    "MF": lambda d, v: d._read_only(v, str(int(d.m.motor_fault))),
    "EC": lambda d, v: d._read_only(v, str(d.error_code)),
    "VX": lambda d, v: d._read_only(v, str(round(d.speed_cps()))),
    "IQ": lambda d, v: d._read_only(v, f"{d.current_A:.4f}"),
    "MC": lambda d, v: d._read_only(v, f"{d.settings.maximum_current_A:.4f}"),
    "MS": lambda d, v: d._read_only(v, "2" if d.m.motor_on and d.m.moving else "0"),
    "IP": lambda d, v: d._read_only(v, "0"),
    "SV": lambda d, v: d._read_only(v, ""),
}

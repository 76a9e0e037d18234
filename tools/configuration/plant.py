"""The [virtual] section: the true values of the virtual joint, which the controller does not know.

What is not repeated here (reduction ratio, torque constant, encoder) is taken from the other sections; inertia and
friction are those of the controller times a scale: the difference is the model error under study.  With a table of
its own, [virtual.friction], the joint has friction of which the controller knows nothing.  Keys have the
names of `hil.plant.records.PlantSettings`, whose checks apply too.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from jointctl.tools.configuration.sections import Friction, Rule, Section, between

OWN_KEYS = ("friction_kind", "inertia_scale", "friction", "faults")
MAX_FAULTS = 8
# by their names in `hil.faults.kinds`, which a run on hardware does not load
FAULT_KINDS = (
    "frames_lost", "sync_lost", "rpdo_lost", "tpdo_lost", "controller_heartbeat_lost", "drive_heartbeat_lost",
    "rpdo_delayed", "tpdo_delayed", "rpdo_duplicated", "tpdo_duplicated", "rpdo_reordered", "tpdo_reordered",
    "rpdo_corrupted", "tpdo_corrupted", "rpdo_length", "tpdo_length", "foreign_frames", "bus_off",
    "drive_reboot", "drive_fault", "encoder_stuck", "encoder_jump", "encoder_drift", "encoder_reversed",
    "torque_reversed", "torque_saturated", "current_loop_dead", "load_jump",
)  # fmt: skip
FAULT_KINDS_TEXT = "one of " + ", ".join(FAULT_KINDS)


NUMBERS_TEXT = "a list of up to 4 numbers"


def _list(value: Any) -> Any:
    """Lists of TOML as tuples, which a frozen model needs."""
    good = isinstance(value, (list, tuple)) and len(value) <= 4
    if not good or any(isinstance(x, bool) or not isinstance(x, (int, float)) for x in value):
        raise PydanticCustomError("numbers", f"must be {NUMBERS_TEXT}")
    return tuple(float(x) for x in value)


Numbers = Annotated[tuple[float, ...], BeforeValidator(Rule(NUMBERS_TEXT, _list))]


def _kind(value: Any) -> Any:
    if value not in FAULT_KINDS:
        raise PydanticCustomError("fault_kind", "must be {kinds}", {"kinds": FAULT_KINDS_TEXT})
    return value


class VirtualFault(Section):
    """One fault on purpose; what `magnitude` means for each kind is told in `hil.faults.kinds`."""

    kind: Annotated[str, BeforeValidator(Rule(FAULT_KINDS_TEXT, _kind))]  # what goes wrong
    at_s: Annotated[float, between(0.0, 1e6)]  # after the power stage is on for the first time
    duration_s: Annotated[float, between(0.0, 1e6, open_low=True)] = 1e6  # how long
    magnitude: Annotated[float, between(-1e6, 1e6)] = 1.0  # its meaning for each kind is in hil/faults/kinds.py
    seed: Annotated[int, between(1, 2**31 - 1)] = 1  # of random ones


FAULTS_TEXT = f"a list of at most {MAX_FAULTS} faults"


def _faults(value: Any) -> Any:
    """A list of tables as a tuple, which a frozen model needs."""
    if not isinstance(value, (list, tuple)) or len(value) > MAX_FAULTS:
        raise PydanticCustomError("faults", f"must be {FAULTS_TEXT}")
    return tuple(value)


class Virtual(Section):
    step_s: Annotated[float, between(1e-6, 1e-3)] = 50e-6  # of the plant's integration
    initial_position_rad: Annotated[float, between(-1000.0, 1000.0)] = 0.0  # where the joint stands at the start
    inertia_scale: Annotated[float, between(0.1, 10.0)] = 1.0  # true inertia over joint.inertia_kgm2
    current_limit_A: Annotated[float, between(0.001, 10_000.0)] = 100.0  # of the motor
    current_lag_s: Annotated[float, between(0.0, 1.0)] = 0.0  # of the drive's current loop, first order
    command_delay_s: Annotated[float, between(0.0, 1.0)] = 0.0  # on top of the period that the synchronous RPDO takes
    torque_ripple_Nm: Numbers = ()  # amplitudes, at the joint
    torque_ripple_per_motor_turn: Numbers = ()  # periods of each
    torque_ripple_phase_rad: Numbers = ()  # of each
    friction_kind: Literal["none", "sign", "stick_slip", "lugre"]  # how it behaves around standstill
    friction_positive_scale: Annotated[float, between(0.0, 10.0)] = 1.0  # true friction over that of [friction]
    friction_negative_scale: Annotated[float, between(0.0, 10.0)] = 1.0  # the same, in the negative direction
    friction_ripple: Annotated[float, between(0.0, 0.9)] = 0.0  # relative amplitude
    friction_ripple_per_joint_turn: Annotated[float, between(0.0, 1e5)] = 18.0  # its periods
    bristle_stiffness_Nmprad: Annotated[float, between(1.0, 1e7)] = 8e4  # of friction_kind lugre
    bristle_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 200.0  # of friction_kind lugre
    flexible: bool = False  # motor and joint as two masses with the reducer between
    motor_side_inertia_kgm2: Annotated[float, between(1e-3, 1e4)] = 1.2  # at the joint; of joint.inertia_kgm2
    reducer_stiffness_Nmprad: Annotated[float, between(1.0, 1e8)] = 1.3e4  # with flexible = true
    reducer_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 5.0  # with flexible = true
    load_torque_Nm: Annotated[float, between(-1e5, 1e5)] = 0.0  # constant, at the joint
    load_step_Nm: Annotated[float, between(-1e5, 1e5)] = 0.0  # a load from load_step_at_s on
    load_step_at_s: Annotated[float, between(0.0, 1e9)] = 80.0  # of the plant's own time
    gravity_Nm: Annotated[float, between(0.0, 1e5)] = 0.0  # m g l of m g l sin(q)
    end_stops: bool = False  # springs at end_stop_min_rad and end_stop_max_rad
    end_stop_min_rad: Annotated[float, between(-1e4, 1e4)] = -3.0  # lower end stop
    end_stop_max_rad: Annotated[float, between(-1e4, 1e4)] = 3.0  # upper end stop
    end_stop_stiffness_Nmprad: Annotated[float, between(1.0, 1e8)] = 2e5  # of both springs
    end_stop_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 200.0  # of both springs
    thermal: bool = False  # friction falls as the joint warms up
    ambient_degC: Annotated[float, between(-60.0, 100.0)] = 25.0  # around the joint
    heating_KpA2: Annotated[float, between(0.0, 1e3)] = 0.5  # final warming per squared current
    thermal_time_s: Annotated[float, between(1.0, 1e6)] = 900.0  # time constant
    friction_per_kelvin: Annotated[float, between(-0.05, 0.05)] = -0.005  # relative change
    encoder_noise_counts: Annotated[float, between(0.0, 1e6)] = 0.0  # standard deviation
    encoder_seed: Annotated[int, between(1, 2**31 - 1)] = 1  # of the noise
    friction: Friction | None = None  # The true curve, if it is not that of [friction].
    faults: Annotated[tuple[VirtualFault, ...], BeforeValidator(Rule(FAULTS_TEXT, _faults))] = ()

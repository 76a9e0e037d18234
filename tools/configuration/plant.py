"""The [virtual] section: the true values of the virtual joint, which the controller does not know.

What is not repeated here (reduction ratio, torque constant, encoder) is taken from the other sections; inertia and
friction are those of the controller times a scale: the difference is the model error under study.  With a table of
its own, [virtual.friction], the joint has friction of which the controller knows nothing.  Keys have the
names of `hil.plant_records.PlantSettings`, whose checks apply too.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from hil.faults import LOCKSTEP_ONLY, MAX_FAULTS, FaultKind
from tools.configuration.sections import Friction, Section, between

OWN_KEYS = ("friction_kind", "inertia_scale", "friction", "faults")
FAULT_KINDS = tuple(kind.name.lower() for kind in FaultKind if kind not in (FaultKind.NONE, *LOCKSTEP_ONLY))


def _list(value: Any) -> Any:
    """Lists of TOML as tuples, which a frozen model needs."""
    good = isinstance(value, (list, tuple)) and len(value) <= 4
    if not good or any(isinstance(x, bool) or not isinstance(x, (int, float)) for x in value):
        raise PydanticCustomError("numbers", "must be a list of up to 4 numbers")
    return tuple(float(x) for x in value)


Numbers = Annotated[tuple[float, ...], BeforeValidator(_list)]


def _kind(value: Any) -> Any:
    if value not in FAULT_KINDS:
        raise PydanticCustomError("fault_kind", "must be one of {kinds}", {"kinds": ", ".join(FAULT_KINDS)})
    return value


class VirtualFault(Section):
    """One fault on purpose; what `magnitude` means for each kind is told in `hil.faults`."""

    kind: Annotated[str, BeforeValidator(_kind)]
    at_s: Annotated[float, between(0.0, 1e6)]  # after the power stage is on for the first time
    duration_s: Annotated[float, between(0.0, 1e6, open_low=True)] = 1e6
    magnitude: Annotated[float, between(-1e6, 1e6)] = 1.0
    seed: Annotated[int, between(1, 2**31 - 1)] = 1


def _faults(value: Any) -> Any:
    """A list of tables as a tuple, which a frozen model needs."""
    if not isinstance(value, (list, tuple)) or len(value) > MAX_FAULTS:
        raise PydanticCustomError("faults", "must be a list of at most {most} faults", {"most": MAX_FAULTS})
    return tuple(value)


class Virtual(Section):
    step_s: Annotated[float, between(1e-6, 1e-3)] = 50e-6
    initial_position_rad: Annotated[float, between(-1000.0, 1000.0)] = 0.0
    inertia_scale: Annotated[float, between(0.1, 10.0)] = 1.0  # true inertia over joint.inertia_kgm2
    current_limit_A: Annotated[float, between(0.001, 10_000.0)] = 100.0
    current_lag_s: Annotated[float, between(0.0, 1.0)] = 0.0
    command_delay_s: Annotated[float, between(0.0, 1.0)] = 0.0
    torque_ripple_Nm: Numbers = ()
    torque_ripple_per_motor_turn: Numbers = ()
    torque_ripple_phase_rad: Numbers = ()
    friction_kind: Literal["none", "sign", "stick_slip", "lugre"]
    friction_positive_scale: Annotated[float, between(0.0, 10.0)] = 1.0  # true friction over that of [friction]
    friction_negative_scale: Annotated[float, between(0.0, 10.0)] = 1.0
    friction_ripple: Annotated[float, between(0.0, 0.9)] = 0.0  # relative amplitude
    friction_ripple_per_joint_turn: Annotated[float, between(0.0, 1e5)] = 18.0
    bristle_stiffness_Nmprad: Annotated[float, between(1.0, 1e7)] = 8e4
    bristle_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 200.0
    flexible: bool = False
    motor_side_inertia_kgm2: Annotated[float, between(1e-3, 1e4)] = 1.2
    reducer_stiffness_Nmprad: Annotated[float, between(1.0, 1e8)] = 1.3e4
    reducer_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 5.0
    load_torque_Nm: Annotated[float, between(-1e5, 1e5)] = 0.0
    load_step_Nm: Annotated[float, between(-1e5, 1e5)] = 0.0
    load_step_at_s: Annotated[float, between(0.0, 1e9)] = 80.0  # of the plant's own time
    gravity_Nm: Annotated[float, between(0.0, 1e5)] = 0.0  # m g l of m g l sin(q)
    end_stops: bool = False
    end_stop_min_rad: Annotated[float, between(-1e4, 1e4)] = -3.0
    end_stop_max_rad: Annotated[float, between(-1e4, 1e4)] = 3.0
    end_stop_stiffness_Nmprad: Annotated[float, between(1.0, 1e8)] = 2e5
    end_stop_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 200.0
    thermal: bool = False
    ambient_degC: Annotated[float, between(-60.0, 100.0)] = 25.0
    heating_KpA2: Annotated[float, between(0.0, 1e3)] = 0.5
    thermal_time_s: Annotated[float, between(1.0, 1e6)] = 900.0
    friction_per_kelvin: Annotated[float, between(-0.05, 0.05)] = -0.005
    encoder_noise_counts: Annotated[float, between(0.0, 1e6)] = 0.0
    encoder_seed: Annotated[int, between(1, 2**31 - 1)] = 1
    friction: Friction | None = None  # the true curve; None = that of [friction]
    faults: Annotated[tuple[VirtualFault, ...], BeforeValidator(_faults)] = ()  # [[virtual.faults]]

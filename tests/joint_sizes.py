"""Joints from a finger to a base joint: the shipped one at another size, in torque mode and with a drive's own loop."""

from __future__ import annotations

from typing import Any, NamedTuple

from jointctl.tools.configuration.canopen import Cascade
from jointctl.tools.configuration.config import Config
from tests.configurations import shipped

TORQUES = ("tc_Nm", "ts_Nm", "tv", "a0", "a1", "a2", "a3")
TABLE_3_Nm = 121.0 * 0.1575  # static friction of the shipped joint


class Size(NamedTuple):
    torque_Nm: float
    inertia_kgm2: float
    ratio: float
    friction_Nm: float  # static
    speed_radps: float
    travel_rad: float  # to each side
    bits: int = 19
    rate_Hz: float = 1000.0
    gravity_Nm: float = 0.0


SIZES = {
    "finger": Size(0.3, 2e-4, 50.0, 0.056, 8.0, 0.8, 16),
    "short finger": Size(0.3, 1e-3, 100.0, 0.05, 3.0, 0.15),
    "wrist": Size(5.0, 0.05, 80.0, 0.6, 3.0, 1.5, 17, gravity_Nm=4.0),
    "short elbow": Size(30.0, 0.5, 50.0, 5.0, 1.0, 0.15, 17),
    "direct drive": Size(20.0, 0.1, 1.0, 0.25, 20.0, 3.0, 20),
    "base": Size(1000.0, 300.0, 160.0, 100.0, 0.5, 2.0, 20),
    "slow base": Size(1000.0, 300.0, 200.0, 187.0, 0.05, 1.0, 24, 500.0),
    "loaded base": Size(300.0, 60.0, 120.0, 25.0, 1.0, 1.0, 21, 250.0, 210.0),
}


def joint(size: Size, base: str = "precise", **more: Any) -> Config:
    """The shipped one at this size; it is in truth as it is believed."""
    config, factor = shipped(base), size.friction_Nm / TABLE_3_Nm
    assert config.friction is not None
    curve = {
        f"friction__{side}": branch.model_copy(
            update={name: getattr(branch, name) * factor * 121.0 for name in TORQUES}
        )
        for side, branch in (("positive", config.friction.positive), ("negative", config.friction.negative))
    }
    slower, left_Nm = size.rate_Hz / 1000.0, size.torque_Nm - size.gravity_Nm - size.friction_Nm
    changes = {
        "joint__reduction_ratio": size.ratio, "joint__inertia_kgm2": size.inertia_kgm2,
        "joint__gravity_Nm": size.gravity_Nm, "virtual__gravity_Nm": size.gravity_Nm,
        "drive__rated_torque_Nm": 1.01 * size.torque_Nm / size.ratio,
        "drive__rated_current_A": 10.1 * size.torque_Nm / size.ratio, "drive__rated_tolerance": 0.2,
        "encoder__counts_per_turn": 2**size.bits, "limits__torque_max_Nm": size.torque_Nm,
        "limits__torque_rate_max_Nmps": 333.0 * size.torque_Nm, "limits__velocity_max_radps": size.speed_radps,
        "limits__position_min_rad": -size.travel_rad, "limits__position_max_rad": size.travel_rad,
        "limits__following_error_max_rad": min(0.1, 0.2 * size.travel_rad),
        "limits__position_jump_max_rad": 0.02 + 6.0 * size.speed_radps / size.rate_Hz,
        "limits__standstill_radps": 0.02 * size.speed_radps, "trajectory__amplitude_rad": 0.3 * size.travel_rad,
        "trajectory__frequency_Hz": min(0.1, 0.1 * size.speed_radps / size.travel_rad),
        "sequence__brake_radps2": min(10.0 * size.speed_radps, 0.3 * left_Nm / size.inertia_kgm2),
        "loop__rate_Hz": size.rate_Hz, "control__kp": 3600.0 * slower**2, "control__kv": 120.0 * slower,
        "control__observer_radps": 60.0 * slower, "control__velocity_cutoff_Hz": 200.0 * slower,
        "control__learning": None, "friction__torque_side": "joint", "virtual__torque_ripple_Nm": (),
        "virtual__torque_ripple_per_motor_turn": (), "virtual__friction_positive_scale": 1.0,
        "virtual__friction_negative_scale": 1.0, "virtual__current_limit_A": 100.0 * size.torque_Nm / size.ratio,
        "virtual__bristle_stiffness_Nmprad": max(size.friction_Nm / 2e-4, 1.0),
        "virtual__bristle_damping_Nmspr": 0.5 * (size.friction_Nm / 2e-4 * size.inertia_kgm2) ** 0.5,
        **curve, **more,
    }  # fmt: skip
    return config.changed(**changes)


def own_loop_joint(size: Size, mode: str, cascade: dict[str, Any] | None = None, **more: Any) -> Config:
    """The same with a drive in CSP or CSV, whose gains go with inertia and friction, at rates down to 100 Hz."""
    gain = 95.0 * size.inertia_kgm2 * max(size.friction_Nm / size.inertia_kgm2 / 60.0, 1.0)
    gains: dict[str, Any] = {
        "velocity_gain_Nmspr": gain, "velocity_integral_Nmprad": 50.0 * gain,
        "position_gain_ps": min(30.0, size.rate_Hz / 25.0),
    }  # fmt: skip
    return joint(
        size, "csp", drive__mode=mode, drive__cascade=Cascade(**gains | (cascade or {})),
        drive__max_torque_permille=None, control__velocity_cutoff_Hz=0.2 * size.rate_Hz,
        virtual__initial_position_rad=0.05 * size.travel_rad, **more,
    )  # fmt: skip

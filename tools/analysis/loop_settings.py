"""From a configuration to the linear loop, with the origin of every assumption.

The delay counts from the instant at which the drive takes the position sample (SYNC) to the one at which the torque
command enters its current loop.  A synchronous RPDO takes effect with the next SYNC, one period after the sample that
it was computed from; an asynchronous one takes effect within the period, for which one period is an upper bound.  What
the drive adds inside is not visible on the bus: `margin.loop_delay_s` or a measured delay must contain it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.states import ControllerKind, Encoders
from jointctl.tools.analysis.linear_loop import LoopSettings, TwoMasses
from jointctl.tools.configuration.records import encoders_of_law, hidden_layer

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.configuration.sections import Reducer

_SAME_IN_CONTROL = {"kp", "kv", "ki", "observer_radps", "observer_delay_cycles", "learning_rate", "leakage_1ps"}


@dataclass(frozen=True)
class Assumption:
    """A value of the analysis and where it comes from."""

    name: str
    value: float
    unit: str
    origin: str


def _delay(config: Config, measured_s: float | None) -> tuple[float, str]:
    if measured_s is not None:
        return measured_s, "measured"
    if config.margin.loop_delay_s is not None:
        return config.margin.loop_delay_s, "margin.loop_delay_s"
    return config.drive.assumed_delay(config)


def loop_settings(config: Config, delay_s: float | None = None) -> tuple[LoopSettings, tuple[Assumption, ...]]:
    """The loop of this configuration; `delay_s` is a measured loop delay, which beats the configured one."""
    control, current_lag_s = config.control, config.margin.current_lag_s
    delay_s, delay_origin = _delay(config, delay_s)
    centres, widths = hidden_layer(control)
    try:
        settings = LoopSettings(
            kind=ControllerKind[control.kind.upper()],
            period_s=1.0 / config.loop.rate_Hz,
            delay_s=delay_s,
            lag_s=current_lag_s,
            inertia_kgm2=config.joint.inertia_kgm2,
            cutoff_Hz=control.velocity_cutoff_Hz,
            kalman=control.velocity_filter == "kalman",
            q=(control.lyapunov_q[0], control.lyapunov_q[-1]),
            **control.model_dump(include=_SAME_IN_CONTROL),
            centres=centres,
            widths=widths,
            weight_Nm=control.initial_weight_Nm,
            **_two_masses(config),
        )
    except ValueError as error:
        raise ConfigurationError(f"{config.path}: {error}") from None
    filtered = "Kalman filter" if settings.kalman else "0 = none"
    assumptions: tuple[Assumption, ...] = (
        Assumption("loop rate", config.loop.rate_Hz, "Hz", "loop.rate_Hz"),
        Assumption("loop delay", delay_s, "s", delay_origin),
        Assumption("current lag", current_lag_s, "s", "margin.current_lag_s"),
        Assumption("velocity filter", control.velocity_cutoff_Hz, "Hz", f"control.velocity_cutoff_Hz ({filtered})"),
        Assumption("joint inertia", config.joint.inertia_kgm2, "kg m^2", "joint.inertia_kgm2"),
    )
    if config.reducer is not None:
        resonance_Hz = two_masses(config, config.reducer, 1.0, 1.0, False).resonance_Hz
        assumptions += (
            Assumption("motor inertia", config.reducer.motor_inertia_kgm2, "kg m^2", "reducer.motor_inertia_kgm2"),
            Assumption("resonance", round(resonance_Hz, 1), "Hz", "of both masses on reducer.loop_stiffness_Nmprad"),
        )
    return settings, assumptions


def _two_masses(config: Config) -> dict[str, Any]:
    """Fields of `LoopSettings` for a joint whose reducer is not rigid."""
    reducer, margin, control = config.reducer, config.margin, config.control
    if reducer is None:
        return {}
    encoders = encoders_of_law(config)
    if control.kind != "flexible_joint" and encoders == Encoders.BOTH:
        encoders = Encoders.LINK  # the others read that alone
    error = margin.stiffness_error
    joints = [
        two_masses(config, reducer, payload, stiffness, held)
        for payload in sorted({1.0, *margin.payload_range})
        for stiffness in sorted({1.0 - error, 1.0, 1.0 + error})
        for held in (False, True)
        if not held or (config.friction is not None and config.friction.lugre is not None)
    ]
    return {
        "joints": tuple(joints),
        "largest_s": margin.max_sensitivity,
        "encoders": encoders,
        "motor_inertia_kgm2": reducer.motor_inertia_kgm2,
        "twist_radps": control.twist_radps,
        "link_cutoff_Hz": control.link_cutoff_Hz,
    }


def two_masses(config: Config, reducer: Reducer, payload: float, stiffness: float, held: bool) -> TwoMasses:
    """The joint with these factors on link inertia and stiffness, at rest (`held` by friction) or free of friction."""
    share, lugre = reducer.link_friction_share, config.friction.lugre if config.friction is not None else None
    bristles = damping = (0.0, 0.0)
    if held and lugre is not None:
        bristles = (1.0 - share) * lugre.stiffness_Nmprad, share * lugre.stiffness_Nmprad
        damping = (1.0 - share) * lugre.damping_Nmspr, share * lugre.damping_Nmspr
    words = [f"link inertia x {payload:g}"] if payload != 1.0 else []
    words += [f"stiffness x {stiffness:g}"] if stiffness != 1.0 else []
    words += ["held by friction" if held else "without friction"]
    return TwoMasses(
        reducer.motor_inertia_kgm2,
        payload * (config.joint.inertia_kgm2 - reducer.motor_inertia_kgm2),
        stiffness * (reducer.loop_stiffness_Nmprad or reducer.stiffness_Nmprad),
        reducer.damping_Nmspr,
        bristles,
        damping,
        ", ".join(words),
    )

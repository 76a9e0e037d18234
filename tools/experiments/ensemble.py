"""Random realistic joints: what a controller that was tuned on one joint meets on the next one.

Each plant is drawn from its own seed, so that plant k of a study is the same whatever else is in it.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator
from pydantic_core import PydanticCustomError

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.sections import Section, between

RPDO_AT_ONCE = 255  # the plant's own delay is then the whole delay from command to torque


def _interval(low: float, high: float) -> Any:
    """Two numbers in ascending order, each in [low..high]."""

    def check(value: tuple[float, float]) -> tuple[float, float]:
        if not low <= value[0] <= value[1] <= high:
            raise PydanticCustomError(
                "interval",
                "must be two numbers in ascending order in {range}",
                {"range": f"[{low:g}..{high:g}]"},
            )
        return value

    return AfterValidator(check)


def _as_tuple(value: Any) -> Any:
    """A list of TOML as the tuple that a frozen model holds."""
    return tuple(value) if isinstance(value, list) else value


_FromList = BeforeValidator(_as_tuple)
Interval = tuple[float, float]


class EnsembleSettings(Section):
    """Ranges of the plants; (low, high) are uniform unless the comment says otherwise."""

    friction_scale: Annotated[Interval, _FromList, _interval(0.0, 10.0)] = (0.9, 1.1)  # per direction
    stick_slip_share: Annotated[float, between(0.0, 1.0)] = 0.25  # the others have LuGre friction
    bristle_stiffness_Nmprad: Annotated[Interval, _FromList, _interval(1.0, 1e7)] = (3e4, 2.5e5)  # log-uniform
    bristle_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 200.0
    encoder_bits: Annotated[tuple[int, int], _FromList, _interval(8, 26)] = (17, 20)
    current_lag_s: Annotated[Interval, _FromList, _interval(0.0, 0.1)] = (0.3e-3, 1.0e-3)
    command_delay_s: Annotated[Interval, _FromList, _interval(0.0, 0.01)] = (0.5e-3, 2.0e-3)
    # 2 per motor turn; a third of it 10 per motor turn
    torque_ripple_Nm: Annotated[Interval, _FromList, _interval(0.0, 1e4)] = (0.0, 1.5)
    friction_ripple: Annotated[Interval, _FromList, _interval(0.0, 0.9)] = (0.0, 0.05)  # 18 per joint turn
    inertia_scale: Annotated[Interval, _FromList, _interval(0.1, 10.0)] = (0.95, 1.05)


def random_plant(base: Config, settings: EnsembleSettings, seed: int, index: int) -> Config:
    """The configuration with the virtual joint number `index` of the study with this seed."""
    random = np.random.default_rng([seed, index])

    def uniform(interval: tuple[float, float]) -> float:
        return float(random.uniform(*interval))

    low, high = settings.bristle_stiffness_Nmprad
    ripple = uniform(settings.torque_ripple_Nm)
    virtual: dict[str, Any] = {
        "friction_positive_scale": uniform(settings.friction_scale),
        "friction_negative_scale": uniform(settings.friction_scale),
        "friction_kind": "stick_slip" if random.random() < settings.stick_slip_share else "lugre",
        "bristle_stiffness_Nmprad": float(np.exp(random.uniform(np.log(low), np.log(high)))),
        "bristle_damping_Nmspr": settings.bristle_damping_Nmspr,
        "current_lag_s": uniform(settings.current_lag_s),
        "command_delay_s": uniform(settings.command_delay_s),
        "torque_ripple_Nm": (ripple, ripple / 3.0),
        "torque_ripple_per_motor_turn": (2.0, 10.0),
        "torque_ripple_phase_rad": tuple(float(x) for x in random.uniform(0.0, 2.0 * np.pi, 2)),
        "friction_ripple": uniform(settings.friction_ripple),
        "friction_ripple_per_joint_turn": 18.0,
        "inertia_scale": uniform(settings.inertia_scale),
        "initial_position_rad": 0.0,
    }
    bits = int(random.integers(settings.encoder_bits[0], settings.encoder_bits[1] + 1))
    assert base.virtual is not None
    return base.model_copy(
        update={
            "virtual": base.virtual.model_copy(update=virtual),
            "encoder": base.encoder.model_copy(update={"counts_per_turn": 2**bits, "side": "joint"}),
            "drive": base.drive.model_copy(update={"rpdo_transmission_type": RPDO_AT_ONCE}),
        }
    )

"""Random realistic joints: what a controller that was tuned on one joint meets on the next one.

Each plant is drawn from its own seed, so that plant k of a study is the same whatever else is in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tools.config import Config

RPDO_AT_ONCE = 255  # the plant's own delay is then the whole delay from command to torque


@dataclass(frozen=True)
class EnsembleSettings:
    """Ranges of the plants; (low, high) are uniform unless the comment says otherwise."""

    friction_scale: tuple[float, float] = (0.9, 1.1)  # per direction
    stick_slip_share: float = 0.25  # the others have LuGre friction
    bristle_stiffness_Nmprad: tuple[float, float] = (3e4, 2.5e5)  # log-uniform
    bristle_damping_Nmspr: float = 200.0
    encoder_bits: tuple[int, int] = (17, 20)
    current_lag_s: tuple[float, float] = (0.3e-3, 1.0e-3)
    command_delay_s: tuple[float, float] = (0.5e-3, 2.0e-3)
    torque_ripple_Nm: tuple[float, float] = (0.0, 1.5)  # 2 per motor turn; a third of it 10 per motor turn
    friction_ripple: tuple[float, float] = (0.0, 0.05)  # 18 per joint turn
    inertia_scale: tuple[float, float] = (0.95, 1.05)


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

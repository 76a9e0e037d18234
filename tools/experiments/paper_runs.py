"""The experiments of the paper on the virtual joint, each one run in lockstep.

Two joints stand in for the paper's platform.  IDEAL has the friction of Table 3 and nothing else: true velocity, no
delay, no lag, no ripple.  R1 is realistic (configs/paper.toml): LuGre friction 10 % above the model, 19-bit encoder,
100 Hz velocity filter, 0.5 ms current lag, one period of delay, torque and friction ripple.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.drivers.errors import MotionFault
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.experiments.controllers import Controller, changed, controller_constants, from_file, paper_control
from jointctl.tools.experiments.ensemble import RPDO_AT_ONCE
from jointctl.tools.experiments.scenarios import Scenario, run_scenario
from jointctl.tools.simulation.lockstep import LockstepJoint, LockstepRun

AFTER_s = 75.0  # the paper looks at the errors from here on
Q_SIMULATION = 2500.0
_ONE_INTEGRATOR_WIDTH = 1e4  # every h is 1 to within 1e-10: the network is exactly one integrator


@dataclass(frozen=True)
class Experiment:
    """One run: which joint, which law, what happens during it."""

    key: str
    plant: Config
    controller: Controller
    scenario: Scenario = "sine"
    ideal_velocity: bool = False

    def run(self) -> LockstepRun:
        """The run with every cycle in its log; `MotionFault` if a limit ended it."""
        joint = LockstepJoint(self.plant)
        constants = controller_constants(self.plant, self.controller, joint.report.start_position_rad)
        run = run_scenario(joint, constants, self.scenario, ideal_velocity=self.ideal_velocity)
        if run.fault is not Fault.NONE:
            raise MotionFault(f"experiment {self.key}: ended by {run.fault.name} (={float(run.state.fault_value):g})")
        return run


def r1() -> Config:
    """The realistic joint, starting on the trajectory at rest as the paper's plots do."""
    return _at_once(load_config(shipped_config("paper")))


def ideal(friction_kind: str, positive: float = 1.0, negative: float = 1.0) -> Config:
    """Table 3 times a factor for each direction, a perfect drive, and no delay beyond the sampling."""
    config = r1()
    assert config.virtual is not None
    virtual: dict[str, Any] = {
        "friction_kind": friction_kind,
        "friction_positive_scale": positive,
        "friction_negative_scale": negative,
        "friction_ripple": 0.0,
        "torque_ripple_Nm": (),
        "torque_ripple_per_motor_turn": (),
        "torque_ripple_phase_rad": (),
        "current_lag_s": 0.0,
        "command_delay_s": 0.0,
    }
    return config.model_copy(
        update={
            "virtual": config.virtual.model_copy(update=virtual),
            "drive": config.drive.model_copy(update={"rpdo_transmission_type": RPDO_AT_ONCE}),
        }
    )


def _at_once(config: Config) -> Config:
    """Without an approach: the run begins with the velocity error that a joint at rest has on a sine."""
    return config.model_copy(update={"sequence": config.sequence.model_copy(update={"approach_s": 0.0})})


def law(name: str, **changes: Any) -> Controller:
    """The paper's law with some keys of [control] changed."""
    return Controller(name, changed(paper_control(), changes, name))


def experiments() -> list[Experiment]:
    """All of them, in the order of the paper."""
    with_model = law("with friction model")
    without_model = law("without friction model", feed_forward="none")
    simulated = law("simulation", q=Q_SIMULATION)
    desired = law("desired velocity", feed_forward="desired", zero_rule="zero")
    one_integrator = law("one integrator", feed_forward="desired", zero_rule="zero", widths=_ONE_INTEGRATOR_WIDTH)
    precise = from_file("precise")
    joint = r1()
    return [
        Experiment("4.2 more friction", ideal("sign", 1.1, 1.1), simulated, ideal_velocity=True),
        Experiment("4.2 less friction", ideal("sign", 0.9, 0.9), simulated, ideal_velocity=True),
        Experiment("exact model", ideal("stick_slip"), desired, ideal_velocity=True),
        Experiment("no model, ideal", ideal("stick_slip"), without_model, ideal_velocity=True),
        Experiment("no model, R1", joint, without_model),
        Experiment("model, R1", joint, with_model),
        Experiment("frequency, R1", joint, with_model, "frequency"),
        Experiment("amplitude, R1", joint, with_model, "amplitude"),
        Experiment("load, R1", joint, with_model, "load"),
        Experiment("network, R1", joint, desired),
        Experiment("one integrator, R1", joint, one_integrator),
        Experiment("precise, R1", joint, precise),
        Experiment("precise, frequency, R1", joint, precise, "frequency"),
        Experiment("precise, amplitude, R1", joint, precise, "amplitude"),
        Experiment("precise, load, R1", joint, precise, "load"),
    ]


@dataclass(frozen=True)
class FrictionEstimate:
    """The network's output beside what it stands for: f = model friction - true friction, at the joint [Nm]."""

    time_s: np.ndarray
    true_Nm: np.ndarray
    estimate_Nm: np.ndarray
    correlation: float  # after `AFTER_s`
    residual: float  # rms(f - fhat) / rms(f) after `AFTER_s`


def friction_estimate(run: LockstepRun, positive_scale: float, negative_scale: float) -> FrictionEstimate:
    """f and fhat over a run with an ideal velocity and feed-forward on it; the scales are those of the true friction.

    Both frictions are taken at the same velocity: at a reversal true and sampled velocity may differ in sign for one
    sample, which is no error of the model.
    """
    log = run.log[run.tracking]
    scale = np.where(log.friction_torque_Nm > 0.0, positive_scale, negative_scale)
    true_Nm = (1.0 - scale) * log.friction_torque_Nm
    late = log.trajectory_s >= AFTER_s
    error = (true_Nm - log.network_torque_Nm)[late]
    return FrictionEstimate(
        time_s=log.trajectory_s,
        true_Nm=true_Nm,
        estimate_Nm=log.network_torque_Nm,
        correlation=float(np.corrcoef(true_Nm[late], log.network_torque_Nm[late])[0, 1]),
        residual=float(np.sqrt(np.mean(error**2) / np.mean(true_Nm[late] ** 2))),
    )


def hidden_outputs(run: LockstepRun, plant: Config, controller: Controller) -> np.ndarray:
    """h_i(x) along the run, shape (N, 15), from the logged errors: the log does not keep them."""
    network = controller_constants(plant, controller, 0.0)[0].law.network
    log = run.log[run.tracking]
    x = np.stack([log.error_rad, log.error_rate_radps], axis=1)
    distance = np.sum((x[:, None, :] - np.asarray(network.centres)[None]) ** 2, axis=2)
    return np.asarray(np.exp(-distance * np.asarray(network.inverse_width)))

"""What an arm's model buys: random simulated arms of three joints under the gains of `precise`, without learning.

    python -m tests.bench.arm_study [arms] [seed] [picture.png or -] [part]...

Each arm is the shipped one with joints drawn as `jointctl study` draws them (friction +-10 % a direction, ripples, lag,
delay, encoder), masses and inertias of every link +-10 %, and torque ripple up to 1 % of the joint's torque.  The
controller believes the shipped figures.  The joints move in sines whose periods never repeat together, at three speeds;
the fastest is near the joints' limits.  The same arm runs with independent joints, with gravity alone, and with the
whole model; then all of it again with friction that the controller knows, which leaves what the arm itself does, with
an observer that is not paired and a lead that is the same for all joints, without observer and adaptation, computed
torque alone, and with soft reducers of size 25, 20 and 17, two encoders a joint and their law, whose gains are chosen
for all poses.  Of the parts all are run, or those that are named.
Errors are the true ones (joint angle minus desired angle) after the first 10 s.  All of it is simulated.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from jointctl.firmware_py.arm_model import ArmFeedForward
from jointctl.tools.analysis.arm_check import joint_loop, pose_ranges
from jointctl.tools.analysis.gains import gains_of_file
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.sections import Sine
from jointctl.tools.drawing import BLUE, GREEN, ORANGE, canvas, save_png
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant
from jointctl.tools.lockstep import LockstepArm, LockstepRun

DURATION_s = 25.0
SETTLED_s = 10.0
BASE_Hz = 0.2
RATIOS = (1.0, (1.0 + 5.0**0.5) / 2.0, 5.0**0.5)
AMPLITUDES_rad = (1.0, 0.7, 0.6)
OFFSETS_rad = (-0.2, 0.8, 0.0)
SPEEDS = (0.5, 1.2, 2.2)  # factors on these frequencies
SOFT_SPEEDS = (0.5, 1.2, 1.8)  # kinematic errors take the joints beyond their limits where the fastest is near them
SIZES = (25, 20, 17)  # of the flexible reducers
PAPER_BRISTLE_Nmprad, PAPER_DAMPING_Nmspr = 8e4, 200.0  # of the joint that `jointctl study` draws from
KINDS = {
    "independent joints": ArmFeedForward.NONE, "gravity only": ArmFeedForward.GRAVITY,
    "whole model": ArmFeedForward.WHOLE,
}  # fmt: skip
PARTS: dict[str, dict[str, bool]] = {
    "friction as in study": {}, "friction as believed": {"known": True}, "observer not paired": {"paired": False},
    "without observer": {"observer": False},
    "flexible joints": {"flexible": True},
}  # fmt: skip


def random_arm(
    arm: ArmConfig, seed: int, index: int, *, known: bool = False, observer: bool = True,
    paired: bool = True, flexible: bool = False,
) -> ArmConfig:  # fmt: skip
    """Arm number `index` of the study with this seed.

    `known`: its friction is the believed one, without ripples.  Without `observer` the law is computed torque alone.
    Not `paired`: nor is the observer, and the feed-forward leads by 1.5 ms whatever a joint's delay and lag are.
    `flexible`: the reducers are soft, and their stiffness is known to 15 %.
    """
    joints: list[Config] = []
    for number, config in enumerate(arm.joints):
        size = config.friction.lugre.stiffness_Nmprad / PAPER_BRISTLE_Nmprad  # of its friction beside the paper's joint
        low, high = EnsembleSettings().bristle_stiffness_Nmprad
        ensemble = EnsembleSettings(
            stick_slip_share=0.0, inertia_scale=(0.9, 1.1), torque_ripple_Nm=(0.0, 0.01 * config.limits.torque_max_Nm),
            bristle_stiffness_Nmprad=(size * low, size * high), bristle_damping_Nmspr=size * PAPER_DAMPING_Nmspr,
        )  # fmt: skip
        if known:
            exact = {"friction_scale": (1.0, 1.0), "friction_ripple": (0.0, 0.0), "torque_ripple_Nm": (0.0, 0.0)}
            ensemble = ensemble.model_copy(update=exact)
        if not observer:
            alone = {"kind": "computed_torque", "observer_radps": 0.0, "observer_paired": False, "adaptation": None}
            config = config.changed(control=alone)
        if not paired:
            config = config.changed(control__observer_paired=False, control__feed_forward_lead_s=0.0015)
        if flexible:
            drawn = with_reducer(arm, number, ensemble, seed, index)
        else:
            drawn = random_plant(config, ensemble, seed, 100 * index + number)
        assert drawn.virtual is not None
        crest = {"initial_position_rad": AMPLITUDES_rad[number] + OFFSETS_rad[number]}  # where the motion begins
        joints.append(drawn.changed(virtual=crest))
    return replace(arm, joints=tuple(joints))


def with_reducer(arm: ArmConfig, number: int, ensemble: EnsembleSettings, seed: int, index: int) -> Config:
    """A joint of the arm with a soft reducer, and the gains that are chosen for what is believed of it in all poses."""
    base, motor_kgm2 = arm.joints[number], float(arm.model.links[number].motor_inertia_kgm2)
    adaptation = base.control.adaptation
    control = load_config(shipped_config("realistic")).control.model_copy(update={"adaptation": adaptation})
    ratio, size = base.joint.inertia_kgm2 / motor_kgm2 - 1.0, SIZES[number]
    soft = {"flexible": True, "inertia_ratio": (ratio, ratio), "flexible_inertia_scale": (1.0, 1.0)}
    ensemble = ensemble.model_copy(update=soft | {"reducer_sizes": (size,)})
    drawn = random_plant(base.changed(control=control), ensemble, seed, 100 * index + number)
    assert drawn.reducer is not None
    assert drawn.virtual is not None
    # the arm's model says what the controller believes of the inertias
    scale = float(np.random.default_rng([seed, index, number]).uniform(*ensemble.inertia_scale))
    true = {"motor_side_inertia_kgm2": motor_kgm2 * scale, "inertia_scale": scale}
    believed = drawn.changed(joint=base.joint, reducer__motor_inertia_kgm2=motor_kgm2, virtual=true)
    poses = joint_loop(arm.names[number], believed, pose_ranges(arm)[number])
    gains = gains_of_file(poses.config, poses.settings)
    return believed.changed(control=control.model_copy(update=gains.changes()))


def moving(arm: ArmConfig, speed: float) -> ArmConfig:
    """The arm with the motion of the study at this speed; each sine begins at a crest, without speed."""
    joints = []
    for config, ratio, amplitude, offset in zip(arm.joints, RATIOS, AMPLITUDES_rad, OFFSETS_rad, strict=True):
        frequency_Hz = BASE_Hz * ratio * speed
        sine = Sine(
            kind="sine", duration_s=DURATION_s, amplitude_rad=amplitude, frequency_Hz=frequency_Hz,
            shift_s=0.25 / frequency_Hz, offset_rad=offset,
        )  # fmt: skip
        # it stands there, and must gain acceleration
        joints.append(config.changed(trajectory=sine, sequence__approach_s=0.5))
    return replace(arm, joints=tuple(joints))


def run(arm: LockstepArm, kind: ArmFeedForward, speed: float) -> list[LockstepRun]:
    arm.arm = moving(arm.arm, speed)
    constants = arm.constants()
    constants.law.of_arm[:] = kind != ArmFeedForward.NONE
    model = arm.arm.model.memory()
    model.constants[0].feed_forward = kind
    return arm.run(constants, model=model)


def settled(one: LockstepRun) -> np.ndarray:
    return one.tracking & (one.log.trajectory_s > SETTLED_s)


def rmse_mrad(runs: list[LockstepRun]) -> list[float]:
    """Of each joint; infinite if a run ended in a fault."""
    if any(one.fault for one in runs):
        print([(one.fault.name, float(one.state.fault_value)) for one in runs], file=sys.stderr)
        return [float("inf")] * len(runs)
    return [1e3 * float(np.sqrt(np.mean(one.true_error_rad[settled(one)] ** 2))) for one in runs]


def speeds_of(how: dict[str, bool]) -> tuple[float, ...]:
    return SOFT_SPEEDS if how.get("flexible") else SPEEDS


def study(arms: int, seed: int, how: dict[str, bool]) -> np.ndarray:
    """RMSE [mrad], array (speeds, kinds, arms, joints)."""
    shipped, speeds = load_arm(SHIPPED_ARM), speeds_of(how)
    found = np.zeros((len(speeds), len(KINDS), arms, len(shipped.joints)))
    for index in range(arms):
        arm = LockstepArm(random_arm(shipped, seed, index, **how))
        for i, speed in enumerate(speeds):
            for k, kind in enumerate(KINDS.values()):
                found[i, k, index] = rmse_mrad(run(arm, kind, speed))
    return found


def table(found: np.ndarray, names: tuple[str, ...], speeds: tuple[float, ...]) -> list[str]:
    """Lines of a table for docs/arm.md: median and 95 % of the arms, and what the whole model gains."""
    lines = [
        "| speed | joint | independent joints | gravity only | whole model | independent / whole |",
        "|---|---|---|---|---|---|",
    ]
    for i, speed in enumerate(speeds):
        for joint, name in enumerate(names):
            cells = [
                f"{np.median(one):.3f} ({np.percentile(one, 95):.3f})"
                for one in (found[i, k, :, joint] for k in range(3))
            ]
            gain = np.median(found[i, 0, :, joint] / found[i, 2, :, joint])
            lines.append(f"| {speed:g} | {name} | {' | '.join(cells)} | {gain:.1f} |")
    return lines


def picture(path: Path) -> None:
    """Errors of one of the study's arms at the highest speed, five seconds of them."""
    arm = LockstepArm(random_arm(load_arm(SHIPPED_ARM), 1, 0))
    with canvas(6.0) as figure:
        axes = figure.subplots(3, 1, sharex=True)
        for (label, kind), colour in zip(KINDS.items(), (ORANGE, BLUE, GREEN), strict=True):
            for axis, one, name in zip(axes, run(arm, kind, SPEEDS[-1]), arm.arm.names, strict=True):
                shown = settled(one) & (one.log.trajectory_s < SETTLED_s + 5.0)
                axis.plot(
                    one.log.trajectory_s[shown], 1e3 * one.true_error_rad[shown], color=colour, linewidth=0.9,
                    label=label,
                )  # fmt: skip
                axis.set_ylabel(f"{name} [mrad]")
        axes[0].legend(loc="upper right", ncols=3)
        axes[-1].set_xlabel("time [s]")
        save_png(figure, path)


if __name__ == "__main__":
    count, chosen = (int(text) for text in (sys.argv[1:3] + ["20", "1"][len(sys.argv[1:3]) :]))
    for heading, how in PARTS.items():
        if heading not in (sys.argv[4:] or PARTS):
            continue
        print(f"\n{heading}, {count} arms, seed {chosen}\n")
        found = study(count, chosen, how)
        print("\n".join(table(found, load_arm(SHIPPED_ARM).names, speeds_of(how))), flush=True)
    if len(sys.argv) > 3 and sys.argv[3] != "-":
        picture(Path(sys.argv[3]))

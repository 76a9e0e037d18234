"""The files of an arm of one's own, from its URDF: an arm file, a configuration a joint, a copy of the URDF.

The URDF gives names, order, limits, and with the motors' inertias what each loop has to move in whatever pose.  It says
nothing about drives, encoders and friction: there each joint gets the shipped shoulder's, with all torques in
proportion to its effort, on a virtual bus.  So `check`, `hil` and `run` work at once, and what is real comes in its
place, value by value.  Rate and gains are those that the buses carry and the margins over the poses allow.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.analysis.arm_check import BusBudget, JointOfArm, RATES_Hz, bus_budgets, joint_loop, pose_ranges
from jointctl.tools.configuration.arm import LARGEST_ARM, SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.configuration.config import Config, raise_if
from jointctl.tools.configuration.urdf import Urdf, UrdfJoint, bodies_of, read_urdf
from jointctl.tools.inspection.first_values import Place, filled, toml_text
from jointctl.tools.written_file import file_stems

TEMPLATE = SHIPPED_ARM.parent / "shoulder.toml"
ARM_FILE = "arm.toml"
# of the template, all of which go with the torque that the joint has
_TORQUES = (
    "rated_current_A|rated_torque_Nm|torque_rate_max_Nmps|ripple_Nm|tc_Nm|ts_Nm|tv|a0|a1|a2|a3|stiffness_Nmprad|"
    "damping_Nmspr|torque_ripple_Nm|current_limit_A|bristle_stiffness_Nmprad|bristle_damping_Nmspr"
)
_MOTOR_INERTIA_kgm2 = 1.2  # of the shipped arm's shoulder
_TURN_rad = 3.1  # to each side, of a joint that may turn on for ever
# natural frequency of the loop [rad/s] and disturbance observer [rad/s], the stiffest first
_GAINS = ((60.0, 60.0), (45.0, 40.0), (30.0, 20.0), (20.0, 15.0), (12.0, 8.0), (8.0, 5.0))
_MARGIN_TO_SPARE_deg = 2.0  # a run measures the loop delay, which check takes as configured
_JUMP_SHARE = 1.5  # of the way in a period at the greatest speed that is a jump
_SPEED_SHARE, _LARGEST_SWING_rad, _FIRST_Hz = 0.2, 0.3, 0.1  # of the motion to begin with


@dataclass(frozen=True)
class JointAnswers:
    """What the URDF does not say of a joint and cannot be left open; `values` are keys of its file."""

    motor_inertia_kgm2: float  # motor and reducer, at the joint
    values: Mapping[Place, object]


def moving_joints(urdf: Urdf, names: Sequence[str] = ()) -> tuple[UrdfJoint, ...]:
    """Those that get a drive: `names`, or all that turn by themselves; `ConfigurationError` where they make no arm."""
    turning = [joint for joint in urdf.moving if joint.kind != "prismatic"]
    known = ", ".join(joint.name for joint in turning) or "none"
    wrong = [
        f"--joints: {name} must be a joint of {urdf.path.name} that turns by itself: {known}"
        for name in names
        if name not in [joint.name for joint in turning]
    ]
    if len(set(names)) < len(names):
        wrong.append(f"--joints (={','.join(names)}) must not name a joint twice")
    raise_if(wrong)
    joints = tuple(joint for joint in turning if not names or joint.name in names)
    if not 1 <= len(joints) <= LARGEST_ARM:
        more = "name those of one arm with --joints" if joints else "joints that shift are left out"
        raise ConfigurationError(f"{urdf.path}: {len(joints)} joints turn, must be 1 to {LARGEST_ARM}; {more}")
    bodies_of(urdf, tuple(joint.name for joint in joints), lambda text: wrong.append(f"{urdf.path}: {text}"))
    for joint in joints:
        wrong += [f"{urdf.path}: joint {joint.name}: {text}" for text in _unknown_limits(joint)]
    raise_if(wrong)
    return joints


def _unknown_limits(joint: UrdfJoint) -> list[str]:
    given = {"velocity": joint.velocity_max_radps, "effort": joint.effort_max_Nm}
    ends = {"lower": joint.lower_rad, "upper": joint.upper_rad} if joint.kind == "revolute" else {}
    missing = [key for key, value in {**ends, **given}.items() if value is None]
    found = [f"<limit> must have {', '.join(missing)}"] if missing else []
    return found + [
        f"limit {key} (={value:g}) must be above 0; not known?"
        for key, value in given.items()
        if value is not None and not value > 0.0
    ]


def file_names(joints: Sequence[UrdfJoint]) -> list[str]:
    """Of the joints' configurations."""
    return [f"{stem}.toml" for stem in file_stems([joint.name for joint in joints], taken=("arm",))]


def default_motor_inertia_kgm2(joint: UrdfJoint) -> float:
    """That of the shipped shoulder's drive with this joint's torque: a guess."""
    return float(f"{_MOTOR_INERTIA_kgm2 * _scale(joint):.3g}")


def _scale(joint: UrdfJoint) -> float:
    assert joint.effort_max_Nm is not None
    return joint.effort_max_Nm / _template_value("torque_max_Nm")


def _template_value(key: str) -> float:
    found = re.search(rf"(?m)^{key} = (\S+)", TEMPLATE.read_text(encoding="utf-8"))
    assert found is not None, key
    return float(found[1])


def _limits(joint: UrdfJoint) -> tuple[float, float]:
    if joint.lower_rad is None or joint.upper_rad is None:
        return -_TURN_rad, _TURN_rad
    return joint.lower_rad, joint.upper_rad


def _scaled(text: str, factor: float) -> str:
    """The template with its torques in proportion, and no comments that were about its own figures."""

    def times(match: re.Match[str]) -> str:
        value = tomllib.loads(f"x = {match[2]}")["x"]
        values = [float(f"{factor * one:.5g}") for one in (value if isinstance(value, list) else [value])]
        return f"{match[1]}{values if isinstance(value, list) else values[0]}{match[3] or ''}"

    text = re.sub(rf"(?m)^((?:{_TORQUES}) = )(\[[^\]]*\]|[^\s#]+)(.*)$", times, text)
    text = re.sub(r"(?m)^(max_torque_permille = \S+ *#)[^\n]*", r"\1 6072, the drive's own limit", text)
    return re.sub(r"(?m)^\[friction\].*$", "[friction]                        # a guess: the paper's, scaled", text)


@dataclass(frozen=True)
class _Draft:
    """Of all files, what they hold in the end."""

    urdf: Urdf
    joints: tuple[UrdfJoint, ...]
    answers: tuple[JointAnswers, ...]
    rate_Hz: float = 1000.0
    inertias_kgm2: tuple[float, ...] = ()
    gains: tuple[tuple[float, float], ...] = ()

    def text_of(self, i: int) -> str:
        joint, (low, high) = self.joints[i], _limits(self.joints[i])
        text = _scaled(TEMPLATE.read_text(encoding="utf-8"), _scale(joint))
        name = " ".join(joint.name.split())
        head = (
            f"# Joint {name} of {ARM_FILE}, made from {self.urdf.path.name}; works alone as well.\n"
            "# Limits are the URDF's; drive, encoder and friction are those of the shipped arm's shoulder, scaled to\n"
            "# the effort: put those of your joint in their place, then the interface of your bus.\n"
        )
        text = head + re.sub(r"\A#.*\n", "", text)
        swing_rad, frequency_Hz, middle_rad = self.swing(i)
        gains = _gain_keys(self.gains[i] if self.gains else _GAINS[-1])
        values: dict[Place, object] = {
            ("drive", "node"): i + 1,
            ("limits", "position_min_rad"): low,
            ("limits", "position_max_rad"): high,
            ("limits", "velocity_max_radps"): joint.velocity_max_radps,
            ("limits", "torque_max_Nm"): joint.effort_max_Nm,
            ("limits", "position_jump_max_rad"): self.jump_rad(joint),
            ("joint", "inertia_kgm2"): self.inertias_kgm2[i] if self.inertias_kgm2 else 1.0,
            ("loop", "rate_Hz"): self.rate_Hz,
            **{("control", key): value for key, value in gains.items()},
            ("control", "feed_forward_lead_s"): "auto",
            ("control", "velocity_cutoff_Hz"): 0.2 * self.rate_Hz,
            ("trajectory", "amplitude_rad"): swing_rad,
            ("trajectory", "frequency_Hz"): frequency_Hz,
            ("trajectory", "offset_rad"): middle_rad,
            ("virtual", "initial_position_rad"): middle_rad,
            **self.answers[i].values,
        }
        text = filled(text, values)
        return re.sub(r"(?m)^((?:position_min_rad|torque_max_Nm|kp|kv|feed_forward_lead_s) = \S+) .*$", r"\1", text)

    def swing(self, i: int) -> tuple[float, float, float]:
        """Amplitude, frequency and middle of the first motion, near 0 as far as the limits allow."""
        joint, (low, high) = self.joints[i], _limits(self.joints[i])
        assert joint.velocity_max_radps is not None
        frequency_Hz = round(_FIRST_Hz * (1.0 + 0.13 * i), 4)
        fastest = _SPEED_SHARE * joint.velocity_max_radps / (math.tau * frequency_Hz)
        amplitude = min(_LARGEST_SWING_rad, 0.2 * (high - low), fastest)
        middle = min(max(0.0, low + 1.5 * amplitude), high - 1.5 * amplitude)
        return float(f"{amplitude:.3g}"), frequency_Hz, round(middle, 4)

    def jump_rad(self, joint: UrdfJoint) -> float:
        """Between two samples at this rate: the template's, or more where the joint moves on by more."""
        assert joint.velocity_max_radps is not None
        way_rad = _JUMP_SHARE * joint.velocity_max_radps / self.rate_Hz
        return max(_template_value("position_jump_max_rad"), float(f"{way_rad:.3g}"))

    def arm_text(self) -> str:
        files = file_names(self.joints)
        swings = [self.swing(i) for i in range(len(self.joints))]
        names = ", ".join(toml_text(joint.name) for joint in self.joints)
        return (
            f"# The arm of {self.urdf.path.name}.  `jointctl check` says how much of the bus it needs and what\n"
            "# margins its poses leave.\n\n[arm]\n"
            f"urdf = {toml_text(self.urdf.path.name)}  # beside this file; masses, inertias, axes, limits\n"
            f"joints = [{', '.join(map(toml_text, files))}]  # beside this file\n"
            f"joint_names = [{names}]  # of the URDF\n"
            "gravity_mps2 = [0.0, 0.0, -9.81]  # in the frame of the URDF's base\n"
            'feed_forward = "whole"  # of the arm\'s model: whole, gravity, none\n'
            f"motor_inertia_kgm2 = {[one.motor_inertia_kgm2 for one in self.answers]}  # and reducer, at the joint\n"
            "payload_kg = 0.0\npayload_at_m = [0.0, 0.0, 0.0]  # in the frame of the last joint's link\n\n"
            '[motion]\nkind = "sine"\nduration_s = 20.0\n'
            f"amplitude_rad = {[one[0] for one in swings]}\n"
            f"frequency_Hz = {[one[1] for one in swings]}\n"
            f"offset_rad = {[one[2] for one in swings]}\n"
        )

    def files(self) -> dict[str, bytes]:
        found = {ARM_FILE: self.arm_text().encode(), self.urdf.path.name: self.urdf.path.read_bytes()}
        for i, name in enumerate(file_names(self.joints)):
            found[name] = self.text_of(i).encode()
        return found

    def loaded(self, folder: Path) -> ArmConfig:
        for name, content in self.files().items():
            (folder / name).write_bytes(content)
        return load_arm(folder / ARM_FILE)


def first_arm(
    urdf: Urdf, joints: tuple[UrdfJoint, ...], answers: tuple[JointAnswers, ...], folder: Path
) -> tuple[dict[str, bytes], list[str]]:
    """Name and content of each file of the folder to come, and remarks; `ConfigurationError` where they make no arm."""
    draft = _Draft(urdf, joints, answers)
    with TemporaryDirectory() as name:
        trial = Path(name)
        try:
            arm = draft.loaded(trial)
            rate_Hz = _rate(bus_budgets(arm))
            ranges = pose_ranges(arm)
            inertias = tuple(float(f"{math.sqrt(one.least_kgm2 * one.greatest_kgm2):.3g}") for one in ranges)
            draft = replace(draft, rate_Hz=rate_Hz, inertias_kgm2=inertias)
            arm = draft.loaded(trial)
            ranges = pose_ranges(arm)
            remarks: list[str] = []
            gains = []
            for i, config in enumerate(arm.joints):
                found = next((g for g in _GAINS if _bears(joint_loop(arm.names[i], _with(config, g), ranges[i]))), None)
                if found is None:
                    remarks.append(f"joint {arm.names[i]}: no gains were found for all poses; jointctl check says more")
                gains.append(found or _GAINS[-1])
            draft = replace(draft, gains=tuple(gains))
            remarks += draft.loaded(trial).remarks
        except ConfigurationError as error:
            error.message = error.message.replace(f"{trial}", f"{folder}")
            raise
    return draft.files(), remarks


def _rate(budgets: Sequence[BusBudget]) -> float:
    fits = min(min(budget.fitting_Hz for budget in budgets), 1000.0)
    if fits == 0.0:
        raise ConfigurationError(f"the joints do not fit on one bus at {RATES_Hz[-1]} Hz")
    return fits


def _gain_keys(gains: tuple[float, float]) -> dict[str, float]:
    """One of `_GAINS` as keys of [control]."""
    natural_radps, observer_radps = gains
    return {"kp": natural_radps**2, "kv": 2.0 * natural_radps, "observer_radps": observer_radps}


def _with(config: Config, gains: tuple[float, float]) -> Config:
    return config.model_copy(update={"control": config.control.model_copy(update=_gain_keys(gains))})


def _bears(loop: JointOfArm) -> bool:
    margins, wanted_deg = loop.margins, loop.config.margin.min_phase_margin_deg
    enough = margins.phase_margin_deg >= wanted_deg + _MARGIN_TO_SPARE_deg
    return margins.stable and margins.sensitivity_accepted and enough


def read_own_urdf(path: Path) -> Urdf:
    """The user's file; `ConfigurationError` with one line for each problem."""
    if path.name == ARM_FILE or path.suffix == ".toml":
        raise ConfigurationError(f"{path}: must be a URDF file, it will stand beside {ARM_FILE} under its own name")
    return read_urdf(path)

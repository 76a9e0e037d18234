"""One run of an experiment: what happens during it, how large the error was, and the controllers that are compared.

    sine       0.35 sin(0.2 pi t) throughout
    frequency  0.35 sin(0.125 pi (t + 1.5)) from 82.5 s on
    amplitude  0.175 sin(0.2 pi t) + 0.175 from 82.5 s on
    load       a load torque of 3 Nm at the joint from 80 s on
    multi_sine, point_to_point, reversals, creep: motions that never repeat, see `random_motion`

Both changes of the trajectory come at a crest: position and velocity go on, the acceleration jumps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from pydantic import ValidationError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.states import CommandKind, Fault, TrajectoryKind
from jointctl.firmware_py.trajectory import eased, quintic_s, spline_table
from jointctl.hil.lockstep import TRUE_POSITION_rad
from jointctl.tools.analysis.gains import gains_of_file
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.checks import problems_between_sections
from jointctl.tools.configuration.config import Config, Control
from jointctl.tools.configuration.drive_section import require_simulated
from jointctl.tools.configuration.load import load_config, shipped_config, shipped_control
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.configuration.sections import Friction
from jointctl.tools.lockstep import LockstepJoint, LockstepRun

# --- Motions that never repeat: no law can learn them from one repetition to the next ---
#
#     multi_sine      six sines of 0.1 to 1.4 Hz with random phases, scaled to the joint's range and speed
#     point_to_point  quintics between random places, 0.4 to 1 s of rest after each
#     reversals       a spline through random turning points, 0.08 to 0.4 s apart, that never rests
#     creep           0.001 rad/s, back and forth, turning every 5 to 15 s
#
# Each is drawn from a seed and the number of the plant, begins and ends at rest, and is a table of `reference_at`:
# position, velocity and acceleration are continuous.  No motion is faster than SPEED_radps and ACCELERATION_radps2, nor
# farther than REACH_rad from zero.

RandomMotion = Literal["multi_sine", "point_to_point", "reversals", "creep"]
RANDOM_MOTIONS: tuple[RandomMotion, ...] = get_args(RandomMotion)
REACH_rad = 0.35  # that of the sine, which the limits of the shipped configurations leave room for
SPEED_radps = 0.8
ACCELERATION_radps2 = 4.0
FREQUENCIES_Hz = (0.1, 1.4)  # of the multi-sine, log-uniform
TURNS_s = (0.08, 0.4)  # between two reversals
CREEP_radps = 0.001
_ROW_S = 0.005  # of motions that are sampled: the spline between is 1e-9 rad off
_ROWS_OF_MOVES = 5  # of each of these, where a quintic begins or ends: a spline rings there, below 1e-6 rad/s
_NO_RESTS = np.zeros((0, 2))
_EASE_S = 2.0  # in which a motion that does not begin at rest is faded in


@dataclass(frozen=True)
class Motion:
    """The table float64 (N, 5), and when it rests: begin and end [s], float64 (M, 2)."""

    kind: RandomMotion
    table: np.ndarray
    rests_s: np.ndarray


def _within_limits(table: np.ndarray) -> np.ndarray:
    """The same motion, smaller by as much as the limits ask for."""
    inside = np.linspace(0.0, 1.0, 9)[:, None] * np.diff(table[:, 0])
    _, c0, c1, c2, c3 = table[:-1].T
    reach = np.max(np.abs(c0 + inside * (c1 + inside * (c2 + inside * c3)))) / REACH_rad
    speed = np.max(np.abs(c1 + inside * (2.0 * c2 + inside * 3.0 * c3))) / SPEED_radps
    acceleration = np.max(np.abs(2.0 * c2 + inside * 6.0 * c3)) / ACCELERATION_radps2
    scaled = table.copy()
    scaled[:, 1:] /= max(reach, speed, acceleration)
    return scaled


def _multi_sine(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.linspace(0.0, duration_s, round(duration_s / _ROW_S) + 1)
    position = np.zeros_like(time_s)
    for _ in range(6):
        frequency_Hz = math.exp(random.uniform(*np.log(FREQUENCIES_Hz)))
        amplitude = random.uniform(0.3, 1.0) / frequency_Hz
        position += amplitude * np.sin(math.tau * (frequency_Hz * time_s + random.uniform()))
    position *= eased(time_s / _EASE_S) * eased((duration_s - time_s) / _EASE_S)
    return _within_limits(spline_table(time_s, position)), _NO_RESTS


def _reversals(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    times, places = [0.0], [0.0]
    side = 1.0
    while times[-1] < duration_s:
        times.append(times[-1] + random.uniform(*TURNS_s))
        places.append(side * random.uniform(0.02, 0.3) * (times[-1] - times[-2]))
        side = -side
    return _within_limits(spline_table(np.array(times), np.array(places))), _NO_RESTS


def _sampled(moves: list[tuple[float, float, float]], duration_s: float) -> np.ndarray:
    """A table of quintics (begin [s], end [s], distance [rad]), one after the other, from zero."""
    time_s = np.linspace(0.0, duration_s, _ROWS_OF_MOVES * round(duration_s / _ROW_S) + 1)
    position = np.zeros_like(time_s)
    for begin_s, end_s, distance_rad in moves:
        position += distance_rad * eased((time_s - begin_s) / (end_s - begin_s))
    return spline_table(time_s, position)


def _point_to_point(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    moves: list[tuple[float, float, float]] = []
    rests: list[tuple[float, float]] = []
    now_s, place = 0.5, 0.0
    while True:
        target = random.uniform(-REACH_rad, REACH_rad)
        size = abs(target - place)
        slowness = random.uniform(1.0, 3.0)
        move_s = slowness * quintic_s(size, SPEED_radps, ACCELERATION_radps2)
        rest_s = random.uniform(0.4, 1.0)
        # on rows, so that the spline has no corner between two
        end_s = round((now_s + move_s) / _ROW_S) * _ROW_S
        after_s = round((end_s + rest_s) / _ROW_S) * _ROW_S
        if after_s > duration_s:
            return _sampled(moves, duration_s), np.array(rests).reshape(-1, 2)
        moves.append((now_s, end_s, target - place))
        rests.append((end_s, after_s))
        now_s, place = after_s, target


def _creep(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.linspace(0.0, duration_s, round(duration_s / _ROW_S) + 1)
    speed = np.zeros_like(time_s)
    turn_s, side = 0.5, 1.0
    while turn_s < duration_s:
        speed += side * eased((time_s - turn_s) / 0.2) * (2.0 if turn_s > 0.5 else 1.0)
        turn_s, side = turn_s + random.uniform(5.0, 15.0), -side
    speed *= CREEP_radps * eased((duration_s - 0.5 - time_s) / 0.2)
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time_s))))
    return spline_table(time_s, position), _NO_RESTS


_DRAWN: dict[RandomMotion, Callable[[np.random.Generator, float], tuple[np.ndarray, np.ndarray]]] = {
    "multi_sine": _multi_sine,
    "point_to_point": _point_to_point,
    "reversals": _reversals,
    "creep": _creep,
}


def random_motion(kind: RandomMotion, seed: int, index: int, duration_s: float) -> Motion:
    """The motion of this kind for plant `index` of the study with this seed; at least `duration_s` long."""
    # a stream of its own: plants and motions do not depend on each other
    random = np.random.default_rng([seed, index, 1 + RANDOM_MOTIONS.index(kind)])
    return Motion(kind, *_DRAWN[kind](random, duration_s))


# --- what happens ---

Change = Literal["sine", "frequency", "amplitude", "load"]
Scenario = Literal[Change, RandomMotion]
RPDO_AT_ONCE = 255  # the plant's own delay is then the whole delay from command to torque
CHANGE_s = 82.5
LOAD_AT_s = 80.0
LOAD_Nm = 3.0
# amplitude [rad], angular frequency [rad/s], shift [s], offset [rad] after the change
_SECOND_SINE = {"frequency": (0.35, 0.125 * math.pi, 1.5, 0.0), "amplitude": (0.175, 0.2 * math.pi, 0.0, 0.175)}
_PROBE_s = 0.5  # of the trajectory, to learn when it begins on the plant's clock


def event_s(scenario: Scenario) -> float | None:
    """When the change comes, in trajectory time."""
    return {"frequency": CHANGE_s, "amplitude": CHANGE_s, "load": LOAD_AT_s}.get(scenario)


def run_scenario(
    joint: LockstepJoint,
    constants: np.recarray,
    scenario: Scenario = "sine",
    *,
    ideal_velocity: bool = False,
    motion: Motion | None = None,
) -> LockstepRun:
    """One run of these constants on this joint, up to the end of the trajectory; neither is changed.

    The controlled stop that follows is no part of an experiment.  `motion` takes the place of the trajectory.
    """
    constants = constants.copy()
    trajectory = constants[0].trajectory
    if motion is not None:
        trajectory.kind, trajectory.repeats, trajectory.table_rows = TrajectoryKind.TABLE, 0, len(motion.table)
    at_s = event_s(scenario)
    if at_s is not None and 0.0 < trajectory.duration_s <= at_s:
        raise ConfigurationError(
            f"trajectory.duration_s (={trajectory.duration_s:g}) must be more than {at_s:g} for the change {scenario}"
        )
    if scenario in _SECOND_SINE:
        trajectory.switch_s = at_s
        second = _SECOND_SINE[scenario]
        trajectory.amplitude2_rad, trajectory.omega2_radps, trajectory.shift2_s, trajectory.offset2_rad = second
    plant_constants = None
    if scenario == "load":
        plant_constants = joint.plant_constants.copy()
        plant = plant_constants[0]
        starts_s = _trajectory_start_s(joint, constants)
        plant.load_step_Nm = LOAD_Nm
        plant.load_step_substep = round((starts_s + LOAD_AT_s) / float(plant.step_s))
    longest_s = _before_s(constants) + float(trajectory.duration_s)
    return joint.run(
        constants, plant_constants=plant_constants, ideal_velocity=ideal_velocity, longest_s=longest_s,
        table=None if motion is None else motion.table,
    )  # fmt: skip


def _before_s(constants: np.recarray) -> float:
    """Time of settling and approach; enabling takes some cycles more."""
    sequence = constants[0].sequence
    return float(sequence.approach_s) + float(sequence.settle_cycles) * float(constants[0].law.period_s)


def _trajectory_start_s(joint: LockstepJoint, constants: np.recarray) -> float:
    """The plant's own time at trajectory time 0, from a short run that ends inside the trajectory."""
    probe = joint.run(constants, longest_s=_before_s(constants) + _PROBE_s)
    return float(probe.plant.time_s) - float(probe.log.trajectory_s[-1])


# --- how large the error was, and how long it took to become small ---

SETTLED_rad = 1e-3
_STILL_OUTSIDE = 0.9  # outside the band in the last tenth of the trajectory: not settled at all


@dataclass(frozen=True)
class ErrorFigures:
    """Errors from `after_s` of the trajectory on [mrad]; a run that was ended by a fault has infinite errors.

    `peak_mrad`, `rmse_mrad`, `lowest_mrad` and `highest_mrad` are of the measured error, encoder steps included, as a
    real joint would report them; `true_*` are of the joint itself, which only a simulation knows.
    """

    fault: str  # "" = none
    peak_mrad: float
    rmse_mrad: float
    lowest_mrad: float
    highest_mrad: float
    true_peak_mrad: float
    true_rmse_mrad: float
    settling_s: float  # until the measured error stays within 1 mrad; inf = it never does
    torque_peak_Nm: float  # of the command, after `after_s`
    chatter_Nm: float = math.inf  # mean change of the command from cycle to cycle
    # of a motion with rests: share of them in which the measured error is within one count or 20 urad from 50 ms on
    settled_share: float | None = None
    stuck_share: float | None = None  # of creep: share of the time in which the joint stands still
    stuck_later_share: float | None = None  # the same from `TURNED_S` after a turn on
    # of the loop that is believed, with the joint's true delay where that is known
    phase_margin_deg: float | None = None


FAILED = (math.inf, math.inf, -math.inf, math.inf, math.inf, math.inf, math.inf, math.inf)


def settling_s(time_s: np.ndarray, error_rad: np.ndarray) -> float:
    """Time after which |error| stays within SETTLED_rad; inf if it leaves it in the last tenth; arrays (N,)."""
    outside = np.flatnonzero(np.abs(error_rad) > SETTLED_rad)
    if not len(outside):
        return 0.0
    last_s = float(time_s[outside[-1]])
    return math.inf if last_s > _STILL_OUTSIDE * float(time_s[-1]) else last_s


REST_BAND_rad = 20e-6
REST_AFTER_S = 0.05
_STUCK_WINDOW_S = 0.05
_STUCK = 0.1  # of the distance that it should go
TURNED_S = 0.5  # after which static friction that let go at a turn, all at once, has been forgotten


def settled_share(time_s: np.ndarray, error_rad: np.ndarray, rests_s: np.ndarray, within_rad: float) -> float | None:
    """Share of the rests in which |error| stays within the band from `REST_AFTER_S` on; None without any.

    Arrays (N,), `rests_s` (M, 2).
    """
    settled = []
    for begin_s, end_s in rests_s:
        first, last = np.searchsorted(time_s, (begin_s + REST_AFTER_S, end_s))
        settled.append(bool(np.all(np.abs(error_rad[first:last]) <= within_rad)))
    return float(np.mean(settled)) if settled else None


def stuck_share(run: LockstepRun, after_s: float, turned_s: float = 0.0) -> float:
    """Share of a creeping motion, but for its turns, in which the joint goes less than a tenth of the way.

    Of what comes `turned_s` after a turn or later.
    """
    tracking = run.tracking
    log = run.log[tracking]
    position = run.truth[tracking, TRUE_POSITION_rad]
    window = round(_STUCK_WINDOW_S / float(log.trajectory_s[1] - log.trajectory_s[0]))
    time_s = log.trajectory_s[window:]
    way = log.desired_position_rad[window:] - log.desired_position_rad[:-window]
    turns_s = np.where(np.diff(np.sign(way), prepend=0.0) != 0.0, time_s, -math.inf)
    asked, moved = np.abs(way), np.abs(position[window:] - position[:-window])
    counts = (time_s >= after_s) & (asked > 0.99 * CREEP_radps * _STUCK_WINDOW_S)
    counts &= time_s - np.maximum.accumulate(turns_s) >= turned_s
    return float(np.mean(moved[counts] < _STUCK * asked[counts]))


def error_figures(
    run: LockstepRun, after_s: float, motion: Motion | None = None, count_rad: float = 0.0
) -> ErrorFigures:
    """The figures of a run whose log has every cycle; those of rests and of creep where the motion has them."""
    if run.fault is not Fault.NONE:
        return ErrorFigures(run.fault.name.lower(), *FAILED)
    tracking = run.tracking
    time_s = run.log.trajectory_s[tracking]
    error = run.log.error_rad[tracking]
    late = time_s >= after_s
    measured = error[late] * 1e3
    true = run.true_error_rad[tracking][late] * 1e3
    settled = stuck = stuck_later = None
    if motion is not None:
        rests = motion.rests_s[(motion.rests_s[:, 0] >= after_s) & (motion.rests_s[:, 1] <= time_s[-1])]
        settled = settled_share(time_s, error, rests, max(count_rad, REST_BAND_rad))
        if motion.kind == "creep":
            stuck, stuck_later = stuck_share(run, after_s), stuck_share(run, after_s, TURNED_S)
    return ErrorFigures(
        fault="",
        peak_mrad=float(np.max(np.abs(measured))),
        rmse_mrad=float(np.sqrt(np.mean(measured**2))),
        lowest_mrad=float(np.min(measured)),
        highest_mrad=float(np.max(measured)),
        true_peak_mrad=float(np.max(np.abs(true))),
        true_rmse_mrad=float(np.sqrt(np.mean(true**2))),
        settling_s=settling_s(time_s, error),
        torque_peak_Nm=float(np.max(np.abs(run.log.command_torque_Nm[tracking][late]))),
        chatter_Nm=float(np.mean(np.abs(np.diff(run.log.command_torque_Nm[tracking][late])))),
        settled_share=settled,
        stuck_share=stuck,
        stuck_later_share=stuck_later,
    )


# --- The controllers that are compared: a table of named settings, and what configuration files add to it ---
# Every entry is a complete [control] section: that of configs/paper.toml with some keys replaced.  What the controller
# believes about the friction is the base configuration's [friction], or that of the file it comes from.


_MODEL_BASED: dict[str, Any] = {"zero_rule": "zero", "filtered_error_rate": True}
_STIFF: dict[str, Any] = {**_MODEL_BASED, "kp": 2500.0, "kv": 130.0, "feed_forward": "lugre_desired"}
_OBSERVER: dict[str, Any] = {**_MODEL_BASED, "kind": "computed_torque_observer", "feed_forward": "lugre_desired"}

# name -> keys of [control] that differ from configs/paper.toml
TABLE: dict[str, dict[str, Any]] = {
    "computed_torque": {**_MODEL_BASED, "kind": "computed_torque", "feed_forward": "none"},
    "pid": {**_MODEL_BASED, "kind": "pid", "feed_forward": "none", "kp": 6075.0, "kv": 135.0, "ki": 91125.0},
    "paper_without_friction_model": {"feed_forward": "none"},
    "paper": {},
    "paper_desired": {"feed_forward": "desired"},
    "paper_lugre": {"feed_forward": "lugre_desired"},
    "network_stiff": {**_STIFF, "lyapunov_q": (2.756e6, 4630.0)},
    "observer": {**_OBSERVER, "observer_radps": 60.0},
    "observer_stiff": {**_OBSERVER, "observer_radps": 60.0, "kp": 2500.0, "kv": 100.0},
}
# of a base whose drive closes its own loops: keys of [drive.cascade] that differ from it; the law is computed torque
OF_DRIVES: dict[str, dict[str, Any]] = {
    "drive_alone": {"torque_offset": False, "velocity_offset": False, "lead_s": 0.0},
    "drive_without_torque": {"torque_offset": False},
}
PRECISE = "precise"  # configs/precise.toml
DEFAULT = (*TABLE, PRECISE)


@dataclass(frozen=True)
class Controller:
    """A law under test; `friction` None is the belief of the base configuration."""

    name: str
    control: Control
    friction: Friction | None = None
    cascade: Mapping[str, Any] = field(default_factory=dict)  # keys of [drive.cascade] that differ from the base's


def changed(control: Control, changes: Mapping[str, Any], name: str) -> Control:
    """`control` with some keys replaced, checked like a file; `name` is what the message calls it."""
    values = control.model_dump()
    # a section inside is given as a table of keys and replaces the whole section
    values.update(changes)
    try:
        return Control.model_validate(values)
    except ValidationError as error:
        raise ConfigurationError(one_line(error, name)) from None


def one_line(error: ValidationError, origin: str) -> str:
    """Its first problem: where, which key, its value, what is wrong."""
    first = error.errors(include_url=False)[0]
    key, message = ".".join(str(part) for part in first["loc"]), str(first["msg"])
    return f"{origin}: {key} (={first['input']}): {message[0].lower()}{message[1:]}"


def named(names: tuple[str, ...] = DEFAULT) -> list[Controller]:
    """Entries of the table; the name of a shipped or of any other configuration file takes that file's law."""
    paper = shipped_control("paper")
    found = []
    for name in names:
        if name in TABLE:
            found.append(Controller(name, changed(paper, TABLE[name], name)))
        elif name in OF_DRIVES:
            found.append(Controller(name, changed(paper, TABLE["computed_torque"], name), cascade=OF_DRIVES[name]))
        else:
            found.append(from_file(name))
    doubled = sorted({c.name for c in found if sum(c.name == other.name for other in found) > 1})
    if doubled:
        raise ConfigurationError(f"controller (={doubled[0]}) must be named once")
    return found


def from_file(name: str) -> Controller:
    """The law of a configuration file, with what that file believes about the friction, and its drive's own loops."""
    path = Path(name)
    if not path.exists() and shipped_config(name).exists():
        path = shipped_config(name)
    if not path.exists():
        known = ", ".join((*TABLE, *OF_DRIVES))
        raise ConfigurationError(f"controller (={name}) must be a configuration file or one of {known}")
    config = load_config(path)
    require_simulated(config, "study")
    cascade = canopen_section(config).cascade
    return Controller(path.stem, config.control, config.friction, {} if cascade is None else cascade.model_dump())


def controller_config(base: Config, controller: Controller) -> Config:
    """The base configuration under this law; contradictions between its sections are refused."""
    update: dict[str, Any] = {"control": controller.control}
    if controller.friction is not None:
        update["friction"] = controller.friction
    drive = base.drive
    if controller.cascade:
        # the filter is no part of such a law: with it the loop supervises the velocity, at the rate of the base
        cutoff_Hz = base.control.velocity_cutoff_Hz
        update["control"] = controller.control.model_copy(update={"velocity_cutoff_Hz": cutoff_Hz})
        if drive.own_loop() is CommandKind.TORQUE:
            raise ConfigurationError(
                f"controller {controller.name} needs a --base with drive.mode csp or csv",
                "such as that controller's own file",
            )
        cascade = canopen_section(base).cascade
        assert cascade is not None
        update["drive__cascade"] = cascade.model_copy(update=dict(controller.cascade))
    config = base.changed(**update)
    problems = problems_between_sections(config)
    if problems:
        raise ConfigurationError(f"controller {controller.name}: {problems[0]}")
    return config


def with_chosen_gains(base: Config, controller: Controller) -> Controller:
    """The law with gains for what is believed of the base joint, and learning that converges on it."""
    config = controller_config(base, controller)
    control = gains_of_file(config, loop_settings(config)[0]).control
    return replace(controller, control=control)


def controller_constants(base: Config, controller: Controller, start_position_rad: float) -> Any:
    """`AxisConstants` of this law on the base joint, unsupervised: simulated time has no wall clock."""
    constants = axis_constants(
        controller_config(base, controller), trajectory_table(base), start_position_rad=start_position_rad
    )
    constants[0].sequence.supervisor_max_cycles = 0
    return constants

"""A study: every controller on many random joints, in as many processes as there are processors.

What a controller that was tuned on one joint meets on the next one.  Each plant is drawn from its own seed, so that
plant k of a study is the same whatever else is in it, commissioned once and then run under each controller.  The result
does not depend on the number of processes.  A study comes from flags and from a TOML file:

    plants = 40
    seed = 1
    scenario = "sine"                 # sine, frequency, amplitude, load, or a motion of `random_motions`
    controllers = ["paper", "precise", "my_joint.toml"]

    [plant]                           # any of the ranges of `EnsembleSettings`
    encoder_bits = [14, 16]
    flexible = true                   # the realistic ensemble: a soft reducer, and an encoder on either side of it; the
                                      # joint and the laws are then those of FLEXIBLE_DEFAULTS, unless they are given

    [variants.more_damping]           # keys of [control] changed, on top of a named controller
    of = "precise"
    kv = 180.0
"""

from __future__ import annotations

import csv
import io
import math
import tomllib
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from jointctl.drivers.errors import ConfigurationError, UsageError
from jointctl.firmware_py.input_file import parse_toml, read_input
from jointctl.firmware_py.states import CommandKind
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.analysis.margin_gate import cascade_margins
from jointctl.tools.analysis.margins import phase_margin_deg
from jointctl.tools.child_process import processors
from jointctl.tools.configuration.config import Config, suggestion
from jointctl.tools.configuration.conversions import law_resolution_rad
from jointctl.tools.configuration.sections import (
    FrictionLoad,
    FrictionTemperature,
    JointEncoder,
    Reducer,
    ReducerMap,
    Section,
    Virtual,
    between,
)
from jointctl.tools.drawing import BLUE, GREY, INK, canvas
from jointctl.tools.experiments.many_runs import HERE, Workers
from jointctl.tools.experiments.scenarios import (
    DEFAULT,
    RANDOM_MOTIONS,
    RPDO_AT_ONCE,
    Controller,
    ErrorFigures,
    Scenario,
    changed,
    controller_config,
    controller_constants,
    error_figures,
    named,
    one_line,
    random_motion,
    run_scenario,
    with_chosen_gains,
)
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.written_file import replace_file, writing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# --- random realistic joints ---


def _interval(low: float, high: float) -> Any:
    """Two numbers in ascending order, each in [low..high]."""

    def check(value: tuple[float, float]) -> tuple[float, float]:
        if not low <= value[0] <= value[1] <= high:
            raise PydanticCustomError(
                "interval", "must be two numbers in ascending order in {range}", {"range": f"[{low:g}..{high:g}]"}
            )
        return value

    return AfterValidator(check)


def _as_tuple(value: object) -> Any:
    """A list of TOML as the tuple that a frozen model holds."""
    return tuple(value) if isinstance(value, list) else value


_FromList = BeforeValidator(_as_tuple)
Interval = tuple[float, float]

# size of a harmonic reducer, ratio 80 and more -> stiffness up to the first knee, beyond each knee [Nm/rad], and the
# knees [Nm]: such values as their catalogues give
REDUCERS: dict[int, tuple[float, tuple[float, float], tuple[float, float]]] = {
    17: (1.0e4, (1.4e4, 1.6e4), (3.9, 12.0)),
    20: (1.6e4, (2.5e4, 2.9e4), (7.0, 25.0)),
    25: (3.1e4, (5.0e4, 5.7e4), (14.0, 48.0)),
}
SIZED_Nm, SIZED_kgm2 = 60.0, 2.1  # limits.torque_max_Nm and joint.inertia_kgm2 of the joint that the ranges suit
ENCODERS_APART_rad = 0.02  # by which two encoders of a flexible joint may differ
DELAY_ERROR_s = 0.2e-3  # by which the loop delay is measured wrong
CURVE_degC = 25.0  # at which [friction] holds as it stands
SMALL_MOTION = 1.6  # times the stiffness of the catalogue: what an identification with small motions finds


def _sizes(value: tuple[int, ...]) -> tuple[int, ...]:
    if not value or not set(value) <= set(REDUCERS):
        raise PydanticCustomError("sizes", "must be some of {known}", {"known": ", ".join(map(str, REDUCERS))})
    return value


class EnsembleSettings(Section):
    """Ranges of the plants; (low, high) are uniform unless the comment says otherwise.

    Torques are for a joint of `SIZED_Nm`; for another joint `sized` scales those that are not given.
    """

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
    # the rest, where the reducer is flexible: the encoder on the joint is then a second one, beside that on the motor
    flexible: bool = False
    # which of them feeds the law; joint_encoder_alone: there is none on the motor
    law: Literal["encoder", "joint_encoder", "joint_encoder_alone"] = "joint_encoder"
    reducer_sizes: Annotated[tuple[int, ...], _FromList, AfterValidator(_sizes)] = tuple(REDUCERS)
    flexible_inertia_scale: Annotated[Interval, _FromList, _interval(0.1, 10.0)] = (0.85, 1.15)  # in its place
    inertia_ratio: Annotated[Interval, _FromList, _interval(0.01, 100.0)] = (0.3, 5.0)  # link to motor, log-uniform
    reducer_damping: Annotated[Interval, _FromList, _interval(0.0, 1.0)] = (0.02, 0.06)  # share of the critical one
    hysteresis_width_rad: Annotated[Interval, _FromList, _interval(0.0, 0.1)] = (1e-4, 3e-4)
    kinematic_error_rad: Annotated[Interval, _FromList, _interval(0.0, 0.01)] = (1e-4, 3e-4)  # 2 per motor turn
    kinematic_error_share: Annotated[Interval, _FromList, _interval(0.0, 1.0)] = (0.1, 0.4)  # of it 4 per motor turn
    link_friction_share: Annotated[Interval, _FromList, _interval(0.0, 1.0)] = (0.05, 0.2)
    motor_encoder_bits: Annotated[tuple[int, int], _FromList, _interval(8, 26)] = (14, 17)
    # what the controller believes of the reducer: each inertia and the stiffness are wrong by up to this share
    model_error: Annotated[float, between(0.0, 0.5)] = 0.15
    maps: bool = True  # whether it has maps of kinematic error and torque ripple
    choose_gains: bool = True  # of the law of a flexible joint, for what it believes of each; else they are as given
    map_error: Annotated[float, between(0.0, 1.0)] = 0.05  # share by which their amplitudes are wrong at most
    # friction that goes with load and temperature, of which the controller knows nothing but what its file says
    loaded: bool = False
    pendulum_Nm: Annotated[Interval, _FromList, _interval(0.0, 1e4)] = (0.0, 20.0)  # which the controller knows
    load_coulomb: Annotated[Interval, _FromList, _interval(0.0, 2.0)] = (0.03, 0.2)
    load_viscous_spr: Annotated[Interval, _FromList, _interval(0.0, 2.0)] = (0.0, 0.1)
    temperature_degC: Annotated[Interval, _FromList, _interval(-50.0, 100.0)] = (15.0, 55.0)
    temperature_coulomb_pK: Annotated[Interval, _FromList, _interval(-0.2, 0.2)] = (0.002, 0.008)
    temperature_viscous_pK: Annotated[Interval, _FromList, _interval(-0.2, 0.2)] = (0.01, 0.03)


def _flexible(base: Config, settings: EnsembleSettings, random: np.random.Generator) -> dict[str, Any]:
    """Keys of [virtual] for a reducer of a random size."""
    low, high = np.log(settings.inertia_ratio)
    scale = float(random.uniform(*settings.flexible_inertia_scale))
    ratio = float(np.exp(random.uniform(low, high)))
    inertia = base.joint.inertia_kgm2 * scale
    motor = inertia / (1.0 + ratio)
    stiffness, beyond, knees = REDUCERS[int(random.choice(settings.reducer_sizes))]
    critical = 2.0 * math.sqrt(stiffness * motor * (inertia - motor) / inertia)
    error = float(random.uniform(*settings.kinematic_error_rad))
    return {
        "flexible": True,
        "inertia_scale": scale,
        "motor_side_inertia_kgm2": motor,
        "reducer_stiffness_Nmprad": stiffness,
        "reducer_stiffness_beyond_Nmprad": beyond,
        "reducer_knees_Nm": knees,
        "reducer_damping_Nmspr": critical * float(random.uniform(*settings.reducer_damping)),
        "hysteresis_width_rad": float(random.uniform(*settings.hysteresis_width_rad)),
        "kinematic_error_rad": (error, error * float(random.uniform(*settings.kinematic_error_share))),
        "kinematic_error_per_motor_turn": (2.0, 4.0),
        "kinematic_error_phase_rad": tuple(float(x) for x in random.uniform(0.0, math.tau, 2)),
        "link_friction_share": float(random.uniform(*settings.link_friction_share)),
    }


def _belief(
    base: Config, true: Virtual, settings: EnsembleSettings, random: np.random.Generator
) -> tuple[Reducer, float]:
    """(What the controller believes of a reducer, link inertia [kg m^2]): as an identification would find them."""

    def about(value: float, error: float = settings.model_error) -> float:
        return value * (1.0 + float(random.uniform(-error, error)))

    def maps(amplitudes: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(about(amplitude, settings.map_error) for amplitude in amplitudes)

    inertia = base.joint.inertia_kgm2 * true.inertia_scale
    motor, link, scale = about(true.motor_side_inertia_kgm2), about(inertia - true.motor_side_inertia_kgm2), about(1.0)
    error, ripple = maps(true.kinematic_error_rad), maps(true.torque_ripple_Nm)
    made = ReducerMap(
        direction=base.encoder.direction, zero_counts=base.encoder.zero_counts,
        kinematic_error_rad=error, kinematic_error_per_motor_turn=true.kinematic_error_per_motor_turn,
        kinematic_error_phase_rad=true.kinematic_error_phase_rad,
        torque_ripple_Nm=ripple, torque_ripple_per_motor_turn=true.torque_ripple_per_motor_turn,
        torque_ripple_phase_rad=true.torque_ripple_phase_rad,
    )  # fmt: skip
    stiffness, critical = true.reducer_stiffness_Nmprad * scale, 2.0 * math.sqrt(motor * link / (motor + link))
    believed = Reducer(
        motor_inertia_kgm2=motor, stiffness_Nmprad=stiffness, knees_Nm=true.reducer_knees_Nm,
        stiffness_beyond_Nmprad=tuple(scale * x for x in true.reducer_stiffness_beyond_Nmprad),
        loop_stiffness_Nmprad=SMALL_MOTION * stiffness,
        damping_Nmspr=float(np.mean(settings.reducer_damping)) * critical * math.sqrt(stiffness),
        link_friction_share=float(np.mean(settings.link_friction_share)),
        map=made if settings.maps and settings.law != "joint_encoder_alone" else None,
    )  # fmt: skip
    return believed, link


def _loaded(base: Config, settings: EnsembleSettings, random: np.random.Generator) -> dict[str, Any]:
    """Keys of [virtual] for a pendulum, a temperature, and the friction that goes with both."""
    if base.friction is None:
        raise ConfigurationError(f"{base.path}: plant.loaded (=true) needs [friction], which it adds to")

    def uniform(interval: tuple[float, float]) -> float:
        return float(random.uniform(*interval))

    truth = {
        "load": FrictionLoad(coulomb=uniform(settings.load_coulomb), viscous_spr=uniform(settings.load_viscous_spr)),
        "temperature": FrictionTemperature(
            reference_degC=CURVE_degC, coulomb_pK=uniform(settings.temperature_coulomb_pK),
            viscous_pK=uniform(settings.temperature_viscous_pK),
        ),
    }  # fmt: skip
    return {
        "friction": base.friction.model_copy(update=truth), "gravity_Nm": uniform(settings.pendulum_Nm),
        "ambient_degC": uniform(settings.temperature_degC),
    }  # fmt: skip


def sized(base: Config, settings: EnsembleSettings) -> EnsembleSettings:
    """The settings whose torques, where they are not given, go with the joint's own; damping with inertia too."""
    torque = base.limits.torque_max_Nm / SIZED_Nm
    damping = math.sqrt(torque * base.joint.inertia_kgm2 / SIZED_kgm2)
    ranges = {
        name: tuple(torque * end for end in getattr(settings, name))
        for name in ("torque_ripple_Nm", "bristle_stiffness_Nmprad", "pendulum_Nm")
    }
    scaled = {**ranges, "bristle_damping_Nmspr": damping * settings.bristle_damping_Nmspr}
    given = settings.model_fields_set
    return settings.model_copy(update={name: value for name, value in scaled.items() if name not in given})


def random_plant(base: Config, settings: EnsembleSettings, seed: int, index: int) -> Config:
    """The configuration with the virtual joint number `index` of the study with this seed."""
    random, settings = np.random.default_rng([seed, index]), sized(base, settings)

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
    update: dict[str, Any] = {
        "drive__rpdo_transmission_type": RPDO_AT_ONCE,
        "encoder": {"counts_per_turn": 2**bits, "side": "joint"},
    }
    if settings.flexible:
        virtual |= _flexible(base, settings, random)
        low_bits, high_bits = settings.motor_encoder_bits
        motor = {"counts_per_turn": 2 ** int(random.integers(low_bits, high_bits + 1)), "side": "motor"}
        if settings.law == "joint_encoder_alone":
            update["joint_encoder"] = None
        else:
            update["encoder"] = motor
            update["joint_encoder"] = JointEncoder(
                source="drive", counts_per_turn=2**bits, direction=1, zero_counts=0, law=settings.law,
                disagreement_max_rad=ENCODERS_APART_rad,
            )  # fmt: skip
        true = base.virtual.model_copy(update=virtual)
        update["reducer"], link_kgm2 = _belief(base, true, settings, random)
        believed_kgm2 = update["reducer"].motor_inertia_kgm2 + link_kgm2
        virtual["inertia_scale"] *= base.joint.inertia_kgm2 / believed_kgm2
        update["joint__inertia_kgm2"] = believed_kgm2
    delay_s = virtual["command_delay_s"] + float(random.uniform(-DELAY_ERROR_s, DELAY_ERROR_s))
    update["margin"] = {"loop_delay_s": max(delay_s, 0.0), "current_lag_s": virtual["current_lag_s"]}
    if settings.loaded:  # drawn by themselves: the rest of the plant is the same with and without
        virtual |= _loaded(base, settings, np.random.default_rng([seed, index, 1]))
        update["joint__gravity_Nm"] = virtual["gravity_Nm"]
    return base.changed(**update, virtual=virtual)


# --- what is compared ---


FLEXIBLE_DEFAULTS = {"base": "realistic", "controllers": ("paper", "precise", "realistic")}


class StudySettings(Section):
    """One study; a flag of the command line replaces the value of the file."""

    plants: Annotated[int, between(1, 100_000)] = 40
    seed: Annotated[int, between(0, 2**31)] = 1
    after_s: Annotated[float, between(0.0, 1e5)] = 75.0  # errors count from here on
    scenario: Scenario = "sine"
    base: str = "precise"  # configuration of everything but law and plant
    controllers: Annotated[tuple[str, ...], BeforeValidator(_as_tuple)] = DEFAULT
    plant: EnsembleSettings = EnsembleSettings()
    variants: dict[str, dict[str, Any]] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _of_flexible_joints(cls, data: Any) -> Any:
        """What is not given is that of a joint whose reducer is not rigid."""
        plant = data.get("plant")
        given = plant.model_dump() if isinstance(plant, EnsembleSettings) else plant if isinstance(plant, dict) else {}
        return {**FLEXIBLE_DEFAULTS, **data} if given.get("flexible") is True else data


def load_study(path: Path) -> StudySettings:
    """Read and check a study file; names of files in it are relative to the working folder."""
    try:
        data = parse_toml(read_input(path).decode("utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"{path}: cannot be read as TOML: {reason}") from None
    return checked(data, str(path))


def checked(data: dict[str, Any], origin: str) -> StudySettings:
    """`StudySettings` of these keys; the first problem as one line that begins with `origin`."""
    try:
        return StudySettings.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "extra_forbidden":
            model = EnsembleSettings if first["loc"][0] == "plant" else StudySettings
            known = list(model.model_fields)
            hint = suggestion(str(first["loc"][-1]), known)
            key = ".".join(str(part) for part in first["loc"])
            raise ConfigurationError(f"{origin}: {key} is not a known key{hint}") from None
        raise ConfigurationError(one_line(error, origin)) from None


def study_controllers(settings: StudySettings) -> list[Controller]:
    """The named ones, then the variants."""
    found = named(settings.controllers)
    for name, keys in settings.variants.items():
        if "of" not in keys:
            raise ConfigurationError(f"variants.{name}.of is missing: the controller that it changes")
        if any(controller.name == name for controller in found):
            raise ConfigurationError(f"variants.{name} must not have the name of another controller")
        parent = named((str(keys["of"]),))[0]
        changes = {key: value for key, value in keys.items() if key != "of"}
        found.append(Controller(name, changed(parent.control, changes, f"variants.{name}"), parent.friction))
    return found


# --- the runs ---

Progress = Callable[[float], None]


@dataclass(frozen=True)
class PlantTask:
    """One plant of the study, and what to run on it; it is sent to a process."""

    base: Config
    plant: EnsembleSettings
    seed: int
    index: int
    controllers: tuple[Controller, ...]
    scenario: Scenario
    after_s: float


@dataclass(frozen=True)
class PlantResult:
    """Figures of one plant under each controller, in their order."""

    index: int
    friction_kind: str
    encoder_bits: int
    figures: tuple[ErrorFigures, ...]


@dataclass(frozen=True)
class StudyResult:
    """All plants that were finished, in the order of their index."""

    controllers: tuple[str, ...]
    plants: tuple[PlantResult, ...]
    interrupted: bool

    def values(self, controller: str, figure: str) -> np.ndarray:
        """One figure of one controller over the plants, shape (plants,); inf where a fault ended the run, nan: none.

        `UsageError` for one that is not there.
        """
        figures = [each.name for each in fields(ErrorFigures) if each.name != "fault"]
        for what, name, known in (("controller", controller, self.controllers), ("figure", figure, figures)):
            if name not in known:
                raise UsageError(f"{what} (={name}) must be one of {', '.join(known)}")
        column = self.controllers.index(controller)
        return np.array([getattr(plant.figures[column], figure) for plant in self.plants], dtype=np.float64)

    def faults(self, controller: str) -> int:
        column = self.controllers.index(controller)
        return sum(1 for plant in self.plants if plant.figures[column].fault)


def quantile(values: np.ndarray, share: float) -> float:
    """Linear between two values; with infinite ones among them the upper of the two, since inf - inf is nothing."""
    method = "linear" if np.all(np.isfinite(values)) else "higher"
    return float(np.quantile(values, share, method=method))  # type: ignore[call-overload]


def _margin_deg(config: Config) -> float:
    """The least phase margin; nan where the drive closes its loops and their gains are not given."""
    settings, assumptions = loop_settings(config)
    if config.drive.own_loop() is CommandKind.TORQUE:
        return phase_margin_deg(settings)
    delay_s = next(assumed.value for assumed in assumptions if assumed.name == "loop delay")
    return min((loop.phase_margin_deg for loop in cascade_margins(config, delay_s)), default=math.nan)


def run_plant(task: PlantTask) -> PlantResult:
    """Commission the plant and run every controller on it."""
    config = random_plant(task.base, task.plant, task.seed, task.index)
    joint = LockstepJoint(config)
    motion = None
    if task.scenario in RANDOM_MOTIONS:
        motion = random_motion(task.scenario, task.seed, task.index, task.base.trajectory.duration_s)
    count_rad = law_resolution_rad(config)
    figures = []
    for controller in task.controllers:
        if controller.control.kind == "flexible_joint" and task.plant.flexible and task.plant.choose_gains:
            controller = with_chosen_gains(config, controller)
        constants = controller_constants(config, controller, joint.report.start_position_rad)
        own = LockstepJoint(controller_config(config, controller)) if controller.cascade else joint
        run = run_scenario(own, constants, task.scenario, motion=motion)
        margin_deg = _margin_deg(controller_config(config, controller))
        figures.append(replace(error_figures(run, task.after_s, motion, count_rad), phase_margin_deg=margin_deg))
    assert config.virtual is not None
    on_joint = config.encoder if config.joint_encoder is None else config.joint_encoder
    bits = round(math.log2(on_joint.counts_per_turn))
    return PlantResult(task.index, config.virtual.friction_kind, bits, tuple(figures))


def run_study(
    base: Config,
    controllers: list[Controller],
    settings: StudySettings,
    *,
    workers: Workers = HERE,
    progress: Progress | None = None,
) -> StudyResult:
    """All runs; `progress` hears how many plants are done.  Ctrl-C ends it early and keeps what is there."""
    after_s, plants = settings.after_s, settings.plants
    run_s = base.trajectory.duration_s
    if not 0.0 <= after_s < run_s:
        raise ConfigurationError(
            f"after_s (={after_s:g}) must be in [0..{run_s:g}), below trajectory.duration_s of {base.path}",
            "--after, or after_s of the --file",
        )
    order = tuple(controllers)
    tasks = [
        PlantTask(base, settings.plant, settings.seed, index, order, settings.scenario, after_s)
        for index in range(plants)
    ]
    if workers.cluster is None:
        workers = replace(workers, count=min(plants, workers.count or processors()))
    done: list[PlantResult] = []
    interrupted = False
    try:
        with closing(workers.results(run_plant, tasks)) as results:
            for result in results:
                done.append(result)
                if progress is not None:
                    progress(float(len(done)))
    except KeyboardInterrupt:
        interrupted = True
    done.sort(key=lambda result: result.index)
    return StudyResult(tuple(c.name for c in order), tuple(done), interrupted)


def write_csv(result: StudyResult, path: Path) -> None:
    """One line for each run."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(
        ["plant", "friction_kind", "encoder_bits", "controller", *(field.name for field in fields(ErrorFigures))]
    )
    for plant in result.plants:
        for name, figures in zip(result.controllers, plant.figures, strict=True):
            writer.writerow([plant.index, plant.friction_kind, plant.encoder_bits, name, *asdict(figures).values()])
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, text.getvalue().encode())


# --- box plots, logarithmic ---

_PANELS = (
    ("peak_mrad", "peak error [mrad]"),
    ("rmse_mrad", "RMSE [mrad]"),
    ("true_rmse_mrad", "RMSE of the joint\nitself [mrad]"),
)


def study_figure(result: StudyResult, title: str) -> Figure:
    """The boxes: quartiles; whiskers 5 and 95 %; dots beyond."""
    count = len(result.controllers)
    with canvas(1.8 + 0.42 * count, title) as figure:
        axes = figure.subplots(1, len(_PANELS), sharey=True)
        for axis, (key, label) in zip(axes, _PANELS, strict=True):
            _boxes(axis, result, key)
            axis.set_xscale("log")
            axis.set_xmargin(0.04)
            axis.set_xlabel(label)
            axis.grid(True, which="both", axis="x", linewidth=0.5)
            axis.grid(False, axis="y")
        axes[0].set_yticks(range(1, count + 1), [name.replace("_", " ") for name in result.controllers])
        axes[0].invert_yaxis()
        return figure


def _boxes(axis: Axes, result: StudyResult, key: str) -> None:
    drawn = [result.values(name, key) for name in result.controllers]
    axis.boxplot(
        [values[np.isfinite(values)] for values in drawn],
        orientation="horizontal",
        whis=(5, 95),
        widths=0.6,
        boxprops={"color": BLUE},
        medianprops={"color": INK, "linewidth": 1.6},
        whiskerprops={"color": BLUE},
        capprops={"color": BLUE},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": GREY},
    )

"""A stop, a death, another controller or a loss after EVERY frame of a run: is the joint off in time, and off for good?

    python tests/bench/every_frame.py [--kind run|sweep|program|arm] [--mode cst|csp|csv] [--deadline yes|no]
                                      [--buses 1] [--every 1] [--offset 0] [--rest 20] [--pairs SEED]
                                      [--workers 2] [--phase NAME] [--injection NAME]
                                      [--cluster tcp://127.0.0.1:8786] [--parts 8]

The run is simulated (`tests/simulated_programs.py`): supervisor, loop, `jointctl stop` and virtual drive at simulated
time, frame by frame; `program` is a user's program that sends set-points through `jointctl.Joint`, `arm` a run of the
shipped arm, where what is done to one drive is done to that of the middle joint; with `--buses 2` its wrist is on a
second bus, and either adapter goes off its bus.  Right after frame k
the process is forked for each injection; the child carries the run on to its end and judges it, the parent goes on as
if nothing had been.  `--pairs SEED`: each time a second injection follows, drawn at random, on any joint, 0.5 ms to 2 s
after the first.  `--rest N`: every Nth frame where nothing changes: while the loop waits with the drive off, and
from 100 ms after enabling until the stop.  Exit code 1 on a violation.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import math
import os
import re
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl import live_joint  # noqa: E402
from jointctl.drivers.errors import JointctlError  # noqa: E402
from jointctl.firmware_py.cycle import Word  # noqa: E402
from jointctl.firmware_py.states import Fault  # noqa: E402
from jointctl.joint import Joint  # noqa: E402
from jointctl.tools.child_process import processors  # noqa: E402
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm  # noqa: E402
from jointctl.tools.configuration.canopen import canopen_section  # noqa: E402
from jointctl.tools.configuration.config import Config  # noqa: E402
from jointctl.tools.configuration.load import load_config, shipped_config  # noqa: E402
from jointctl.tools.experiments.fault_scenarios import SECOND_AFTER_s  # noqa: E402
from jointctl.tools.experiments.many_runs import Workers  # noqa: E402
from jointctl.tools.session.control import (  # noqa: E402
    STOP_COMMAND,
    Control,
    StopSignals,
)
from jointctl.tools.session.display import PhaseLines  # noqa: E402
from jointctl.tools.session.plan import (  # noqa: E402
    TerminalConsent,
    resolve,
    resolve_arm,
)
from jointctl.tools.session.result import RunResult  # noqa: E402
from jointctl.tools.session.session import Session  # noqa: E402
from tests.simulated_programs import (  # noqa: E402
    SUPERVISOR,
    World,
    quiet_output,
    simulated,
    stop_of_another_computer,
    stop_of_this_computer,
)

VERBOSE = False
CLOCK = time.monotonic  # the computer's own
FIRST_MOTION_CYCLES = 100  # of the approach, in which every frame is tried
ENABLING_s = 0.05  # another controller's write while the loop enables is seen at the supervisor's next look
QUIET_s = 0.2  # for so long after the end the drive must stay off
LONGEST_s = 30.0
WHOLE_s = 2.0  # approach and motion
SET_POINTS, SET_POINT_s, SWING_rad = 30, 0.01, 0.01
WARM_UP = ("stop", "NMT stop", "SDO 6007 = 0", "frames to the drive lost")
# What is waited for, shorter than on a joint: the time that is allowed follows.
SHORT = {"duration_s": 0.3, "release_s": 0.02, "heartbeat_s": 0.1, "wait_timeout_s": 1.0, "enable_timeout_s": 1.0,
         "stop_timeout_s": 1.0, "off_timeout_s": 0.5}  # fmt: skip


@dataclass
class Scene:
    """One run, and what became of it."""

    world: World
    joints: tuple[Config, ...]
    signals: StopSignals
    carried_out: Callable[[], RunResult | None]  # the whole of the supervisor's program
    outcome: str = ""  # how the supervisor ended: "" while it runs
    text: str = ""
    axis: int = 0  # of the joint that an injection is for, if it is for one
    second: str = ""  # the injection that follows
    powered: bool = False  # at the second one

    def __post_init__(self) -> None:
        self.axis = len(self.joints) // 2

    @property
    def config(self) -> Config:
        return self.joints[0]

    @property
    def places(self) -> list[tuple[int, int]]:
        """Bus and node of each drive."""
        return [(bus, canopen_section(c).node) for bus, c in zip(self.world.bus, self.joints, strict=True)]

    def send(self, identifier: int, data: bytes) -> None:
        """A frame of another program on the bus of that joint."""
        self.world.send(None, identifier, data, self.places[self.axis][0])

    @property
    def node(self) -> int:
        return self.places[self.axis][1]

    @property
    def loop(self) -> Any:
        return SEEN[-1] if SEEN else None

    @property
    def phase(self) -> str:
        """Of the run: commissioning, the loop's phases, or switching off."""
        loop = self.loop
        if loop is None or not loop.block.words[Word.GO]:
            return "commissioning"
        return "switching off" if loop.block.words[Word.ENDED] else loop.phase.name.lower().replace("_", " ")

    def names_joint(self, injection: str) -> bool:
        """Whether the message says whose drive it was, if it was one's, or that of one on the bus."""
        if (off := self.world.off_bus) is not None:
            axes = [axis for axis, bus in enumerate(self.world.bus) if bus == off]
            return any(f"node {self.places[k][1]}" in self.text or self.joints[k].path.stem in self.text for k in axes)
        if not (INJECTIONS[injection].of_one_drive or injection.startswith(OF_ONE_DRIVE)):
            return True
        return f"node {self.node}" in self.text or self.joints[self.axis].path.stem in self.text

    def then(self, injections: Sequence[str], seed: str) -> None:
        """Draw a second injection, and a program that makes it."""
        random = Random(seed)
        self.second, axis = random.choice(injections), random.randrange(len(self.joints))
        at_ns = self.world.now_ns + round(1e9 * math.exp(random.uniform(*map(math.log, SECOND_AFTER_s))))

        def inject() -> None:
            self.world.sleep_until_ns(at_ns)
            self.axis, self.powered = axis, self.world.powered
            INJECTIONS[self.second].act(self)

        self.world.start("second injection", inject)

    def carry_out(self) -> None:
        """The supervisor's program."""
        try:
            result = self.carried_out()
        except KeyboardInterrupt:
            self.outcome, self.text = "interrupted", self.signals.name
        except JointctlError as error:
            self.outcome, self.text = type(error).__name__, str(error)
        else:
            self.outcome = "done" if result is not None else "declined"
            if result is not None and result.stopped_by not in ("", live_joint.WHO):
                self.outcome, self.text = "interrupted", result.stopped_by
            elif result is not None and any(one.fault is not Fault.NONE for one in result.joints):
                self.outcome = "fault"
                faulty = [one for one in result.joints if one.fault is not Fault.NONE]
                self.text = "; ".join(f"{one.name} {one.fault.name}: {one.fault_text}" for one in faulty)


SEEN: list[Any] = []  # loops of this process


def write_object(index: int, sub: int, value: int, size: int) -> Callable[[Scene], None]:
    """An expedited SDO download of another master."""

    def inject(session: Scene) -> None:
        data = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + value.to_bytes(4, "little")
        session.send(0x600 + session.node, data)

    return inject


def nmt(command: int) -> Callable[[Scene], None]:
    return lambda session: session.send(0, bytes([command, session.node]))


def die(*names: str) -> Callable[[Scene], None]:
    def inject(session: Scene) -> None:
        loop = session.loop
        if "loop" in names and loop is not None:
            loop._process.kill()
        session.world.kill(*names)

    return inject


def lose(direction: str) -> Callable[[Scene], None]:
    return lambda session: setattr(session.world, direction, True)


def switch_bus_off(number: int) -> Callable[[Scene], None]:
    return lambda session: setattr(session.world, "off_bus", session.world.buses[number])


@dataclass(frozen=True)
class Injection:
    """`reaction_s`: until the joint is being stopped, at most (docs/safety.md); `causes`: one must be in the message.

    `may_enable`: the program that would enable cannot know of it yet.  `other_controller`: it writes to the drive while
    the loop enables it, which goes on until the supervisor's next look.  `of_one_drive`: of an arm, the message must
    name that joint or its node.
    """

    act: Callable[[Scene], None]
    reaction_s: Callable[[Config], float]
    causes: tuple[str, ...] = ()
    may_enable: bool = False
    other_controller: bool = False
    of_one_drive: bool = False


def at_once(_: Config) -> float:
    return 0.1


def by_heartbeat(config: Config) -> float:
    return 20.0 / config.loop.rate_Hz + canopen_section(config).heartbeat_s + config.limits.sample_age_max_s


def to_the_end(config: Config) -> float:
    """Of the run, which need not be ended."""
    return WHOLE_s + by_ramp(config)


def by_silence(config: Config) -> float:
    return config.stream.client_timeout_s + by_ramp(config)


def by_ramp(config: Config) -> float:
    return config.sequence.supervisor_timeout_s + config.sequence.stop_timeout_s + config.sequence.release_s


OTHERS = ("another controller", "another program", "DRIVE_", "STALE", "NO_SAMPLES", "SAMPLES_MISSING", "ENABLE_TIMEOUT",
          "OFF_TIMEOUT", "does not answer", "got no answer", "changed", "was set", "refused", "mode")  # fmt: skip
SILENCE = ("no answer", "does not answer", "STALE", "NO_SAMPLES", "SAMPLES_MISSING", "DRIVE_", "did not react",
           "ENABLE_TIMEOUT", "OFF_TIMEOUT", "did not confirm", "watchdog tripped", "cannot be read",
           "timed out")  # fmt: skip
HANGS = "the program hangs"  # but the session's thread goes on
CUT_OFF = "one drive is cut off"
REFUSED = "all SDO requests refused"
FIRST_OFF, LAST_OFF = "adapter off the first bus", "adapter off the last bus"
INJECTIONS = {
    "stop": Injection(lambda s: stop_of_this_computer(s.world, s.signals, s.places), at_once, (STOP_COMMAND,)),
    "stop of another computer": Injection(
        lambda s: stop_of_another_computer(s.world, s.places), at_once, OTHERS, other_controller=True
    ),
    "loop dies": Injection(die("loop"), by_heartbeat, ("loop process",), may_enable=True),
    "supervisor dies": Injection(die("supervisor"), by_ramp, may_enable=True),
    HANGS: Injection(lambda s: s.world.hang(SUPERVISOR), by_silence, may_enable=True),
    "both die": Injection(die("loop", "supervisor"), by_heartbeat, may_enable=True),
    "NMT pre-operational": Injection(nmt(128), at_once, OTHERS),
    "NMT stop": Injection(nmt(2), at_once, OTHERS),
    "NMT reset node": Injection(nmt(129), at_once, OTHERS),
    "NMT reset communication": Injection(nmt(130), at_once, OTHERS),
    "SDO 1016:1 = 0": Injection(write_object(0x1016, 1, 0, 4), at_once, OTHERS, may_enable=True, other_controller=True),
    "SDO 1400:5 = 0": Injection(write_object(0x1400, 5, 0, 2), at_once, OTHERS, may_enable=True, other_controller=True),
    "SDO 6007 = 0": Injection(write_object(0x6007, 0, 0, 2), at_once, OTHERS, may_enable=True, other_controller=True),
    "SDO 6060 = 1": Injection(write_object(0x6060, 0, 1, 1), at_once, OTHERS, may_enable=True, other_controller=True),
    "SDO 6040 = 0": Injection(write_object(0x6040, 0, 0, 2), at_once, OTHERS, may_enable=True, other_controller=True),
    "SDO 6040 = 0Fh": Injection(
        write_object(0x6040, 0, 0x0F, 2), at_once, OTHERS, may_enable=True, other_controller=True
    ),
    "frames to the drive lost": Injection(lose("lost_to_drive"), by_heartbeat, SILENCE),
    "frames of the drive lost": Injection(lose("lost_from_drive"), by_heartbeat, SILENCE, may_enable=True),
    CUT_OFF: Injection(
        lambda s: setattr(s.world, "cut_off", s.axis), by_heartbeat, SILENCE, may_enable=True, of_one_drive=True
    ),
    REFUSED: Injection(lambda s: setattr(s.world, "sdo_refused", True), to_the_end, may_enable=True),
    FIRST_OFF: Injection(switch_bus_off(0), by_heartbeat, (*SILENCE, "BUS"), may_enable=True),
    LAST_OFF: Injection(switch_bus_off(-1), by_heartbeat, (*SILENCE, "BUS"), may_enable=True),
}
OF_ONE_DRIVE = ("NMT ", "SDO 1", "SDO 6")  # begin the names of these


# what takes the drive's watchdog away, and after what no one else is left
DISARMING = {"SDO 1016:1 = 0", "SDO 1400:5 = 0", "SDO 6007 = 0"}
LEFT_ALONE = {"both die", "loop dies", "frames to the drive lost", CUT_OFF, FIRST_OFF, LAST_OFF}


def beyond_help(session: Scene, first: str) -> bool:
    """Both at once, while the drive has power: another controller has switched off the last who would stop it."""
    both = {first, session.second}
    return session.powered and bool(both & DISARMING) and bool(both & LEFT_ALONE)


@dataclass
class Verdict:
    """Of one injection."""

    frame: int
    phase: str
    injection: str
    off_after_s: float
    outcome: str
    text: str
    problems: list[str] = field(default_factory=list)


def judge(
    session: Scene,
    name: str,
    frame: int,
    phase: str,
    injected_ns: int,
    powered: bool,
    changes: list[tuple[int, bool]],
) -> Verdict:
    """After the run has ended; `powered` is the drive's power at the injection, `changes` are those after it."""
    world, config, injection = session.world, session.config, INJECTIONS[name]
    sequence = config.sequence
    both = (injection, INJECTIONS[session.second]) if session.second else (injection,)
    causes = [cause for one in both for cause in one.causes]
    allowed_s = sum(one.reaction_s(config) for one in both) + sequence.stop_timeout_s + sequence.off_timeout_s
    off_ns = max((time_ns for time_ns, on in changes if not on), default=injected_ns)
    told = f"{name}, then {session.second}" if session.second else name
    verdict = Verdict(frame, phase, told, (off_ns - injected_ns) * 1e-9, session.outcome, session.text[:300])
    problems = verdict.problems
    if beyond_help(session, name):
        return verdict
    if world.powered:
        problems.append("the drive has power at the end")
    if verdict.off_after_s > allowed_s:
        problems.append(f"off after {verdict.off_after_s:.2f} s, allowed are {allowed_s:.2f} s")
    ons = [time_ns for time_ns, on in changes if on]
    # a program's silence, also that of one that hangs, is known after this time only
    unknown_s = config.stream.client_timeout_s if name == HANGS else ENABLING_s
    late = [time_ns for time_ns in ons if (time_ns - injected_ns) * 1e-9 > unknown_s]
    # of an arm the other drives are enabled until the loop knows of that one
    of_another = len(session.joints) > 1 and name.startswith(OF_ONE_DRIVE)
    if phase == "enabling" and (injection.other_controller or of_another):
        if late:
            problems.append(f"enabled {(late[-1] - injected_ns) * 1e-6:.1f} ms after it")
    elif ons and not injection.may_enable:
        problems.append(f"enabled {(ons[0] - injected_ns) * 1e-6:.1f} ms after it")
    elif (
        len(ons) > 1
        or (ons and powered)
        or (late and name not in ("supervisor dies", "frames of the drive lost", REFUSED))
    ):
        problems.append(f"enabled again {(ons[-1] - injected_ns) * 1e-6:.1f} ms after it")
    if world.enabled_unproven:
        problems.append("enabled without a proven watchdog")
    if injection.causes and session.outcome not in ("",) and phase != "switching off":
        if session.outcome == "done" and phase not in ("disabling", "finished"):
            problems.append("the run went on as if nothing had been")
        elif session.outcome != "done" and not any(cause in session.text for cause in causes):
            problems.append(f"the message does not name the cause: {session.outcome}: {session.text[:200]}")
        elif (
            session.outcome != "done" and len(session.joints) > 1 and not (session.second or session.names_joint(name))
        ):
            problems.append(f"the message does not name the joint: {session.outcome}: {session.text[:200]}")
    return verdict


def prepared(
    kind: str, deadline: bool, folder: Path, mode: str = "cst", buses: int = 1
) -> tuple[Config | ArmConfig, Config | ArmConfig]:
    """The configuration of a short run, and that of its virtual drives, which have all objects."""
    eds = (ROOT / "configs" / "virtual_joint.eds").read_text()
    if not deadline:
        eds, count = re.subn(r"(?ims)^\[1400sub5\].*?(?=^\[|\Z)", "", eds)
        assert count == 1
    found: list[Config | ArmConfig] = []
    shipped = SHIPPED_ARM if kind == "arm" else shipped_config("virtual" if mode == "cst" else "csp")
    for name, its_eds in (("run", "joint.eds"), ("drive", "virtual_joint.eds")):
        own = folder / name
        own.mkdir()
        (own / "joint.eds").write_text(eds)
        for path in shipped.parent.iterdir() if kind == "arm" else [shipped]:
            text = path.read_text()
            for key, value in SHORT.items():
                text = re.sub(rf"(?m)^{key} = \S+", f"{key} = {value}", text)
            if buses == 2 and path.name == "wrist.toml":
                text = text.replace('"virtual0"', '"virtual1"')
            if kind != "arm":
                text = re.sub(r'(?m)^mode = "\w+"', f'mode = "{mode}"', text)
            (own / path.name).write_text(text.replace('"virtual_joint.eds"', f'"{its_eds}"'))
        found.append((load_arm if kind == "arm" else load_config)(own / shipped.name))
    return found[0], found[1]


def of_a_program(config: Config, control: Control, world: World) -> Callable[[], RunResult | None]:
    """A user's program: it sends set-points, and ends."""
    live_joint.in_program = lambda *_: contextlib.nullcontext(control)  # type: ignore[assignment]
    live_joint.Output = lambda **_: quiet_output()  # type: ignore[assignment, misc]
    joint = Joint(config)
    turn = math.tau / (SET_POINTS * SET_POINT_s)

    def send() -> RunResult | None:
        with joint:
            joint.enable()
            start_rad = joint.state.position_rad
            for k in range(SET_POINTS):
                t = k * SET_POINT_s
                joint.command(start_rad + SWING_rad * (1.0 - math.cos(turn * t)), SWING_rad * turn * math.sin(turn * t))
                world.sleep(SET_POINT_s)
        motor: Any = joint._motor
        return motor.result  # type: ignore[no-any-return]

    return send


def new_session(kind: str, config: Config | ArmConfig, control: Control, folder: Path) -> Session:
    output, log = quiet_output(), folder / "log.mcap"
    consent = TerminalConsent(output, assume_yes=True)
    if isinstance(config, ArmConfig):
        return Session(resolve_arm(config), consent, output, control, lambda _: PhaseLines(output))
    if kind == "run":
        plan = replace(resolve(config), log_path=log)
        return Session(plan, consent, output, control, lambda _: PhaseLines(output))
    from jointctl.tools.sweeping.carry_out import (
        MeterDisplay,
        SweepMeter,
        SweepPass,
        Tolerance,
        config_of_sweep,
        sweep_run,
    )
    from jointctl.tools.sweeping.options import SweepOptions
    from jointctl.tools.sweeping.plan import make_plan
    from jointctl.tools.verbs.sweep import joint_model

    config = config_of_sweep(config, "auto")
    options = SweepOptions(points=2, min_speed_radps=0.4, max_speed_radps=0.5, dwell_s=0.1, warm_up_turns=0.0)
    plan = make_plan(config, options)
    motion = plan.motion(plan.points, 0.0, 1.0)
    meter = SweepMeter(motion.windows, joint_model(config, plan.settings), lambda _: None)
    meter.tolerance = Tolerance(0.01, 0.001)
    swept = replace(sweep_run(SweepPass(config, motion, plan.points)), log_path=log)
    return Session(swept, consent, output, control, lambda _: MeterDisplay(meter, output, "", motion.duration_s))


class Exhaustion:
    """Runs once and forks after its frames."""

    def __init__(
        self, kind: str, deadline: bool, every: int, rest: int, part: tuple[int, int], out: Any, mode: str = "cst",
        buses: int = 1,
    ) -> None:  # fmt: skip
        self.kind, self.deadline, self.every, self.rest, self.part, self.out = kind, deadline, every, rest, part, out
        self.child, self.mode, self.buses = False, mode, buses
        self.pairs = 0  # the seed, or none
        self.parent = os.getppid()  # ends with it: no one would read what this finds
        self.chosen = self.in_rest = 0
        self.phases: list[str] = []  # the only ones, or all
        only = {HANGS: "program", CUT_OFF: "arm"}  # to a single drive that is frames lost both ways
        of_two = (FIRST_OFF, LAST_OFF)
        self.injections = [
            name for name in INJECTIONS if only.get(name, kind) == kind and (buses > 1 or name not in of_two)
        ]
        self.why: tuple[str, int, str, int, bool, int] | None = None

    def run(self) -> int:
        """The number of frames of the undisturbed run."""
        with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):  # an arm's logs are for no one
            config, joint = prepared(self.kind, self.deadline, Path(name), self.mode, self.buses)
            for injection in WARM_UP:
                self._warm_up(config, joint, Path(name), injection)
            with simulated(joint) as world:
                self.session = self._start(config, world, Path(name))
                self.motion_cycle = -1
                world.on_frame = self._after_frame
                gc.collect()
                gc.freeze()
                gc.disable()  # a child would copy what it looks through
                world.run(lambda: world.now_ns > LONGEST_s * 1e9 + 1e9)
                if self.child:
                    self._finish()
                assert self.session.outcome == "done", (self.session.outcome, self.session.text)
                assert not world.powered
                return world.frames

    def _warm_up(self, config: Config | ArmConfig, joint: Config | ArmConfig, folder: Path, name: str) -> None:
        """One run with an injection: what is loaded or remembered at its first use would be so in every child."""
        with simulated(joint) as world:
            session = self._start(config, world, folder)
            world.run(lambda: session.phase in ("approach", "tracking"))
            world.fast = world.long_naps = True
            INJECTIONS[name].act(session)
            world.run(lambda: world.now_ns > LONGEST_s * 1e9)
        SEEN.clear()

    def _start(self, config: Config | ArmConfig, world: World, folder: Path) -> Scene:
        from jointctl.tools.session import session as session_module

        made = session_module.LoopHandle

        def make(*arguments: Any, **more: Any) -> Any:
            SEEN.append(made(*arguments, **more))
            return SEEN[-1]

        session_module.LoopHandle = make  # type: ignore[misc, assignment]
        if self.kind == "program":  # its session has a thread of its own
            assert isinstance(config, Config)
            signals = StopSignals(wake=lambda: None)
            session = Scene(world, (config,), signals, of_a_program(config, Control(signals), world))
        else:
            signals = StopSignals(wake=lambda: signals.on_signal(15, None))
            supervisor = new_session(self.kind, config, Control(signals), folder)
            joints = tuple(joint.config for joint in supervisor.plan.joints)
            session = Scene(world, joints, signals, supervisor.run)
        world.start(SUPERVISOR, session.carry_out)
        return session

    def _wanted(self, phase: str) -> bool:
        """Whether injections follow this frame."""
        loop = self.session.loop
        resting = phase == "waiting"
        if phase in ("approach", "tracking"):
            if self.motion_cycle < 0:
                self.motion_cycle = loop.cycles
            resting = loop.cycles - self.motion_cycle > FIRST_MOTION_CYCLES
        if resting:
            self.in_rest += 1
            if self.in_rest % self.rest:
                return False
        if self.phases and phase not in self.phases:
            return False
        self.chosen += 1
        return (self.chosen % self.every) == 0 and (self.chosen // self.every) % self.part[1] == self.part[0]

    def _after_frame(self, number: int, identifier: int) -> None:
        if self.child:
            return
        phase = self.session.phase
        if not self._wanted(phase):
            return
        if os.getppid() != self.parent:
            os._exit(1)
        for name in self.injections:
            if os.fork():
                _, status = os.wait()
                if status:
                    problem = f"the simulation ended with status {status}"
                    row = {"frame": number, "phase": phase, "injection": name, "problems": [problem]}
                    self.out.write(json.dumps(row) + "\n")
                    self.out.flush()
                continue
            self.child = True
            world = self.session.world
            world.fast, world.long_naps = True, phase != "commissioning"
            self.why = (name, number, phase, world.now_ns, world.powered, len(world.power_changes))
            if self.pairs:
                self.session.then(self.injections, f"{self.pairs} {number} {name}")
            INJECTIONS[name].act(self.session)
            return

    def _finish(self) -> None:
        """The end of a child."""
        assert self.why is not None
        world = self.session.world
        world.pass_time(10.0, lambda: not world.powered)
        world.pass_time(QUIET_s)
        name, number, phase, injected_ns, powered, before = self.why
        verdict = judge(self.session, name, number, phase, injected_ns, powered, world.power_changes[before:])
        if VERBOSE:
            print(name, phase, injected_ns, powered, world.power_changes, verdict, file=sys.stderr)
        self.out.write(json.dumps(vars(verdict)) + "\n")
        self.out.flush()
        os._exit(0)


def report(rows: list[dict[str, Any]], frames: dict[str, int], elapsed_s: float) -> int:
    """Table and violations; the number of these."""
    times: dict[str, list[float]] = defaultdict(list)
    bad = [row for row in rows if row["problems"]]
    for row in rows:
        if "off_after_s" in row:
            times[row["injection"].split(",")[0]].append(row["off_after_s"])
    print(f"{len(rows)} injections after the frames of {', '.join(f'{k} ({n} frames)' for k, n in frames.items())}; "
          f"{elapsed_s:.0f} s; simulated")  # fmt: skip
    print(f"{'injection':28} {'number':>7} {'with power':>10} {'off after, median':>18} {'99 %':>8} {'longest':>8}")
    for name in INJECTIONS:
        all_s = times[name]
        off = sorted(value for value in all_s if value > 0.0)
        shown = [off[len(off) // 2], off[int(0.99 * len(off))], off[-1]] if off else []
        print(f"{name:28} {len(all_s):7d} {len(off):10d} " + "".join(f"{v * 1e3:12.0f} ms" for v in shown))
    print(f"{len(bad)} violations")
    shown_kinds: Counter[tuple[str, str, str]] = Counter()
    for row in bad:
        kind = (row["injection"], row["phase"], re.sub(r"[\d.]+", "#", row["problems"][0]))
        shown_kinds[kind] += 1
        if shown_kinds[kind] == 1:
            print(json.dumps(row))
    for kind, count in shown_kinds.most_common():
        print(count, *kind)
    return len(bad)


def rows_of_part(words: list[str]) -> list[dict[str, Any]]:
    """What one process finds in its share of the frames; it forks, which a worker with threads must not."""
    done = subprocess.run([sys.executable, *words], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise JointctlError(f"a part ended with code {done.returncode}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def rows_of_parts(words: list[str], parts: int, workers: Workers) -> Iterator[dict[str, Any]]:
    """What all shares have shown, of the frames divided by `parts`; progress on stderr."""
    tasks = [[*words, "--part", f"{k}/{parts}"] for k in range(parts)]
    with contextlib.closing(workers.results(rows_of_part, tasks)) as results:
        for number, rows in enumerate(results, 1):
            print(f"{' '.join(words[1:5])}: {number} of {parts} parts", file=sys.stderr, flush=True)
            yield from rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=("run", "sweep", "program", "arm"), action="append")
    parser.add_argument("--mode", choices=("cst", "csp", "csv"), default="cst", help="drive.mode of a joint")
    parser.add_argument("--buses", type=int, choices=(1, 2), default=1, help="2: the wrist of an arm is on another one")
    parser.add_argument("--deadline", choices=("yes", "no"), action="append", help="whether the drive has 1400:5")
    parser.add_argument("--every", type=int, default=1, help="every Nth of the frames that would be tried")
    parser.add_argument("--offset", type=int, default=0, help="other ones of them: so many frames earlier")
    parser.add_argument("--rest", type=int, default=20, help="every Nth frame where nothing changes")
    parser.add_argument("--pairs", type=int, default=0, metavar="SEED", help="a second injection after each; from 1")
    parser.add_argument("--workers", type=int, help="processes; default: one a core")
    parser.add_argument("--cluster", help="address of a dask scheduler whose workers have this clone at this path")
    parser.add_argument("--parts", type=int, help="shares of the frames; default: four times the processors here")
    parser.add_argument("--phase", action="append", help="only frames of this phase, as it is named in a violation")
    parser.add_argument("--injection", choices=list(INJECTIONS), action="append", help="only this one")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.buses > 1 and given.kind != ["arm"]:
        parser.error("--buses 2 is for --kind arm")
    kinds, deadlines = given.kind or ["run", "sweep", "program", "arm"], given.deadline or ["yes", "no"]
    if given.part:
        number, count = map(int, given.part.split("/"))
        one = Exhaustion(
            kinds[0],
            deadlines[0] == "yes",
            given.every,
            given.rest,
            (number, count),
            sys.stdout,
            given.mode,
            given.buses,
        )
        one.phases, one.injections = given.phase or [], given.injection or one.injections
        one.chosen, one.pairs = given.offset, given.pairs
        sys.stdout.write(json.dumps({"frames": one.run()}) + "\n")
        return 0
    workers = Workers(given.workers, given.cluster)
    parts = given.parts or (1 if given.workers == 1 else 4 * (given.workers or processors()))
    rows: list[dict[str, Any]] = []
    frames: dict[str, int] = {}
    started_s = CLOCK()
    for kind in kinds:
        for deadline in deadlines:
            words = [str(Path(__file__).resolve()), "--kind", kind, "--deadline", deadline, "--every", str(given.every)]
            words += [
                "--mode",
                given.mode,
                "--buses",
                str(given.buses),
                "--rest",
                str(given.rest),
                f"--offset={given.offset}",
                f"--pairs={given.pairs}",
                *(f"--phase={name}" for name in given.phase or []),
            ]
            words += [f"--injection={name}" for name in given.injection or []]
            for row in rows_of_parts(words, parts, workers):
                if "frames" in row:
                    frames[f"{kind}, {'with' if deadline == 'yes' else 'without'} 1400:5"] = row["frames"]
                else:
                    rows.append(row)
            print(f"{kind}, 1400:5 {deadline}: {len(rows)} injections so far, "
                  f"{sum(bool(row['problems']) for row in rows)} violations, {CLOCK() - started_s:.0f} s",
                  file=sys.stderr, flush=True)  # fmt: skip
    return 1 if report(rows, frames, CLOCK() - started_s) else 0


if __name__ == "__main__":
    sys.exit(main())

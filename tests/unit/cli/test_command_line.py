"""What the command line says about itself, what it does not understand, and what each verb does with `-p PORT`."""

from __future__ import annotations

import importlib
import io
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from jointctl.drivers.bus_lock import StopCall
from jointctl.drivers.errors import BusError, ConfigurationError, DataError
from jointctl.tools import child_process
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.elmo import elmo_section
from jointctl.tools.configuration.load import SHIPPED_FOLDER, load_config
from jointctl.tools.experiments.paper_experiments import synthetic_sweep
from jointctl.tools.output import Output
from jointctl.tools.verbs import run as run_verb
from jointctl.tools.verbs import start
from jointctl.tools.verbs.bench_drive import ServeOptions
from jointctl.tools.verbs.elmo_bench import ElmoBench
from jointctl.tools.verbs.main import EPILOG, app
from jointctl.tools.verbs.new import new
from jointctl.tools.verbs.verb_options import BusOptions, CanOptions, grouped, loaded
from tests.configurations import SLOW_LOOP, edited_file, written
from tests.python_process import Finished

Jointctl = Callable[..., Finished]

# --- What the command line says about itself, and `jointctl new` ---
QUIET = Output(stdout=io.StringIO(), stderr=io.StringIO())
MARKUP = re.compile(r"\[[a-z#/@]")  # what the help's formatter takes for a style, and swallows


def commands(command: Any = None, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The words that lead to each verb, and the verb."""
    command = command or typer.main.get_command(app)
    yield words, command
    for key, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*words, key))


@pytest.mark.parametrize(("words", "command"), [pytest.param(*both, id="-".join(both[0])) for both in commands()])
def test_the_help_of_every_verb_says_what_it_does_and_loses_nothing_in_80_columns(
    words: tuple[str, ...], command: Any
) -> None:
    assert command.help
    texts = [command.help, command.epilog or "", *(getattr(p, "help", "") or "" for p in command.params)]
    assert [text for text in texts if MARKUP.search(text)] == []
    shown = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "80"})
    assert shown.exit_code == 0
    assert "…" not in shown.output
    assert "<bool>" not in shown.output  # a flag shows no type
    assert max(len(line) for line in shown.output.splitlines()) <= 80


def test_the_help_names_every_shipped_configuration() -> None:
    for file in SHIPPED_FOLDER.glob("*.toml"):
        assert file.stem in EPILOG


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (["demo", "--duration", "nan"], "nan"),
        (["info", "-t", "0"], "0"),
        (["zero", "j", "--angle", "30 rpm"], "30 rpm"),
    ],
)
def test_a_value_that_the_parser_refuses_is_named(words: list[str], value: str) -> None:
    shown = subprocess.run([sys.executable, "-m", "jointctl.tools.verbs", *words], capture_output=True, text=True)
    assert shown.returncode == 2
    assert re.fullmatch(rf"error: .*{words[-2]}.*(\(={value}\)|'{value}').*\nhint: .*\n", shown.stderr)


def test_the_version_is_that_of_the_package() -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "jointctl.tools.verbs", "--version"], capture_output=True, text=True, check=True
    )
    assert shown.stdout == f"jointctl {version('jointctl')}\n"


@pytest.mark.parametrize(
    ("modules", "slow"),
    [
        ("jointctl.tools.verbs.main", "numba numpy scipy can canopen pydantic matplotlib tomlkit mcap"),  # for the help
        ("jointctl.tools.verbs.run, jointctl.tools.verbs.sweep",  # before a motion starts
         "scipy.optimize scipy.interpolate scipy.stats matplotlib"),
    ],
)  # fmt: skip
def test_what_is_waited_for_imports_nothing_heavy(modules: str, slow: str) -> None:
    code = f"import sys, {modules}; print(sorted({set(slow.split())} & set(sys.modules)))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout == "[]\n"


STOP = """
import importlib, sys
from pathlib import Path
from jointctl.tools.verbs import main
stop = importlib.import_module("jointctl.tools.verbs.stop")
def switch_off(targets, output):
    import jointctl.drivers.canopen.switch_off, jointctl.drivers.can.open
    print(sorted({"numba", "scipy", "mcap", "matplotlib", "tomlkit"} & set(sys.modules)))
    return ["off"]
stop._switch_off = switch_off
sys.exit(stop.stop(Path(sys.argv[1]), main.Output(quiet=True)))
"""


@pytest.mark.parametrize(
    ("base", "place"), [("virtual", 'channel = "virtual0"'), ("elmo_serial", 'port = "/dev/ttyUSB0"')]
)
def test_nothing_that_takes_its_time_is_loaded_before_the_drive_is_stopped(
    tmp_path: Path, base: str, place: str
) -> None:
    own = place.replace("0", f"-{os.getpid()}")  # a stop ends the programs of other tests there
    path = str(edited_file(tmp_path, (place, own), base=base))
    shown = subprocess.run([sys.executable, "-c", STOP, path], capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[0] == "[]"


@pytest.mark.parametrize("unended", ["process 7 cannot be ended", ""])
def test_a_stop_that_could_not_end_the_program_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unended: str
) -> None:
    def end(call: StopCall, *_: object) -> bool:
        call.unended = unended
        return False

    monkeypatch.setattr(StopCall, "end", end)
    stop = importlib.import_module("jointctl.tools.verbs.stop")
    monkeypatch.setattr(stop, "_switch_off", lambda *_: ["switch on disabled"])
    path = edited_file(tmp_path, ('channel = "virtual0"', f'channel = "virtual-{os.getpid()}"'), base="virtual")
    expected = pytest.raises(BusError, match="7 cannot be ended; the drive may be enabled again")
    with expected if unended else nullcontext():
        assert stop.stop(path, QUIET) == 0


@pytest.mark.parametrize("shipped", ["virtual", "precise", "elmo_serial.toml"])
def test_new_copies_a_shipped_configuration_that_loads(tmp_path: Path, shipped: str) -> None:
    assert new(tmp_path / "mine.toml", QUIET, shipped=shipped) == 0
    assert load_config(tmp_path / "mine.toml").log.folder == "runs"


def test_new_counts_what_is_to_be_filled_in(tmp_path: Path) -> None:
    new(tmp_path / "mine.toml", QUIET, shipped="elmo_gold_can")
    tomllib.loads((tmp_path / "mine.toml").read_text())
    with pytest.raises(ConfigurationError, match="missing"):
        load_config(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("name", "shipped", "error", "match"),
    [
        ("there.toml", "virtual", DataError, "exists already"),
        ("none/mine.toml", "virtual", DataError, "cannot be written: No such file or directory"),
        ("mine.txt", "virtual", DataError, "must end in .toml"),
        ("mine.toml", "nothing", ConfigurationError, "no such file"),
    ],
)
def test_new_refuses(tmp_path: Path, name: str, shipped: str, error: type[Exception], match: str) -> None:
    (tmp_path / "there.toml").write_text("mine")
    with pytest.raises(error, match=match):
        new(tmp_path / name, QUIET, shipped=shipped)
    assert (tmp_path / "there.toml").read_text() == "mine"


# --- Names of shipped configurations wherever one is asked for ---
@pytest.fixture
def data(tmp_path: Path) -> Path:
    sweep = synthetic_sweep()
    path = tmp_path / "sweep.csv"
    rows = zip(sweep.velocity_radps, sweep.motor_torque_Nm, strict=True)
    path.write_text("velocity,torque\n" + "".join(f"{velocity},{torque}\n" for velocity, torque in rows))
    return path


FOREIGN = ("--velocity-column", "velocity", "--torque-column", "torque", "--velocity-unit", "rad/s", "--side", "joint",
           "--torque-side", "motor", "--ratio", "121")  # fmt: skip


def test_validate_and_identify_take_the_name_of_a_shipped_configuration(data: Path) -> None:
    found = CliRunner().invoke(app, ["validate", "paper", str(data), *FOREIGN])
    assert found.exception is None or isinstance(found.exception, SystemExit)
    assert found.exit_code == 0
    assert data.with_suffix(".validation.png").exists()
    swarm = ("--particles", "40", "--iterations", "40", "--folds", "2")
    assert CliRunner().invoke(app, ["identify", str(data), "--config", "paper", *FOREIGN, *swarm]).exit_code == 0


# --- What the parser of the command line does not understand: one line and a hint, exit code 2 ---
@pytest.mark.parametrize(
    ("words", "parts", "verb"),
    [
        (["rum", "virtual"], ["rum"], ""),
        (["run"], ["CONFIG"], "run "),
        (["run", "virtual", "-t", "200"], ["--target", "127"], "run "),
        (["run", "virtual", "--frobnicate"], ["--frobnicate"], "run "),
        (["run", "virtual", "extra"], ["extra"], "run "),
        (["demo", "--duration", "x"], ["--duration"], "demo "),
        (["log", "foo"], ["foo"], "log "),
        (["fault-campaign", "--scenario", "-1"], ["--scenario", "0"], "fault-campaign "),
        (["fault-campaign", "--scenario", str(2**31)], ["--scenario", str(2**31 - 1)], "fault-campaign "),
        (["fault-campaign", "--seed", "-1"], ["--seed", "0"], "fault-campaign "),
    ],
)
def test_it_is_one_line_and_a_hint(
    jointctl: Jointctl, monkeypatch: pytest.MonkeyPatch, words: list[str], parts: list[str], verb: str
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    done = jointctl(*words)
    done.refused(2, *parts)
    error, hint = done.err.splitlines()
    assert error.startswith("error: ")
    assert hint.startswith("hint: `")
    assert f"{verb}--help` shows what there is" in hint


@pytest.mark.parametrize("words", [[], ["log"], ["params"]])
def test_without_a_verb_the_help_is_shown_and_asking_for_it_is_no_error(jointctl: Jointctl, words: list[str]) -> None:
    done = jointctl(*words)
    assert (done.code, "Usage:" in done.out, done.err) == (2, True, "")
    done = jointctl(*words, "--help")
    assert (done.code, "Usage:" in done.out, done.err) == (0, True, "")


# --- What is refused before another process is started, by each verb with its own exit code ---
READING = ("scan", "info", "monitor")


@pytest.mark.parametrize(
    ("words", "changes", "code", "parts"),
    [
        ("run nowhere.toml -y", {}, 3, ["nowhere.toml", "no such file", "virtual"]),
        ("run joint.toml -y", {"drive__eds": "nowhere.eds"}, 3, ["drive.eds", "nowhere.eds"]),
        ("run joint.toml -y -b 250000", {}, 3,
         ["loop.rate_Hz (=1000)", "bus.bitrate_bitps (=250000)", "285 bits", "114%", "80%"]),
        ("run joint.toml -y -i slcan -c /dev/ttyJC_none", {**SLOW_LOOP, "log__frames": True}, 3,
         ["log.frames", "slcan"]),
        ("run joint.toml -y --foxglove 0.0.0.0:8765", {}, 2,
         ["--foxglove (=0.0.0.0:8765) must be on the loopback address"]),
        ("run joint.toml -y --foxglove=nonsense", {}, 2, ["--foxglove (=nonsense) must be HOST:PORT"]),
        ("run joint.toml -y --ros2 500", {}, 2, ["--ros2"]),
        ("run joint.toml -y --allow-remote", {}, 2, ["--allow-remote goes with --foxglove or --ros2"]),
        ("run joint.toml -y --ros2-listen tcp/0.0.0.0:7448", {}, 2, ["--ros2-listen goes with --ros2"]),
        ("run joint.toml -y --ros2 --ros2-listen 7448", {}, 2, ["--ros2-listen (=7448) must be an endpoint such as"]),
        ("demo --config joint.toml", {"virtual": None}, 3, ["[virtual]"]),
        ("report no/log.mcap", {}, 8, ["no/log.mcap: no such file"]),
        ("report .", {}, 8, [".: cannot be read: is a folder, not a file"]),
        ("validate joint.toml /", {}, 8, ["/: is a folder, not a file"]),
        ("hil joint.toml", {"bus__channel": "/tmp/a_bus"}, 4, ["channel (='/tmp/a_bus') must consist of letters"]),
        ("hil joint.toml", {"drive__eds": "poor.eds"}, 3, ["poor.eds", "describes no object"]),
        *((verb, {}, 3, ["which bus", "-i socketcan -c can0"]) for verb in READING),
        *((f"{verb} -i jointctl -c nobody-here -t 1", {}, 4, ["no virtual bus"]) for verb in READING),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(
    jointctl: Jointctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, changes: dict[str, Any], code: int,
    parts: list[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poor.eds").write_text("[6077\nParameterName=torque\n")
    written(tmp_path / "joint.toml", **changes)
    jointctl(*words.split()).refused(code, *parts)


def test_every_problem_of_a_configuration_has_a_line(
    jointctl: Jointctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is wrong how: tests/unit/configuration/test_config.py."""
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "joint.toml", control__kpp=3.0, drive__node=128)
    done = jointctl("run", "joint.toml", "-y")
    assert done.code == 3
    assert done.err.splitlines() == [
        "error: joint.toml: drive.node (=128) must be in [1..127]",
        "error: joint.toml: control.kpp is not a known key: did you mean kp?",
    ]


# --- A stop waits for what is about to control a bus ---
CONTROLS = re.compile(r"import .*\b(in_control|control_of|carried_out|tracked)\b")


@pytest.mark.parametrize(
    ("words", "hurries"), [(["stop", "my_joint.toml"], True), (["run", "stop"], False), ([], False)]
)
@pytest.mark.parametrize("error", [None, PermissionError(1, "Operation not permitted")])
def test_a_stop_goes_before_ordinary_programs_where_that_is_allowed(
    monkeypatch: pytest.MonkeyPatch, words: list[str], hurries: bool, error: OSError | None
) -> None:
    asked: list[tuple[int, int]] = []

    def set_scheduler(pid: int, policy: int, parameters: os.sched_param) -> None:
        asked.append((policy, parameters.sched_priority))
        if error is not None:
            raise error

    monkeypatch.setattr(os, "sched_setscheduler", set_scheduler)
    monkeypatch.setattr("sys.argv", ["jointctl", *words])
    start._hurry()
    assert asked == ([(os.SCHED_RR, 1)] if hurries else [])


def test_every_verb_that_controls_a_bus_is_known_before_its_imports() -> None:
    """Else SIGTERM, or a terminal that is closed, ends it without a word while it is starting."""
    sources = Path(run_verb.__file__).parent.glob("*.py")
    controlling = {path.stem.replace("_", "-") for path in sources if CONTROLS.search(path.read_text())}
    controlling -= {"params", "doctor"}  # with some of their words only
    assert controlling == start._CONTROLLING
    assert all(start.will_control({verb, "my_joint.toml"}) for verb in controlling)
    assert not any(start.will_control({verb, "my_joint.toml", "--lockstep"}) for verb in controlling)


@pytest.mark.parametrize(
    ("words", "controls"),
    [
        ("doctor j.toml --motion -y", True), ("doctor j.toml", False), ("params restore d.dcf j.toml", True),
        ("params dump j.toml", False), ("stop j.toml", False), ("check j.toml", False), ("hil j.toml", False),
    ],
)  # fmt: skip
def test_a_command_controls_a_bus_or_not(words: str, controls: bool) -> None:
    assert start.will_control(set(words.split())) is controls


# --- What the shell completes, how a flag is shown, quantities with a unit ---
def completed(words: str, folder: Path) -> list[str]:
    """What bash is given for the last word, by the protocol of the script that `--show-completion` prints."""
    code = "import sys; sys.argv[0] = 'jointctl'; from jointctl.tools.verbs.start import main; main()"
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_JOINTCTL_COMPLETE": "complete_bash"}
    command = [sys.executable, "-P", "-c", code]
    shown = subprocess.run(
        command, capture_output=True, text=True, timeout=60.0, cwd=folder, env={**os.environ, **asked}
    )
    assert shown.stderr == ""
    return shown.stdout.split()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("jointctl run pa", ["paper", "pallet.toml"]),
        ("jointctl check cell/pal", ["cell/pallet_2.toml"]),
        ("jointctl check cell", []),  # a folder is the shell's own matter
        ("jointctl info -i virtual vir", ["virtual"]),
        ("jointctl new mine.toml --from elmo_s", ["elmo_serial"]),
        ("jointctl identify data.csv --into pa", ["pallet.toml"]),
        ("jointctl study --controller pre", ["precise"]),
        ("jointctl scope pa", ["palletising.mcap", "paper", "pallet.toml"]),
    ],
)
def test_the_shell_completes_configurations_and_files_of_joints(
    tmp_path: Path, words: str, expected: list[str]
) -> None:
    (tmp_path / "cell").mkdir()
    for name in ("pallet.toml", "cell/pallet_2.toml", "palletising.mcap", "pallet.csv"):
        (tmp_path / name).touch()
    assert completed(words, tmp_path) == expected


@pytest.mark.parametrize(("text", "delay_s"), [("1.5 ms", 0.0015), ("1500us", 0.0015), ("0.0015", 0.0015)])
def test_an_option_takes_a_quantity_with_its_unit(jointctl: Jointctl, text: str, delay_s: float) -> None:
    done = jointctl("check", "virtual", "--json", "--delay", text)
    assert json.loads(done.out)["assumptions"][1]["value"] == pytest.approx(delay_s)
    assert done.err == ("" if text == "0.0015" else f"{text} is read as 0.0015 s\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *((text, ("'--delay'",)) for text in ("1.5 rpm", "1.5 m", "-1 ms")),
        ("1,5 ms", ("(=1,5 ms)", "; with a decimal point: 1.5 ms\n")),
    ],
)
def test_what_is_no_such_quantity_is_refused(jointctl: Jointctl, text: str, words: tuple[str, ...]) -> None:
    done = jointctl("check", "virtual", "--delay", text)
    assert done.code == 2
    assert [word for word in words if word not in done.err] == []


# --- Options that stand in a dataclass reach the verb as one object; the command line shows them one by one ---
@dataclass(frozen=True)
class Place:
    name: Annotated[str | None, typer.Option("-n", "--name")] = None
    number: Annotated[int, typer.Option("--number", min=1)] = 3


taken: list[Any] = []
two_verbs = typer.Typer(add_completion=False)


@two_verbs.command()
@grouped
def verb(*, first: Annotated[str, typer.Argument()] = "a", place: Place, last: bool = False) -> None:
    """What it does."""
    taken.append((first, place, last))


@pytest.mark.parametrize(("arguments", "expected"), [
    ([], ("a", Place(None, 3), False)),
    (["b", "-n", "here", "--last"], ("b", Place("here", 3), True)),
    (["--number", "7"], ("a", Place(None, 7), False)),
])  # fmt: skip
def test_a_group_reaches_the_verb_as_one_object(arguments: list[str], expected: tuple[str, Place, bool]) -> None:
    taken.clear()
    assert CliRunner().invoke(two_verbs, arguments).exit_code == 0
    assert taken == [expected]


def test_the_command_line_shows_the_options_of_a_group_in_their_place() -> None:
    command = typer.main.get_command(two_verbs)
    assert [parameter.name for parameter in command.params] == ["first", "name", "number", "last"]
    assert command.help == "What it does."
    assert CliRunner().invoke(two_verbs, ["--number", "0"]).exit_code == 2  # its limits hold


# --- What each verb does with `-p PORT`, and with options and configurations of the other kind of drive ---
SERIAL, CAN = Path("elmo_serial"), Path("virtual")


@pytest.mark.parametrize("verb", ["doctor", "info", "monitor", "sweep", "run", "stop", "clear-fault"])
def test_these_verbs_take_a_port(verb: str) -> None:
    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    assert "-p" in [name for parameter in commands[verb].params for name in parameter.opts]


def test_the_port_replaces_the_one_of_the_file() -> None:
    assert elmo_section(loaded(SERIAL, BusOptions(port="/dev/ttyUSB7"))).port == "/dev/ttyUSB7"
    assert canopen_section(loaded(CAN, CanOptions(target=9))).node == 9


@pytest.mark.parametrize(
    ("path", "options", "words"),
    [
        (SERIAL, {"interface": "socketcan"}, "socketcan names a CAN bus, the drive is on a serial port: use -p"),
        (SERIAL, {"channel": "can0"}, "can0 names a CAN bus, the drive is on a serial port: use -p"),
        (SERIAL, {"bitrate": 500_000}, "500000 names a CAN bus, the drive is on a serial port: use -p"),
        (SERIAL, {"target": 3}, 'drive.kind (=elmo_serial) must be "canopen" here'),
        (CAN, {"port": "/dev/ttyUSB7"}, 'drive.kind (=canopen) must be "elmo_serial" for a serial port'),
    ],
)
def test_options_of_the_other_kind_are_refused(path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        loaded(path, BusOptions(**options))
    assert words in caught.value.message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("hil", "elmo_serial", "-p", "/dev/ttyUSB0"), "--port (=/dev/ttyUSB0) must be absent for hil"),
        (("hil", "elmo_serial", "--timing"), "--timing is for a CAN bus"),
        (("hil", "elmo_serial", "-c", "vcan"), "vcan names a CAN bus"),
        (("hil", "paper", "--serial"), 'drive.kind (=canopen) must be "elmo_serial"'),
        (("hil", "virtual", "--link", "tty"), 'drive.kind (=canopen) must be "elmo_serial"'),
        (("demo", "--duration=nan"), "duration"),
        (("demo", "--duration=1e9"), "--duration (=1e+09) must be in [0.1.."),
        (("demo", "--duration=0.05"), "duration"),
        (("demo", "--config", "elmo_serial"), "demo"),
    ],
)
def test_what_would_not_be_done_is_refused(
    monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.setattr(child_process, "own_virtual_joint", lambda *_: pytest.fail("started"))
    found = CliRunner().invoke(app, arguments)
    assert words in (found.exception.message if isinstance(found.exception, ConfigurationError) else found.output)
    assert found.exit_code != 0


def test_its_twin_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[Any] = []

    def stand_in(_: Any, config: Any, output: Any, options: ServeOptions) -> int:
        served.append((config.drive.kind, options))
        return 0

    monkeypatch.setattr(ElmoBench, "serve", stand_in)
    assert CliRunner().invoke(app, ["hil", "--serial", "--link", "tty"]).exit_code == 0
    assert served == [("elmo_serial", ServeOptions(serial=True, link="tty"))]

"""Configuration files: what is shipped loads, what is wrong is named in one line; wrong constants, serial drives."""

from __future__ import annotations

import math
import re
from io import StringIO
from pathlib import Path
from typing import Annotated, Any

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from docs.reference import models_in, rows_of, sections_of_drives
from jointctl.drivers.elmo.dialogue import motor_fault_text
from jointctl.drivers.errors import ConfigurationError, MarginError
from jointctl.firmware_py.states import Fault
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.configuration.canopen import canopen_section, eds_path
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.elmo import elmo_section, serial_line_share
from jointctl.tools.configuration.load import load_config, moved, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.session.elmo_drive import SERIAL_TEXTS
from jointctl.tools.session.session_drive import session_drive
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.sweeping.plan import constant_remarks, recorded_limits, refuse_constants
from jointctl.tools.verbs.sweep import sweep
from tests.configurations import VIRTUAL, edited_file, load, problems, replaced, shipped, written
from tests.sessions import constants_of

# --- Configuration files: what is shipped loads, what is wrong is named in one line ---
UNIT = " (the unit is part of the key)"


@pytest.mark.parametrize("name", ["virtual", "paper"])
def test_the_shipped_virtual_configurations_load(name: str) -> None:
    config = load_config(shipped_config(name))
    assert eds_path(config).name == "virtual_joint.eds"
    assert config.text == shipped_config(name).read_text()


def test_the_elmo_configuration_refuses_to_load_until_it_is_filled_in(tmp_path: Path) -> None:
    text = shipped_config("elmo_gold_can").read_text()
    marked = set(re.findall(r"^# (\w+) = .*# FILL IN(?! if)", text, re.M))
    lines = problems(tmp_path, "#", "#", text)
    assert {x.removesuffix(" is missing").split(".")[1] for x in lines} == marked
    (tmp_path / "elmo_gold.eds").write_text("")
    filled = re.sub(r"^# (\w+ = .*# FILL IN)", r"\1", text, flags=re.M)
    config = load(tmp_path, text=filled)
    assert config.bus.interface == "socketcan"
    assert eds_path(config) == tmp_path / "elmo_gold.eds"


def test_the_smallest_number_can_be_computed_with(tmp_path: Path) -> None:
    """Below it a margin would be an error of the linear algebra, above it is one."""
    path = written(tmp_path / "joint.toml", joint__inertia_kgm2=1e-18)
    with pytest.raises(MarginError, match="unstable"):
        require_margin(load_config(path))
    soft = shipped("realistic", reducer__motor_inertia_kgm2=1e-18)  # one of 2e-30 kg m2 ended in the solver
    with pytest.raises(MarginError):
        require_margin(soft)


@pytest.mark.parametrize(
    ("pattern", "line", "expected"),
    [
        ("rate_Hz = .*", "rate_Hz = 99.9", "loop.rate_Hz (=99.9) must be in [100..4000]"),
        ("rate_Hz = .*", "rate_Hz = 4001", "loop.rate_Hz (=4001) must be in [100..4000]"),
        ("rate_Hz = .*", "rate_Hz = 333", "loop.rate_Hz (=333) has no 60C2 value: the period must be 1..255 x 10^n s"),
        ("rate_Hz = .*", "rate_Hz = nan", "loop.rate_Hz (=nan) must be finite"),
        ("rate_Hz = .*", 'rate_Hz = "1000"', "loop.rate_Hz (=1000) must be a number"),
        ("rate_Hz = .*", "rate_Hz = true", "loop.rate_Hz (=true) must be a number"),
        ("inertia_kgm2 = .*", "inertia_kgm2 = 0.0", "joint.inertia_kgm2 (=0) must be in (0..10000]"),
        ("inertia_kgm2 = .*", "inertia_kgm2 = 1e-19", "joint.inertia_kgm2 (=1e-19) must not be nearer to 0 than 1e-18"),
        ("node = .*", "node = 128", "drive.node (=128) must be in [1..127]"),
        ("node = .*", "node = 1.0", "drive.node (=1.0) must be a whole number"),
        ("counts_per_turn = .*", "counts_per_turn = 1e5", "encoder.counts_per_turn (=100000.0) must be a whole number"),
        ("node = .*", "", "drive.node is missing"),
        ("direction = .*", "direction = 0", "encoder.direction (=0) must be 1 or -1"),
        ("mode = .*", 'mode = "pp"', "drive.mode (=pp) must be one of 'cst', 'tq', 'auto', 'csp' or 'csv'"),
        ("approach_s = .*", 'approach_s = "slow"', 'sequence.approach_s (=slow) must be "auto" or in [0..600]'),
        ("lyapunov_q = .*", "lyapunov_q = [1.0, 2.0, 3.0]",
         "control.lyapunov_q (=[1.0, 2.0, 3.0]) must be 1 or 2 numbers, each in (0..1e+12]"),
        ("widths = .*", "widths = 0.0", "control.widths (=0) must be 1 or 15 widths, each in (0..10000]"),
        ("inertia_kgm2", "inertia", "joint.inertia is not a known key: use inertia_kgm2 (the unit is part of the key)"),
        ("velocity_max_radps", "velocity_max_degps", f"limits.velocity_max_degps is not a known key:"
         f" use velocity_max_radps{UNIT}"),
        ("amplitude_rad", "amplitud_rad", "trajectory.amplitud_rad is not a known key: did you mean amplitude_rad?"),
        (r"\[limits\]", "[limit]", "[limit] is not a known section: did you mean limits?"),
        ("kind = \"sine\"", 'kind = "square"', "trajectory.kind (=square) must be one of 'sine', 'min_jerk',"
         " 'trapezoid', 'table', 'hold'"),
        ("eds = .*", 'eds = "none.eds"', "drive.eds (=none.eds) must name a file beside the configuration or"
         " a shipped one"),
    ],
)  # fmt: skip
def test_a_wrong_value_or_key_is_named_with_what_is_allowed(
    tmp_path: Path, pattern: str, line: str, expected: str
) -> None:
    assert expected in problems(tmp_path, pattern, line)


def models() -> list[type[BaseModel]]:
    """Every section."""
    found: dict[type[BaseModel], None] = {}
    left: list[type[BaseModel]] = [Config, *sections_of_drives()]
    while left:
        model = left.pop()
        if model not in found:
            found[model] = None
            left += [inner for field in model.model_fields.values() for inner in models_in(field.annotation)]
    return list(found)


RANGE = re.compile(r"(?P<open>[\[(])(?P<low>.+?)\.\.(?P<high>.+)\]")
RANGED = [
    pytest.param(model, row[0].strip("`"), row[2], found, id=f"{model.__name__}.{row[0]}")
    for model in models()
    for row in rows_of(model)
    if (found := RANGE.fullmatch(row[3]))
]


@pytest.mark.parametrize(("model", "key", "kind", "allowed"), RANGED)
def test_the_range_that_the_reference_names_is_the_one_that_is_checked(
    model: type[BaseModel], key: str, kind: str, allowed: re.Match[str]
) -> None:
    field = model.model_fields[key]
    type_: Any = Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
    take = TypeAdapter(type_, config=model.model_config).validate_python
    low, high = (float(allowed[end]) for end in ("low", "high"))
    less, more = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
    if "whole" in kind:  # six digits of it are shown
        less, low, high, more = int(low * 1.00001 - 1), int(low), int(high * 0.99999 + 0.5), int(high * 1.00001 + 1)
    assert take(high) == high
    if allowed["open"] == "[":
        assert take(low) == low
    for outside in (less, more, *([] if allowed["open"] == "[" else [low])):
        with pytest.raises(ValidationError, match=re.escape(f"must be in {allowed[0]}")):
            take(outside)


def test_several_problems_are_told_at_once(tmp_path: Path) -> None:
    text = replaced(VIRTUAL, "kp = .*", "kp = -1.0")
    assert len(problems(tmp_path, "node = .*", "node = 0", text)) == 2
    assert len(problems(tmp_path, "node = .*", "colour = 1")) == 2  # unknown, and the node is missing


@pytest.mark.parametrize(
    ("pattern", "line", "expected"),
    [
        ("position_min_rad = .*", "position_min_rad = 0.7", "limits.position_min_rad (=0.7) must be less than"),
        ("position_max_rad = .*", "position_max_rad = 0.3499", "trajectory: highest position (=0.35 rad)"),
        ("position_min_rad = .*", "position_min_rad = -0.3499", "trajectory: lowest position (=-0.35 rad)"),
        ("velocity_max_radps = .*", "velocity_max_radps = 0.2199", "trajectory: peak speed (=0.219911 rad/s)"),
        ("position_jump_max_rad = .*", "position_jump_max_rad = 0.0009", "limits.position_jump_max_rad (=0.0009)"),
        ("counts_per_turn = .*", "counts_per_turn = 2931", "limits.velocity_max_radps (=1) must be more than 1, what"),
        ("sample_age_max_s = .*", "sample_age_max_s = 0.0009", "limits.sample_age_max_s (=0.0009)"),
        ("velocity_cutoff_Hz = .*", "velocity_cutoff_Hz = 500.0", "control.velocity_cutoff_Hz (=500)"),
        ("zero_rule = .*", 'zero_rule = "linear"', "control.zero_band_radps (=0)"),
        ("zero_rule = .*", 'zero_rule = "zero"\nvelocity_filter = "kalman"', "control.velocity_filter (=kalman) needs"),
        ("zero_rule = .*", 'zero_rule = "zero"\nobserver_paired = true', "control.observer_paired (=true) needs"),
        ("knee = 40.0", "knee = 201.0", "friction.positive.knee (=201) and max (=200)"),
        ("torque_max_Nm = .*", "torque_max_Nm = 60.51", "limits.torque_max_Nm (=60.51) must be in (0..60.5]"),
        ("stop_timeout_s = .*", "stop_timeout_s = 0.5", "sequence.stop_timeout_s (=0.5)"),
        ("node = .*", "node = 126", "drive.master_node (=126) must differ"),
        # a key in the wrong unit, or misspelt, is not reported as missing besides
        ("rate_Hz = .*", "rate_kHz = 1.0", f"loop.rate_kHz is not a known key: use rate_Hz{UNIT}"),
        ("amplitude_rad = .*", "amplitude_deg = 20.0", "trajectory.amplitude_deg is not a known key"),
        ("feed_forward = .*", 'feed_foward = "none"', "control.feed_foward is not a known key: did you mean feed_f"),
    ],
)
def test_a_contradiction_or_an_unknown_key_is_one_line(tmp_path: Path, pattern: str, line: str, expected: str) -> None:
    found = problems(tmp_path, pattern, line)
    assert len(found) == 1
    assert found[0].startswith(expected)


@pytest.mark.parametrize(
    ("pattern", "line"),
    [
        ("position_max_rad = .*", "position_max_rad = 0.35"), ("position_min_rad = .*", "position_min_rad = -0.35"),
        ("velocity_max_radps = .*", "velocity_max_radps = 0.21992"),
        ("position_jump_max_rad = .*", "position_jump_max_rad = 0.001"),
        ("counts_per_turn = .*", "counts_per_turn = 2932"), ("sample_age_max_s = .*", "sample_age_max_s = 0.001"),
        ("velocity_cutoff_Hz = .*", "velocity_cutoff_Hz = 499.9"), ("knee = 40.0", "knee = 200.0"),
        ("torque_max_Nm = .*", "torque_max_Nm = 60.5"), ("stop_timeout_s = .*", "stop_timeout_s = 0.501"),
        ("node = .*", "node = 127"), ("command_delay_s = .*", "command_delay_s = 0.05"),
    ],
)  # fmt: skip
def test_values_just_inside_are_accepted(tmp_path: Path, pattern: str, line: str) -> None:
    load(tmp_path, pattern, line)


def test_a_file_may_begin_with_the_mark_of_an_editor_and_end_its_lines_with_two_characters(tmp_path: Path) -> None:
    shipped = shipped_config("virtual")
    path = tmp_path / "joint.toml"
    path.write_bytes(b"\xef\xbb\xbf" + shipped.read_text().replace("\n", "\r\n").encode())
    assert load_config(path).limits == load_config(shipped).limits


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, r"joint\.toml: no such file .*virtual"),
        (b"[bus]\n\xff\xfe", "byte 6 is not UTF-8"),
        (b"[bus]\nchannel = \n", r"not valid TOML: .*line 2, column 11\): channel =$"),
        (b"[joint]\ninertia_kgm2 = 0,5  # by CAD\n", r"inertia_kgm2 = 0,5 # by CAD; with a decimal point: 0\.5$"),
        (b"bus = 3\n", r"bus \(=3\) must be a section: \[bus\]"),
    ],
)
def test_files_that_are_no_configuration_give_one_line(tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / "joint.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=words):
        load_config(path)
    with pytest.raises(ConfigurationError, match="is a folder"):
        load_config(tmp_path)


def test_flag_beats_environment_beats_file() -> None:
    config = load_config(shipped_config("virtual"))
    environ = {"CAN_INTERFACE": "socketcan", "CAN_CHANNEL": "can7", "CAN_BITRATE": "500000"}
    assert moved(config, GivenPlace(), {}).bus == config.bus
    bus = moved(config, GivenPlace(), environ).bus
    assert (bus.interface, bus.channel, bus.bitrate_bitps) == ("socketcan", "can7", 500_000)
    bus = moved(config, GivenPlace("pcan", "usb1", 250_000), environ).bus
    assert (bus.interface, bus.channel, bus.bitrate_bitps) == ("pcan", "usb1", 250_000)
    changed = moved(config, GivenPlace(), environ)
    assert changed.path == config.path
    with pytest.raises(ConfigurationError, match=r"environment: CAN_BITRATE \(=fast\)"):
        moved(config, GivenPlace(), {"CAN_BITRATE": "fast"})
    with pytest.raises(
        ConfigurationError, match=r"command line: bus.bitrate_bitps \(=1\) must be in \[10000..1e\+06\]"
    ):
        moved(config, GivenPlace(bitrate=1), {})


@pytest.mark.parametrize(
    ("node", "words"),
    [(0, r"node \(=0\) must be"), (128, "in .1..127."), (1.5, "whole number"), (True, "whole number"),
     (126, "drive.master_node .=126. must differ from drive.node")],
)  # fmt: skip
def test_a_node_that_is_given_is_checked_as_one_of_the_file(node: Any, words: str) -> None:
    with pytest.raises(ConfigurationError, match=f"command line: .*{words}"):
        moved(load_config(shipped_config("virtual")), GivenPlace(node=node), {})


def test_a_node_that_is_given_is_taken_up_to_the_last_one() -> None:
    for node in (1, 125, 127):
        assert canopen_section(moved(load_config(shipped_config("virtual")), GivenPlace(node=node), {})).node == node


def test_a_configuration_cannot_be_changed() -> None:
    config = load_config(shipped_config("virtual"))
    with pytest.raises(ValueError, match="frozen"):
        config.limits.torque_max_Nm = 1000.0  # type: ignore[misc]


# --- The keys of the limit-cycle monitor: defaults, what they become in the records, what is refused ---
ANCHOR = "standstill_radps = .*"


def added(line: str) -> str:
    return f"standstill_radps = 0.02\n{line}"


@pytest.mark.parametrize("name", ["virtual", "paper", "precise", "realistic", "sweep_virtual"])
def test_the_monitor_is_on_in_every_file_that_does_not_name_it(name: str) -> None:
    config = load_config(shipped_config(name))
    axis = constants_of(config)[0]
    swing = axis.limits.swing
    assert swing.torque_Nm == 60.0  # half of -60..60
    assert swing.error_rad == pytest.approx(0.05 * config.limits.following_error_max_rad)
    assert swing.slowest_cycles == 300
    assert swing.noise_Nm == pytest.approx(12.0)
    assert swing.noise_gain == pytest.approx(1.0 / 250.0)
    assert axis.law.learning.growth == (1.05 if config.control.learning is not None else 0.0)


def test_each_key_reaches_its_record(tmp_path: Path) -> None:
    keys = ("swing_torque_share = 0.75", "swing_error_share = 0.1", "swing_slowest_s = 0.5", "torque_noise_share = 0.1")
    axis = constants_of(load(tmp_path, ANCHOR, added("\n".join(keys))))[0]
    swing = axis.limits.swing
    assert (swing.torque_Nm, swing.slowest_cycles) == (90.0, 500)
    assert (swing.error_rad, swing.noise_Nm) == (pytest.approx(0.005), pytest.approx(6.0))
    text = shipped_config("precise").read_text()
    axis = constants_of(load(tmp_path, ANCHOR, added("learning_growth = 1.5"), text))[0]
    assert axis.law.learning.growth == 1.5


def test_noise_is_also_what_comes_near_the_rate_limit(tmp_path: Path) -> None:
    """2 Nm in a cycle are allowed: 12 Nm would never come."""
    axis = constants_of(load(tmp_path, "torque_rate_max_Nmps = .*", "torque_rate_max_Nmps = 2000.0"))[0]
    assert axis.limits.swing.noise_Nm == pytest.approx(1.2)


@pytest.mark.parametrize(("rate_Hz", "refused"), [(399.0, True), (400.0, False)])
def test_half_a_swing_is_at_least_four_periods(tmp_path: Path, rate_Hz: float, refused: bool) -> None:
    text = VIRTUAL.replace("rate_Hz = 1000.0", f"rate_Hz = {rate_Hz}")
    text = text.replace('mode = "cst"', 'mode = "tq"')  # which needs no 60C2
    if refused:
        (line,) = problems(tmp_path, ANCHOR, added("swing_slowest_s = 0.01"), text)
        assert line.startswith("limits.swing_slowest_s (=0.01) must be at least 4 periods, 0.0100251 s")
    else:
        load(tmp_path, ANCHOR, added("swing_slowest_s = 0.01"), text)


# --- A torque constant that is wrong on purpose, before a sweep: refused, or said ---
def with_constant(torque_constant_NmpA: float) -> Config:
    return shipped("sweep_virtual", joint__torque_constant_NmpA=torque_constant_NmpA)


@pytest.mark.parametrize(
    ("constant", "factor"),
    [(0.1, ""), (0.0801, ""), (0.1249, ""), (0.0799, "0.799"), (0.1251, "1.25"), (0.141, "1.41"), (0.299, "2.99")],
)
def test_doubtful_constants_are_shown_before_the_joint_moves(constant: float, factor: str) -> None:
    config = with_constant(constant)
    refuse_constants(config)
    remarks = " ".join(constant_remarks(config))
    assert (f"is {factor} times drive.rated_torque_Nm (=0.5)" in remarks) == bool(factor) == bool(remarks)
    assert not factor or "rms and sine amplitude" in remarks


@pytest.mark.parametrize("constant", [0.033, 0.301, 1.0])
def test_impossible_constants_are_refused_before_anything_moves(tmp_path: Path, constant: float) -> None:
    output = Output(stdout=StringIO(), stderr=StringIO())
    with pytest.raises(ConfigurationError, match=r"joint.torque_constant_NmpA \(=.* times drive.rated_torque_Nm"):
        sweep(with_constant(constant), output, tmp_path / "data.csv", SweepOptions(lockstep=True, points=4))
    assert list(tmp_path.iterdir()) == []


def test_the_serial_drive_has_no_rated_torque_to_compare_with() -> None:
    config = load_config(shipped_config("elmo_serial"))
    refuse_constants(config)
    assert constant_remarks(config) == []
    assert recorded_limits(config) == {"torque_max_Nm": 60.0, "velocity_max_radps": 1.0}


# The configuration of a serial drive: what is shipped loads and tracks within its margins, what is wrong is named.
SHIPPED = shipped_config("elmo_serial").read_text()


@pytest.fixture
def config() -> Config:
    return load_config(shipped_config("elmo_serial"))


def problem(tmp_path: Path, pattern: str, line: str) -> str:
    with pytest.raises(ConfigurationError) as caught:
        session_drive("elmo_serial").check_rate(load(tmp_path, pattern, line, SHIPPED))
    return caught.value.message


def test_the_shipped_one_loads_and_its_port_is_its_bus(config: Config) -> None:
    drive = elmo_section(config)
    assert (config.bus.interface, config.bus.channel, config.bus.bitrate_bitps) == ("serial", drive.port, 115_200)
    assert 0.5 < serial_line_share(config) < 1.0


@pytest.mark.parametrize(
    ("pattern", "line", "words"),
    [
        ("kind = .*", 'kind = "elmo"', "drive.kind (=elmo) must be one of 'canopen', 'elmo_serial'"),
        ("kind = .*", "", "drive.kind must be one of 'canopen', 'elmo_serial'"),
        ("port = .*", "", "drive.port is missing"),
        ("port = .*", "port = 3", "drive.port (=3) must be a text in quotes"),
        ("baud_rate_bitps = .*", "baud_rate_bitps = 100000", "drive.baud_rate_bitps (=100000) must be one of 9600,"),
        ("baud_rate_bitps = .*", "baud_rate_bitps = 57600", "loop.rate_Hz (=125) must be at most 101 at"),
        ("port = .*", 'prot = "x"', "drive.prot is not a known key: did you mean port?"),
        ("echo = .*", "node = 1", "drive.node is not a known key"),
        ("continuous_current_A = .*", "continuous_current_A = 5.1", "must be at most drive.peak_current_A (=5)"),
        ("torque_max_Nm = .*", "torque_max_Nm = 61", "limits.torque_max_Nm (=61) must be in (0..60.5]"),
        ("dead_man_s = .*", "dead_man_s = 0.11", "must be at most limits.sample_age_max_s (=0.1)"),
        ("dead_man_s = .*", "dead_man_s = 0.006", "must be at least one period"),
        ("counts_parameter = .*", 'counts_parameter = "CA"', 'such as "CA[18]"'),
        ("rate_Hz = .*", "rate_Hz = 9.9", "loop.rate_Hz (=9.9) must be in [10..10000]"),
        (r"\[drive\]", '[bus]\ninterface = "a"\nchannel = "b"\nbitrate_bitps = 20000\n[drive]', "[bus] must be absent"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path: Path, pattern: str, line: str, words: str) -> None:
    assert words in problem(tmp_path, pattern, line)


def test_the_port_can_be_overridden(config: Config) -> None:
    other = moved(config, GivenPlace(port="COM7"))
    assert (elmo_section(other).port, other.bus.channel) == ("COM7", "COM7")
    assert moved(config, GivenPlace()) is config
    assert moved(config, GivenPlace(), {"CAN_CHANNEL": "can3"}) is config


@pytest.mark.parametrize("delay_s", [0.002, 0.004, 0.006])
def test_the_shipped_gains_are_carried_by_the_rate(config: Config, delay_s: float) -> None:
    assert require_margin(config, delay_s).phase_margin_deg > 25.0


def test_changed_is_a_copy_with_these_keys_of_this_file(config: Config) -> None:
    other = config.changed(limits__torque_max_Nm=3.0, limits__standstill_radps=0.2, control={"kp": 9.0}, friction=None)
    assert (other.limits.torque_max_Nm, other.limits.standstill_radps, other.control.kp) == (3.0, 0.2, 9.0)
    assert (other.friction, other.path, other.text) == (None, config.path, config.text)
    assert other.changed(limits=config.limits, control=config.control, friction=config.friction) == config
    for wrong in ({"limits__torque": 3.0}, {"control": {"kp": 9.0, "kq": 1.0}}):
        with pytest.raises(TypeError, match=r"^\[(limits|control)\] has no (torque|kq)$"):
            config.changed(**wrong)


def test_gains_of_a_fast_bus_are_refused_naming_some_that_are_carried(config: Config) -> None:
    control = config.control.model_copy(update={"kp": 784.0, "kv": 56.0, "lyapunov_q": (1800.0,)})
    fast = config.changed(control=control)
    with pytest.raises(MarginError) as caught:
        require_margin(fast, 0.003)
    found = re.search(r"a slower loop: control.kp = ([\d.]+), kv = ([\d.]+), lyapunov_q = ([\d.]+)", caught.value.hint)
    assert found is not None
    kp, kv, q = map(float, found.groups())
    named = control.model_copy(update={"kp": kp, "kv": kv, "lyapunov_q": (q,)})
    # the printed gains are rounded to four digits, which may cost some hundredths of a degree
    least_deg = config.margin.min_phase_margin_deg - 0.2
    assert require_margin(config.changed(control=named, margin__min_phase_margin_deg=least_deg), 0.003).stable


@pytest.mark.parametrize("fault", SERIAL_TEXTS)
def test_every_fault_text_takes_its_value(config: Config, fault: Fault) -> None:
    text = session_drive("elmo_serial").fault_text(config, fault, 144.0, 0x20000)
    assert "{" not in text.happened
    assert motor_fault_text(0x20000) in text.happened


@pytest.mark.parametrize("fault", [fault for fault in Fault if fault is not Fault.NONE])
def test_no_fault_speaks_of_a_watchdog_that_a_serial_drive_has_not(config: Config, fault: Fault) -> None:
    text = session_drive("elmo_serial").fault_text(config, fault, 5.0, 0)
    assert "watchdog" not in f"{text.happened} {text.cause} {text.next_step}"


def test_after_standby_the_user_hears_that_the_drive_held_its_torque(config: Config) -> None:
    text = session_drive("elmo_serial").fault_text(config, Fault.SUSPENDED, 3600.0, 0)
    assert "slept for 3600.0 s" in text.happened
    assert "the drive held its last command in the meantime" in text.happened
    assert "systemd-inhibit" in text.next_step
    canopen = session_drive("canopen").fault_text(load_config(shipped_config("virtual")), Fault.SUSPENDED, 3600.0, 0)
    assert "the drive's watchdog stopped the joint" in canopen.next_step


def test_a_text_with_a_status_shows_it_in_hexadecimal(config: Config) -> None:
    assert "(SR 90h)" in session_drive("elmo_serial").fault_text(config, Fault.DRIVE_FAULT, 144.0, 0).happened
    assert "CANopen" not in session_drive("elmo_serial").fault_text(config, Fault.POSITION_LIMIT, 0.5, 0).happened


def test_an_old_key_is_read_with_a_remark_that_names_the_new_one(tmp_path: Path) -> None:
    old = edited_file(
        tmp_path, ("lyapunov_q = 1800.0", "q = 1800.0"), ("filtered_error_rate = true", "matched_filter = true")
    )
    config, shipped_one = load_config(old), load_config(shipped_config("virtual"))
    assert config.control == shipped_one.control
    assert [remark.split(";")[0] for remark in config.remarks] == [
        "control.q is called control.lyapunov_q now",
        "control.matched_filter is called control.filtered_error_rate now",
    ]
    assert shipped_one.remarks == ()


def test_an_old_key_beside_its_new_one_is_refused(tmp_path: Path) -> None:
    both = edited_file(tmp_path, ("lyapunov_q = 1800.0", "lyapunov_q = 1800.0\nq = 1800.0"))
    with pytest.raises(ConfigurationError, match=r"control\.q is not a known key"):
        load_config(both)


@pytest.mark.parametrize(
    ("name", "hint"),
    [("virutal", "did you mean virtual?"), ("precice", "did you mean precise?"),
     ("mien.toml", "did you mean mine.toml?"), ("elmo_serail", "did you mean elmo_serial?"),
     ("qqq", "shipped configurations: ")],
)  # fmt: skip
def test_a_name_that_is_spelt_alike_is_suggested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, hint: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text("")
    with pytest.raises(ConfigurationError, match="no such file") as refused:
        load_config(name)
    assert refused.value.hint.startswith(hint)


def test_a_file_of_another_folder_is_suggested_with_it(tmp_path: Path) -> None:
    (tmp_path / "elbow.toml").write_text("")
    with pytest.raises(ConfigurationError) as refused:
        load_config(tmp_path / "elbwo.toml")
    assert refused.value.hint == f"did you mean {tmp_path / 'elbow.toml'}?"

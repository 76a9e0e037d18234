"""Configuration files: what is shipped loads, what is wrong is named in one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.load import load_config, shipped_config, with_bus_overrides
from tests.unit.configuration.edited_config import VIRTUAL, load, problems, replaced

UNIT = " (the unit is part of the key)"


@pytest.mark.parametrize("name", ["virtual", "paper"])
def test_the_shipped_virtual_configurations_load(name: str) -> None:
    config = load_config(shipped_config(name))
    assert config.eds_path.name == "virtual_joint.eds"
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
    assert config.eds_path == tmp_path / "elmo_gold.eds"


@pytest.mark.parametrize(
    ("pattern", "line", "expected"),
    [
        ("rate_Hz = .*", "rate_Hz = 99.9", "loop.rate_Hz (=99.9) must be in [100..4000]"),
        ("rate_Hz = .*", "rate_Hz = 4001", "loop.rate_Hz (=4001) must be in [100..4000]"),
        ("rate_Hz = .*", "rate_Hz = nan", "loop.rate_Hz (=nan) must be finite"),
        ("rate_Hz = .*", 'rate_Hz = "1000"', "loop.rate_Hz (=1000) must be a number"),
        ("rate_Hz = .*", "rate_Hz = true", "loop.rate_Hz (=True) must be a number"),
        ("inertia_kgm2 = .*", "inertia_kgm2 = 0.0", "joint.inertia_kgm2 (=0) must be in (0..10000]"),
        ("node = .*", "node = 128", "drive.node (=128) must be in [1..127]"),
        ("node = .*", "node = 1.0", "drive.node (=1) must be a whole number"),
        ("node = .*", "", "drive.node is missing"),
        ("direction = .*", "direction = 0", "encoder.direction (=0) must be 1 or -1"),
        ("mode = .*", 'mode = "csp"', "drive.mode (=csp) must be one of 'cst', 'tq' or 'auto'"),
        ("approach_s = .*", 'approach_s = "slow"', 'sequence.approach_s (=slow) must be "auto" or in [0..600]'),
        ("q = .*", "q = [1.0, 2.0, 3.0]", "control.q (=[1.0, 2.0, 3.0]) must be 1 or 2 numbers, each in (0..1e+12]"),
        ("widths = .*", "widths = 0.0", "control.widths (=0) must be 1 or 15 widths, each in (0..10000]"),
        ("rate_Hz = .*", "rate_kHz = 1.0", f"loop.rate_kHz is not a known key: use rate_Hz{UNIT}"),
        ("inertia_kgm2", "inertia", "joint.inertia is not a known key: use inertia_kgm2 (the unit is part of the key)"),
        ("velocity_max_radps", "velocity_max_degps", f"limits.velocity_max_degps is not a known key:"
         f" use velocity_max_radps{UNIT}"),
        ("feed_forward", "feed_foward", "control.feed_foward is not a known key: did you mean feed_forward?"),
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


@pytest.mark.parametrize("rate_Hz", [100, 100.0, 4000])
def test_the_ends_of_a_range_are_allowed(tmp_path: Path, rate_Hz: float) -> None:
    text = replaced(VIRTUAL, "velocity_cutoff_Hz = .*", "velocity_cutoff_Hz = 30.0")
    assert load(tmp_path, "rate_Hz = .*", f"rate_Hz = {rate_Hz}", text).loop.rate_Hz == rate_Hz


def test_several_problems_are_told_at_once(tmp_path: Path) -> None:
    text = replaced(VIRTUAL, "kp = .*", "kp = -1.0")
    assert len(problems(tmp_path, "node = .*", "node = 0", text)) == 2


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
        ("knee = 40.0", "knee = 201.0", "friction.positive.knee (=201) and max (=200)"),
        ("torque_max_Nm = .*", "torque_max_Nm = 60.51", "limits.torque_max_Nm (=60.51) must be in (0..60.5]"),
        ("stop_timeout_s = .*", "stop_timeout_s = 0.5", "sequence.stop_timeout_s (=0.5)"),
        ("node = .*", "node = 126", "drive.master_node (=126) must differ"),
        ("command_delay_s = .*", "command_delay_s = 0.06", "virtual.command_delay_s (=0.06)"),
    ],
)
def test_contradictions_between_values_are_named(tmp_path: Path, pattern: str, line: str, expected: str) -> None:
    found = problems(tmp_path, pattern, line)
    assert len(found) == 1
    assert found[0].startswith(expected)


@pytest.mark.parametrize(
    ("pattern", "line"),
    [
        ("position_max_rad = .*", "position_max_rad = 0.35"),
        ("position_min_rad = .*", "position_min_rad = -0.35"),
        ("velocity_max_radps = .*", "velocity_max_radps = 0.21992"),
        ("position_jump_max_rad = .*", "position_jump_max_rad = 0.001"),
        ("counts_per_turn = .*", "counts_per_turn = 2932"),
        ("sample_age_max_s = .*", "sample_age_max_s = 0.001"),
        ("velocity_cutoff_Hz = .*", "velocity_cutoff_Hz = 499.9"),
        ("knee = 40.0", "knee = 200.0"),
        ("torque_max_Nm = .*", "torque_max_Nm = 60.5"),
        ("stop_timeout_s = .*", "stop_timeout_s = 0.501"),
        ("node = .*", "node = 127"),
        ("command_delay_s = .*", "command_delay_s = 0.05"),
    ],
)
def test_values_just_inside_are_accepted(tmp_path: Path, pattern: str, line: str) -> None:
    load(tmp_path, pattern, line)


def test_a_file_may_begin_with_the_mark_of_an_editor_and_end_its_lines_with_two_characters(tmp_path: Path) -> None:
    shipped = shipped_config("virtual")
    path = tmp_path / "joint.toml"
    path.write_bytes(b"\xef\xbb\xbf" + shipped.read_text().replace("\n", "\r\n").encode())
    assert load_config(path).limits == load_config(shipped).limits


def test_files_that_are_no_configuration_give_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.toml: no such file .*virtual"):
        load_config(tmp_path / "none.toml")
    with pytest.raises(ConfigurationError, match="is a folder"):
        load_config(tmp_path)
    path = tmp_path / "binary.toml"
    path.write_bytes(b"[bus]\n\xff\xfe")
    with pytest.raises(ConfigurationError, match="byte 6 is not UTF-8"):
        load_config(path)
    path.write_text("[bus]\nchannel = \n")
    with pytest.raises(ConfigurationError, match=r"not valid TOML: .*line 2"):
        load_config(path)
    path.write_text("bus = 3\n")
    with pytest.raises(ConfigurationError, match=r"bus \(=3\) must be a section: \[bus\]"):
        load_config(path)


def test_flag_beats_environment_beats_file() -> None:
    config = load_config(shipped_config("virtual"))
    environ = {"CAN_INTERFACE": "socketcan", "CAN_CHANNEL": "can7", "CAN_BITRATE": "500000"}
    assert with_bus_overrides(config, environ={}).bus == config.bus
    bus = with_bus_overrides(config, environ=environ).bus
    assert (bus.interface, bus.channel, bus.bitrate_bitps) == ("socketcan", "can7", 500_000)
    bus = with_bus_overrides(config, "pcan", "usb1", 250_000, environ).bus
    assert (bus.interface, bus.channel, bus.bitrate_bitps) == ("pcan", "usb1", 250_000)
    changed = with_bus_overrides(config, environ=environ)
    assert changed.path == config.path
    with pytest.raises(ConfigurationError, match=r"environment: CAN_BITRATE \(=fast\)"):
        with_bus_overrides(config, environ={"CAN_BITRATE": "fast"})
    with pytest.raises(
        ConfigurationError, match=r"command line: bus.bitrate_bitps \(=1\) must be in \[10000..1e\+06\]"
    ):
        with_bus_overrides(config, bitrate=1, environ={})


def test_a_configuration_cannot_be_changed() -> None:
    config = load_config(shipped_config("virtual"))
    with pytest.raises(ValueError, match="frozen"):
        config.limits.torque_max_Nm = 1000.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("pattern", "line", "told"),
    [
        ("rate_Hz = .*", "rate_kHz = 1.0", "loop.rate_kHz is not a known key"),
        ("amplitude_rad = .*", "amplitude_deg = 20.0", "trajectory.amplitude_deg is not a known key"),
        ("feed_forward = .*", 'feed_foward = "none"', "control.feed_foward is not a known key"),
    ],
)
def test_a_key_in_the_wrong_unit_is_one_line_and_not_two(tmp_path: Path, pattern: str, line: str, told: str) -> None:
    found = problems(tmp_path, pattern, line)
    assert len(found) == 1
    assert told in found[0]


def test_a_key_that_is_missing_beside_an_unknown_one_is_still_told(tmp_path: Path) -> None:
    assert len(problems(tmp_path, "node = .*", "colour = 1")) == 2

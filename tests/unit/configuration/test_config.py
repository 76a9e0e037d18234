"""Configuration files: what is shipped loads, what is wrong is named in one line, units are converted once."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigurationError
from firmware_py import friction as friction_model
from firmware_py.states import ControllerKind, FeedForward, TrajectoryKind
from firmware_py.trajectory_table import approach_peak, approach_start, peak_of
from tools.configuration.checks import trajectory_extremes
from tools.configuration.config import Config
from tools.configuration.conversions import friction_constants, joint_rad_per_count, torque_constant_NmpA
from tools.configuration.load import load_config, shipped_config, with_bus_overrides
from tools.configuration.plant_settings import plant_settings
from tools.configuration.records import approach_s, axis_constants, trajectory_table

VIRTUAL = shipped_config("virtual").read_text()
UNIT = " (the unit is part of the key)"


def replaced(text: str, pattern: str, line: str) -> str:
    changed, count = re.subn(rf"^{pattern}", lambda _: line, text, count=1, flags=re.M)
    assert count == 1, pattern
    return changed


def load(tmp_path: Path, pattern: str = "", line: str = "", text: str = VIRTUAL) -> Config:
    path = tmp_path / "joint.toml"
    path.write_text(replaced(text, pattern, line) if pattern else text)
    return load_config(path)


def problems(tmp_path: Path, pattern: str, line: str, text: str = VIRTUAL) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path, pattern, line, text)
    assert caught.value.exit_code == 3
    lines = caught.value.message.splitlines()
    prefix = f"{tmp_path / 'joint.toml'}: "
    assert all(x.startswith(prefix) for x in lines)
    return [x.removeprefix(prefix) for x in lines]


@pytest.mark.parametrize("name", ["virtual", "paper"])
def test_the_shipped_virtual_configurations_load(name: str) -> None:
    config = load_config(shipped_config(name))
    assert config.eds_path.name == "virtual_joint.eds"
    assert config.text == shipped_config(name).read_text()


def test_the_elmo_configuration_refuses_to_load_until_it_is_filled_in(tmp_path: Path) -> None:
    text = shipped_config("elmo_gold_can").read_text()
    marked = set(re.findall(r"^# (\w+) = .*# FILL IN(?! if)", text, re.M))
    lines = problems(tmp_path, "#", "#", text)
    assert {x.removesuffix(" is missing").split(".")[1] for x in lines} == marked - {
        "rated_current_A",
        "rated_torque_Nm",
    }
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


def test_records_of_the_paper() -> None:
    axis = axis_constants(load_config(shipped_config("paper")))[0]
    law = axis.law
    assert law.kind == ControllerKind.COMPUTED_TORQUE_RBF
    assert law.feed_forward == FeedForward.MEASURED
    # spec, section 3: P for Q = 1800 I, divided by M0 = 2.1
    np.testing.assert_allclose(law.network.p_b, [1.147959 / 2.1, 16.091928 / 2.1], rtol=1e-6)
    assert law.network.inverse_width[14] == pytest.approx(1.0 / 50.0)
    half = 1e-2 * np.array([-5, -3, -1, -0.8, -0.4, -0.1, -0.05])
    np.testing.assert_allclose(law.network.centres[:, 1], [*half, 0.0, *-half])
    np.testing.assert_array_equal(law.network.centres[:, 0], law.network.centres[:, 1])
    assert axis.trajectory.kind == TrajectoryKind.SINE
    assert axis.trajectory.omega_radps == pytest.approx(0.2 * math.pi)
    assert axis.trajectory.duration_s == 100.0
    assert axis.limits.torque_max_Nm == 60.0
    assert axis.limits.sample_age_max_cycles == 50
    assert axis.velocity.period_gain == pytest.approx(1.0 - math.exp(-0.2 * math.pi))


@pytest.mark.parametrize("name", ["virtual", "paper"])
def test_friction_of_the_files_is_table_3(name: str) -> None:
    law = axis_constants(load_config(shipped_config(name)))[0].law
    velocity = np.radians([12.6, -12.6, 40.0, 40.01, -40.0, -40.01, 100.0, 200.0, -200.0])
    torque = [friction_model.friction_motor_torque_Nm(law.friction, v) for v in velocity]
    np.testing.assert_allclose(
        torque, [0.15326, -0.13814, 0.22592, 0.22761, -0.20530, -0.20402, 0.28871, 0.33823, -0.35398], atol=2e-5
    )


def test_friction_units_and_sides_describe_the_same_curve() -> None:
    friction = load_config(shipped_config("virtual")).friction
    assert friction is not None
    n = 121.0
    own = friction_constants(friction, n)
    # the same table as r/min of the motor, torque at the joint
    unit = n / 6.0  # deg/s of the joint in r/min of the motor

    def converted(d):  # type: ignore[no-untyped-def]
        values = {"tc_Nm": d.tc_Nm * n, "ts_Nm": d.ts_Nm * n, "ws": d.ws * unit, "tv": d.tv * n / unit}
        values |= {f"a{i}": getattr(d, f"a{i}") * n / unit**i for i in range(4)}
        return d.model_copy(update={**values, "knee": d.knee * unit, "max": d.max * unit})

    other = friction.model_copy(
        update={
            "velocity_unit": "r/min", "velocity_side": "motor", "torque_side": "joint",
            "positive": converted(friction.positive), "negative": converted(friction.negative),
        }
    )  # fmt: skip
    velocity = np.radians([-250.0, -100.0, -39.0, -1.0, 1.0, 39.0, 100.0, 250.0])
    np.testing.assert_allclose(
        friction_model.friction_curve_Nm(friction_constants(other, n), velocity),
        friction_model.friction_curve_Nm(own, velocity),
        rtol=1e-12,
    )


def test_ampere_conventions_and_encoder_sides(tmp_path: Path) -> None:
    assert torque_constant_NmpA(load(tmp_path)) == 0.1
    config = load(tmp_path, "torque_constant_NmpA", 'torque_constant_ampere = "rms"\ntorque_constant_NmpA')
    # 1 A rms is 1.414 A amplitude: the drive, which counts amplitude, gets less torque per ampere
    assert torque_constant_NmpA(config) == pytest.approx(0.1 / math.sqrt(2.0))
    assert joint_rad_per_count(load(tmp_path)) == pytest.approx(math.tau / 2**19)
    config = load(tmp_path, "side = .*\ndirection = 1", 'side = "motor"\ndirection = -1')
    assert joint_rad_per_count(config) == pytest.approx(-math.tau / 2**19 / 121.0)


def test_the_automatic_approach_keeps_to_its_speed_and_is_no_longer_than_needed(tmp_path: Path) -> None:
    config = load(tmp_path)
    assert approach_s(config, 0.0) == 1.0
    start = approach_start(axis_constants(config, start_position_rad=0.0)[0].trajectory)
    allowed = 1.2 * 0.35 * 0.2 * math.pi  # of the sine's own speed at its start, above a quarter of the limit
    duration = approach_s(config, -0.6)
    assert approach_peak(-0.6, start, duration).velocity_radps <= allowed * (1.0 + 1e-6)
    assert approach_peak(-0.6, start, 0.99 * duration).velocity_radps > allowed
    # an unknown place is taken as the farther end of the range
    assert approach_s(config) == max(approach_s(config, -0.7), approach_s(config, 0.7))
    assert approach_s(load(tmp_path, "approach_s = .*", "approach_s = 0"), 0.6) == 0.0


def test_shipped_checks_agree_with_the_trajectory_itself(tmp_path: Path) -> None:
    start = VIRTUAL.index("[trajectory]")
    end = VIRTUAL.index("[virtual]")
    for keys in (
        'kind = "sine"\namplitude_rad = -0.3\nfrequency_Hz = 0.2\noffset_rad = 0.1',
        'kind = "min_jerk"\nstart_rad = 0.2\ntarget_rad = -0.4\nmove_s = 2.0',
        'kind = "trapezoid"\nstart_rad = 0.2\ntarget_rad = -0.4\nspeed_radps = 0.5\nacceleration_radps2 = 0.1',
        'kind = "trapezoid"\nstart_rad = 0.2\ntarget_rad = -0.4\nspeed_radps = 0.2\nacceleration_radps2 = 1.0',
        'kind = "hold"\nposition_rad = 0.3',
    ):
        text = VIRTUAL[:start] + f"[trajectory]\nduration_s = 0.0\n{keys}\n\n" + VIRTUAL[end:]
        config = load(tmp_path, text=text)
        peak = peak_of(axis_constants(config)[0].trajectory)
        assert trajectory_extremes(config.trajectory) == pytest.approx(peak[:3]), keys


def test_plant_settings_are_accepted_by_the_plant() -> None:
    from hil.plant.joint import plant

    settings = plant_settings(load_config(shipped_config("virtual")))
    constants, state = plant(**settings)
    assert constants[0].positive_factor == pytest.approx(121.0 * 1.1)
    assert state[0].joint_position_rad == 0.1
    assert settings["current_lag_s"] == 0.5e-3


def test_a_table_trajectory_is_read_and_checked(tmp_path: Path) -> None:
    start = VIRTUAL.index("[trajectory]")
    end = VIRTUAL.index("[virtual]")
    text = VIRTUAL[:start] + '[trajectory]\nkind = "table"\nduration_s = 2.0\nfile = "way.csv"\n\n' + VIRTUAL[end:]
    assert problems(tmp_path, "#", "#", text)[0].startswith("trajectory.file (=way.csv) must name a file")
    way = tmp_path / "way.csv"
    way.write_text("time_s,position_rad\n0,0\n1,0.1\n2,0.2\n3,0.2\n")
    config = load(tmp_path, text=text)
    assert trajectory_table(config).shape[1] == 5
    assert axis_constants(config)[0].trajectory.table_rows == len(trajectory_table(config))
    with pytest.raises(ConfigurationError, match="needs a table that ends where it begins"):
        trajectory_table(load(tmp_path, "file = ", "repeat = true\nfile = ", text))
    way.write_text("time_s,position_rad\n0,0\n1,0.1\n2,0.8\n3,0.8\n")
    with pytest.raises(ConfigurationError, match=r"trajectory: highest position \(=0\.8"):
        trajectory_table(load(tmp_path, text=text))
    way.write_text("time_s,position_rad\n0,0\n1,zero\n")
    with pytest.raises(ConfigurationError, match=r"trajectory\.file: .*way\.csv"):
        trajectory_table(load(tmp_path, text=text))


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

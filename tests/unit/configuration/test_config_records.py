"""From a configuration to the records of kernels and plant: units are converted once."""

from __future__ import annotations

import math
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py import friction as friction_model
from jointctl.firmware_py.observers import step_velocity
from jointctl.firmware_py.records import VelocityState
from jointctl.firmware_py.safety import PUSHED_CYCLES
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ControllerKind, FeedForward, TrajectoryKind
from jointctl.firmware_py.trajectory import approach_peak, approach_start, peak_of
from jointctl.tools.configuration.canopen import CanopenSection
from jointctl.tools.configuration.checks import trajectory_extremes
from jointctl.tools.configuration.conversions import (
    friction_constants,
    joint_rad_per_count,
    static_friction_Nm,
    torque_constant_NmpA,
    velocity_of_a_count_radps,
)
from jointctl.tools.configuration.elmo import ElmoSection
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.records import approach_s, trajectory_table
from jointctl.tools.configuration.sections import Encoder, Joint, Limits, Loop, Section, Sequence
from jointctl.tools.virtual_joint import device_settings, plant_settings
from tests.configurations import CONFIGS, VIRTUAL, load, problems
from tests.sessions import constants_of

NO_TABLE = np.zeros((1, 5))


COPIED = (Limits, Sequence, Loop, Joint, Encoder)
OF_THE_ENCODER = {"encoder_on_motor", "encoder_direction"}


@pytest.mark.parametrize(
    ("settings", "section", "by_hand"),
    [
        (
            CanopenSettings,
            CanopenSection,
            {"eds_path", "encoder_incremental", "joint_encoder", "temperature", "torque_limit"}
            | {"torque_offset", "velocity_offset", "velocity_share", "holds_alone"},  # of [drive.cascade]
        ),
        (ElmoSettings, ElmoSection, {"mode", "ramp_radps2"}),
    ],
)
def test_a_setting_of_a_drive_that_no_key_gives_is_filled_by_hand(
    settings: type[Any], section: type[Section], by_hand: set[str]
) -> None:
    """The others are copied by name: a key that is renamed on one side alone would leave a default in force."""
    keys = {key for copied in (section, *COPIED) for key in copied.model_fields}
    assert {field.name for field in fields(settings)} - keys == by_hand | OF_THE_ENCODER


def test_records_of_the_paper() -> None:
    axis = constants_of(load_config(shipped_config("paper")))[0]
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
    law = constants_of(load_config(shipped_config(name)))[0].law
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


@pytest.mark.parametrize(
    ("measured", "late", "from_command_s"),
    [("", 2, 0.0015), ("loop_delay_s = 0.0026\n", 4, 0.0031)],  # without it one period, and half of one that it is held
)
def test_the_automatic_lead_is_delay_half_a_period_and_lag(
    tmp_path: Path, measured: str, late: int, from_command_s: float
) -> None:
    text = VIRTUAL.replace("[margin]\n", f"[margin]\ncurrent_lag_s = 0.0007\n{measured}")
    lead = 'feed_forward = "lugre_desired"\nfeed_forward_lead_s = "auto"\nobserver_paired = true'
    text = text.replace("[friction]", "[control.adaptation]\n\n[friction]", 1)
    text = re.sub('kind = "computed_torque_rbf"', 'kind = "computed_torque_observer"\nobserver_radps = 60.0', text)
    law = constants_of(load(tmp_path, "feed_forward = .*", lead, text=text))[0].law
    assert law.feed_forward_lead_s == pytest.approx(from_command_s + 0.0007)
    assert law.adaptation.late_cycles == late


def test_the_automatic_approach_keeps_to_its_speed_and_is_no_longer_than_needed(tmp_path: Path) -> None:
    config = load(tmp_path)
    assert approach_s(config, NO_TABLE, 0.0) == 1.0
    start = approach_start(constants_of(config, start_position_rad=0.0)[0].trajectory)
    allowed = 1.2 * 0.35 * 0.2 * math.pi  # of the sine's own speed at its start, above a quarter of the limit
    duration = approach_s(config, NO_TABLE, -0.6)
    assert approach_peak(-0.6, start, duration).velocity_radps <= allowed * (1.0 + 1e-6)
    assert approach_peak(-0.6, start, 0.99 * duration).velocity_radps > allowed
    # an unknown place is taken as the farther end of the range
    assert approach_s(config, NO_TABLE) == max(approach_s(config, NO_TABLE, -0.7), approach_s(config, NO_TABLE, 0.7))
    assert approach_s(load(tmp_path, "approach_s = .*", "approach_s = 0"), NO_TABLE, 0.6) == 0.0


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
        peak = peak_of(constants_of(config)[0].trajectory)
        assert trajectory_extremes(config.trajectory) == pytest.approx(peak[:3]), keys


def test_what_only_the_plant_refuses_is_named_where_it_is_made(tmp_path: Path) -> None:
    path = tmp_path / "joint.toml"
    path.write_text(re.sub("command_delay_s = .*", "command_delay_s = 0.06", VIRTUAL))
    with pytest.raises(ConfigurationError, match=r"joint\.toml: virtual\.command_delay_s \(=0\.06\)"):
        plant_settings(load_config(path))


def test_plant_settings_are_accepted_by_the_plant() -> None:
    from jointctl.hil.plant import plant

    settings = plant_settings(load_config(shipped_config("virtual")))
    constants, state = plant(**settings)
    assert constants[0].positive_factor == pytest.approx(121.0 * 1.1)
    assert state[0].joint_position_rad == 0.1
    assert settings["current_lag_s"] == 0.5e-3


@pytest.mark.parametrize("inertia_kgm2", [6e-4, 2.1, 40.0])
def test_the_virtual_drives_velocity_loop_suits_the_inertia_of_its_joint(tmp_path: Path, inertia_kgm2: float) -> None:
    """The gains of 2.1 kg m2 left 40 kg m2 with a damping of 0.16: it swung in `sweep`, and in stops."""
    config = load(tmp_path, "inertia_kgm2 = [0-9.]+", f"inertia_kgm2 = {inertia_kgm2}")
    if inertia_kgm2 < 1e-3:
        config = config.changed(friction=None)  # that of 2.1 kg m2 is much for the lightest one
    settings = device_settings(config)
    assert settings.velocity_gain_Nmspr == pytest.approx(200.0 / 2.1 * inertia_kgm2)
    assert settings.velocity_integral_Nmprad == pytest.approx(1e4 / 2.1 * inertia_kgm2)
    text = (CONFIGS / "csp.toml").read_text()
    given = load(tmp_path, "inertia_kgm2 = [0-9.]+", f"inertia_kgm2 = {inertia_kgm2}", text)
    assert device_settings(given).velocity_gain_Nmspr == 200.0


def test_a_table_trajectory_is_read_and_checked(tmp_path: Path) -> None:
    start = VIRTUAL.index("[trajectory]")
    end = VIRTUAL.index("[virtual]")
    text = VIRTUAL[:start] + '[trajectory]\nkind = "table"\nduration_s = 2.0\nfile = "way.csv"\n\n' + VIRTUAL[end:]
    assert problems(tmp_path, "#", "#", text)[0].startswith("trajectory.file (=way.csv) must name a file")
    way = tmp_path / "way.csv"
    way.write_text("time_s,position_rad\n0,0\n1,0.1\n2,0.2\n3,0.2\n")
    config = load(tmp_path, text=text)
    assert trajectory_table(config).shape[1] == 5
    assert constants_of(config)[0].trajectory.table_rows == len(trajectory_table(config))
    with pytest.raises(ConfigurationError, match="needs a table that ends where it begins"):
        trajectory_table(load(tmp_path, "file = ", "repeat = true\nfile = ", text))
    way.write_text("time_s,position_rad\n0,0\n1,0.1\n2,0.8\n3,0.8\n")
    with pytest.raises(ConfigurationError, match=r"trajectory: highest position \(=0\.8"):
        trajectory_table(load(tmp_path, text=text))
    way.write_text("time_s,position_rad\n0,0\n1,zero\n")
    with pytest.raises(ConfigurationError, match=r"trajectory\.file: .*way\.csv"):
        trajectory_table(load(tmp_path, text=text))


@pytest.mark.parametrize("cutoff_Hz", [0.0, 20.0, 400.0])
@pytest.mark.parametrize("rate_Hz", [1000, 2000])
def test_the_velocity_of_one_count_is_what_the_filter_makes_of_it(
    tmp_path: Path, cutoff_Hz: float, rate_Hz: int
) -> None:
    text = VIRTUAL.replace("velocity_cutoff_Hz = 100.0", f"velocity_cutoff_Hz = {cutoff_Hz}")
    config = load(tmp_path, "rate_Hz = .*", f"rate_Hz = {rate_Hz}", text)
    state = new(VelocityState)[0]
    for position_rad in (0.0, abs(joint_rad_per_count(config))):
        step_velocity(constants_of(config)[0].velocity, state, position_rad, 0.0, 1)
    assert velocity_of_a_count_radps(config) == pytest.approx(state.velocity_radps)


def test_a_reading_that_stands_counts_when_the_joint_must_have_left_its_tolerance(tmp_path: Path) -> None:
    """However heavy it is, and however coarse its counts are."""
    for inertia, counts, cycles in ((2.1, 524288, PUSHED_CYCLES), (60.0, 65536, None)):
        text = VIRTUAL.replace("inertia_kgm2 = 2.1", f"inertia_kgm2 = {inertia}")
        config = load(tmp_path, "counts_per_turn = .*", f"counts_per_turn = {counts}", text)
        limits = constants_of(config)[0].limits
        static_Nm = static_friction_Nm(config)
        assert static_Nm is not None
        assert limits.frozen_torque_Nm == pytest.approx(1.5 * static_Nm)
        pushed_s = limits.frozen_cycles / config.loop.rate_Hz
        way_rad = 0.5 * (limits.frozen_torque_Nm - static_Nm) / inertia * pushed_s**2
        assert way_rad > 1.9 * limits.frozen_tolerance_rad
        assert cycles is None or limits.frozen_cycles == cycles

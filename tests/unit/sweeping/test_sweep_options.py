"""Options of a sweep against the joint: every bad one is a single line, and the defaults fit."""

from __future__ import annotations

import math
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError, DataError, DeviceError, JointctlError, UsageError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo_settings import elmo_section, elmo_settings
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.plant_settings import plant_settings
from jointctl.tools.output import Output
from jointctl.tools.sweeping.carry_out import ACCELERATION_SPARE, middle_rad, with_mode, with_tracking_law
from jointctl.tools.sweeping.options import QUICK_S, SweepOptions, make_plan
from jointctl.tools.sweeping.statistics import LEAST_SAMPLES
from jointctl.tools.verbs.sweep import sweep

SWEEP = shipped_config("sweep_virtual")


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(SWEEP)


def limited(config: Config, **limits: float) -> Config:
    return config.model_copy(update={"limits": config.limits.model_copy(update=limits)})


def test_the_default_grid_has_the_papers_number_of_points_and_reaches_the_rated_speed(config: Config) -> None:
    plan = make_plan(config, SweepOptions())
    speeds = [abs(p.velocity_radps) for p in plan.points]
    assert len(plan.points) == 225
    assert max(speeds) == pytest.approx(math.radians(200.0), rel=2e-3)
    assert min(speeds) < math.radians(0.25)
    motion = plan.motion(plan.points, 1.0)
    assert 5.0 < motion.duration_s / 60.0 < 30.0
    assert motion.high_rad - motion.low_rad < config.limits.position_max_rad - config.limits.position_min_rad


def test_quick_stays_below_eight_minutes_with_enough_points(config: Config) -> None:
    plan = make_plan(config, SweepOptions(quick=True))
    assert plan.motion(plan.points, 1.0).duration_s <= QUICK_S < 480.0
    assert len(plan.points) >= 40
    slow = make_plan(config, SweepOptions(quick=True, min_speed_radps=0.002))
    assert slow.motion(slow.points, 1.0).duration_s <= QUICK_S
    assert len(slow.points) < len(plan.points)


@pytest.mark.parametrize("options", [SweepOptions(quick=True), SweepOptions(points=24, dwell_s=0.1)])
@pytest.mark.parametrize("name", ["elmo_serial", "sweep_virtual"])
def test_every_plateau_has_room_for_the_samples_that_it_needs(name: str, options: SweepOptions) -> None:
    config = load_config(shipped_config(name))
    plan = make_plan(config, options)
    seconds = dict.fromkeys((p.index for p in plan.points), 0.0)
    for window in plan.motion(plan.points, 0.0).windows:
        seconds[window.point.index] += window.end_s - window.start_s
    assert min(seconds.values()) * config.loop.rate_Hz > 1.1 * LEAST_SAMPLES


def test_the_fastest_speed_follows_from_limits_and_travel(config: Config) -> None:
    short = limited(config, position_min_rad=-0.7, position_max_rad=0.7)
    fastest = max(p.velocity_radps for p in make_plan(short, SweepOptions(points=10)).points)
    assert fastest < 2.0
    narrow = limited(config, velocity_max_radps=1.0)
    assert max(p.velocity_radps for p in make_plan(narrow, SweepOptions(points=10)).points) == pytest.approx(0.9)


def test_an_unbounded_joint_is_swept_about_where_it_stands(config: Config) -> None:
    free = limited(config, position_min_rad=-1000.0, position_max_rad=1000.0)
    plan = make_plan(free, SweepOptions(points=10))
    motion = plan.motion(plan.points, 1.0)
    assert motion.high_rad - motion.low_rad < 20.0
    assert middle_rad(free, motion, 500.0) == 500.0
    assert middle_rad(free, motion, 999.99) < 999.0
    bounded = make_plan(config, SweepOptions(points=10))
    placed = bounded.motion(bounded.points, 1.0)
    for start in (-3.0, 0.0, 3.0):
        middle = middle_rad(config, placed, start)
        assert middle + placed.low_rad > config.limits.position_min_rad
        assert middle + placed.high_rad < config.limits.position_max_rad


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"points": 1}, r"--points \(=1\) must be in \[2..5000\]"),
        ({"points": 5001}, r"--points \(=5001\)"),
        ({"passes": 0}, r"--passes \(=0\) must be in \[1..100\]"),
        ({"warm_up_turns": -0.1}, r"--warm-up \(=-0.1\)"),
        ({"warm_up_turns": math.nan}, r"--warm-up \(=nan\)"),
        ({"dwell_s": 0.05}, r"--dwell \(=0.05\) must be in \[0.1..600\]"),
        ({"max_speed_radps": 3.5}, r"--max-speed \(=3.5\) must be at most 3.492 rad/s, 90% of limits.velocity_max"),
        ({"max_speed_radps": -1.0}, r"--max-speed \(=-1\)"),
        ({"min_speed_radps": 2.0, "max_speed_radps": 2.0}, r"--min-speed \(=2\) must be less than --max-speed, 2"),
        ({"grid": "cubic"}, r"--grid \(=cubic\) must be one of near-zero, linear, log, list"),
        ({"grid": "list"}, r"--speeds FILE goes with --grid list"),
        ({"speeds": Path("x.txt")}, r"--speeds FILE goes with --grid list"),
        ({"grid": "list", "speeds": Path("x.txt"), "points": 5}, r"do not go with --grid list"),
        ({"quick": True, "points": 50}, r"--quick chooses the number of points"),
    ],
)
def test_a_bad_option_is_one_line_with_exit_code_2(config: Config, options: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError, match=text) as error:
        make_plan(config, SweepOptions(**options))
    assert error.value.exit_code == 2
    assert "\n" not in error.value.message


def test_a_list_of_speeds_is_used_as_it_is(config: Config, tmp_path: Path) -> None:
    file = tmp_path / "speeds.txt"
    file.write_text("0.5\n-0.5\n1.5\n")
    plan = make_plan(config, SweepOptions(grid="list", speeds=file))
    assert [p.velocity_radps for p in plan.points] == [0.5, -0.5, 1.5]
    file.write_text("0.5\n9\n")
    with pytest.raises(UsageError, match=r"fastest speed of .*speeds.txt \(=9\) must be at most"):
        make_plan(config, SweepOptions(grid="list", speeds=file))


def run(config: Config, out: Path, **options: Any) -> JointctlError:
    with pytest.raises(JointctlError) as error:
        sweep(config, Output(stdout=StringIO(), stderr=StringIO()), out, SweepOptions(**options))
    return error.value


def test_the_output_file_is_checked_before_anything_moves(config: Config, tmp_path: Path) -> None:
    assert "must end in .csv" in run(config, tmp_path / "data.txt", lockstep=True).message
    assert "no folder" in run(config, tmp_path / "none" / "data.csv", lockstep=True).message
    (tmp_path / "data.json").write_text("{}")
    error = run(config, tmp_path / "data.csv", lockstep=True)
    assert isinstance(error, DataError)
    assert "exists already" in error.message
    assert not (tmp_path / "data.csv").exists()


def test_without_a_terminal_motion_needs_y(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", StringIO(""))
    error = run(config, tmp_path / "data.csv")
    assert (error.exit_code, "no terminal to ask on" in error.message) == (2, True)


def test_modes(config: Config) -> None:
    assert with_mode(config, "torque").canopen.mode == config.canopen.mode
    assert with_mode(config, "csv").canopen.mode == "csv"
    with pytest.raises(UsageError, match=r"--mode \(=fast\) must be one of auto, csv, pv, speed, torque"):
        with_mode(config, "fast")
    with pytest.raises(DeviceError, match=r"--mode \(=speed\) must be auto, csv, pv or torque"):
        with_mode(config, "speed")


def test_modes_of_a_serial_drive() -> None:
    serial = load_config(shipped_config("elmo_serial"))
    assert elmo_section(serial).unit_mode == "torque"  # what `run` gets
    for mode in ("auto", "speed", "torque"):
        assert elmo_settings(with_mode(serial, mode), 0.1).mode == mode
    assert elmo_settings(serial, 0.1).ramp_radps2 > ACCELERATION_SPARE * serial.sequence.brake_radps2
    with pytest.raises(DeviceError, match=r"--mode \(=csv\) must be auto, speed or torque"):
        with_mode(serial, "csv")


def test_a_law_without_integral_action_gets_an_observer_for_torque_mode() -> None:
    network = load_config(shipped_config("virtual"))
    assert network.control.kind == "computed_torque_rbf"
    changed = with_tracking_law(network).control
    assert (changed.kind, changed.observer_radps > 0.0, changed.learning) == ("computed_torque_observer", True, None)
    observer = load_config(SWEEP)
    assert with_tracking_law(observer).control == observer.control


def test_device_error_keeps_its_exit_code() -> None:
    assert DeviceError.exit_code == 6


def changed(tmp_path: Path, old: str, new: str) -> Path:
    text = SWEEP.read_text()
    assert text.count(old) == 1
    (tmp_path / "joint.toml").write_text(text.replace(old, new))
    return tmp_path / "joint.toml"


def test_the_joints_own_friction_is_not_the_controllers(config: Config, tmp_path: Path) -> None:
    assert config.friction is None
    true = plant_settings(config)["friction"]
    assert float(true.positive.coulomb_Nm) == 0.138
    other = load_config(changed(tmp_path, "tc_Nm = 0.138", "tc_Nm = 0.15"))
    assert float(plant_settings(other)["friction"].positive.coulomb_Nm) == 0.15


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("tc_Nm = 0.138", "tc_Nm = -1.0", "virtual.friction.positive.tc_Nm (=-1) must be in [0..10000]"),
        ("tc_Nm = 0.138", "tc = 0.138", "virtual.friction.positive.tc is not a known key"),
        ("knee = 40.0", "knee = 400.0", "virtual.friction.positive.knee (=400) and max (=205) must be"),
        ("a0 = -0.175", "a0 = 3.0", "virtual.friction.negative: a0..a3 must give friction that opposes"),
        ('mode = "cst"', 'velocity_unit = "rpm"\nmode = "cst"', "drive.velocity_unit (=rpm) must be one of 'counts/s'"),
        ('mode = "cst"', 'mode = "csv"', "drive.mode (=csv) must be one of 'cst', 'tq' or 'auto'"),
    ],
)
def test_a_bad_key_of_the_sweeps_configuration_is_one_line(tmp_path: Path, old: str, new: str, text: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        load_config(changed(tmp_path, old, new))
    assert text in error.value.message

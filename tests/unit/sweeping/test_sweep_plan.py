"""Options, grid, order and motion of a sweep: always inside travel and limits, bad options in one line."""

from __future__ import annotations

import math
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.errors import ConfigurationError, DataError, DeviceError, JointctlError, UsageError
from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import peak_of, reference_at
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import elmo_section, elmo_settings
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.sweeping.carry_out import (
    ACCELERATION_SPARE,
    LEAST_SAMPLES,
    middle_rad,
    with_mode,
    with_tracking_law,
)
from jointctl.tools.sweeping.options import (
    SweepOptions,
    SweepPoint,
    both_directions,
    grid_speeds,
    listed_velocities,
    ordered_points,
    plan_hash,
)
from jointctl.tools.sweeping.plan import (
    QUICK_S,
    PlanSettings,
    SweepMotion,
    fastest_radps,
    make_plan,
    plan_motion,
    shifted,
    stroke_of,
)
from jointctl.tools.verbs.sweep import _speeds, sweep
from jointctl.tools.virtual_joint import plant_settings
from tests.configurations import edited
from tests.sessions import output

# --- Grid, order and motion of a sweep: always inside travel and limits, windows only at constant speed ---
RATIO = 121.0


def plan_settings(**changes: Any) -> PlanSettings:
    values = {"width_rad": 6.2, "acceleration_radps2": 4.0, "transit_radps": 1.7, "dwell_s": 1.0, "settle_s": 0.3,
              "reduction_ratio": RATIO}  # fmt: skip
    return PlanSettings(**{**values, **changes})


def constants_of(motion: SweepMotion) -> Any:
    constants = new(TrajectoryConstants)
    constants[0].kind, constants[0].table_rows = TrajectoryKind.TABLE, len(motion.table)
    return constants[0]


def reference(motion: SweepMotion, time_s: float) -> Any:
    found = new(Reference)[0]
    reference_at(constants_of(motion), motion.table, 0, time_s, found)
    return found


def points_of(speeds: list[float], passes: int = 1) -> list[SweepPoint]:
    return ordered_points(both_directions(speeds, 2 * len(speeds)), passes, None)


@settings(max_examples=60)
@given(
    width=st.floats(0.2, 50.0),
    acceleration=st.floats(0.5, 20.0),
    dwell=st.floats(0.1, 5.0),
    settle=st.floats(0.0, 0.5),
    shares=st.lists(st.floats(0.001, 1.0), min_size=1, max_size=4, unique=True),
    warm_up=st.floats(0.0, 1.0),
    rounding=st.just(0.0) | st.floats(0.005, 0.5),
)
def test_any_plan_stays_inside_travel_speed_and_acceleration(
    width: float, acceleration: float, dwell: float, settle: float, shares: list[float], warm_up: float, rounding: float
) -> None:
    s = plan_settings(
        width_rad=width, acceleration_radps2=acceleration, dwell_s=dwell, settle_s=settle, rounding_s=rounding
    )
    fastest = min(fastest_radps(s), 10.0)
    speeds = sorted(share * fastest for share in shares)
    motion = plan_motion(points_of(speeds), s, warm_up)
    peak = peak_of(constants_of(motion), motion.table)
    assert peak.position_max_rad - peak.position_min_rad <= width * (1.0 + 1e-9)
    assert peak.velocity_radps <= max(speeds[-1], s.transit_radps) * (1.0 + 1e-9)
    assert peak.acceleration_radps2 <= acceleration * (1.0 + 1e-9)
    assert peak.position_min_rad == pytest.approx(motion.low_rad, abs=1e-9)
    assert peak.position_max_rad == pytest.approx(motion.high_rad, abs=1e-9)
    for window in motion.windows:
        length_s = window.end_s - window.start_s
        settled_s = [-0.99 * settle] if settle > 0.01 else []
        for after_s in (*settled_s, 0.001 * length_s, 0.5 * length_s, 0.999 * length_s):
            at = reference(motion, window.start_s + after_s)
            assert at.acceleration_radps2 == 0.0
            assert at.velocity_radps == pytest.approx(window.point.velocity_radps, rel=1e-9)
    visited = {(w.point.velocity_radps) for w in motion.windows}
    assert visited == {signed for speed in speeds for signed in (speed, -speed)}


@pytest.mark.parametrize("rounding_s", [0.0, 0.05, 0.5])
def test_the_table_is_continuous_in_position_and_velocity_and_starts_and_ends_at_rest(rounding_s: float) -> None:
    """With a time to change in the acceleration is continuous as well, and takes that long to its peak at least."""
    motion = plan_motion(points_of([0.004, 0.05, 0.5, 2.4]), plan_settings(rounding_s=rounding_s), 0.5)
    steps = np.diff(motion.table[:, 0])
    c0, c1, c2, c3 = motion.table[:-1, 1:].T
    ends = c0 + steps * (c1 + steps * (c2 + steps * c3))
    speeds = c1 + steps * (2.0 * c2 + 3.0 * c3 * steps)
    assert np.all(steps > 0.0)
    assert np.max(np.abs(ends - motion.table[1:, 1])) < 1e-9
    assert np.max(np.abs(speeds - motion.table[1:, 2])) < 1e-9
    assert motion.table[0, 2] == 0.0
    assert motion.table[-1, 2] == 0.0
    if rounding_s:
        accelerations = 2.0 * c2 + 6.0 * c3 * steps
        assert np.max(np.abs(accelerations - 2.0 * motion.table[1:, 3])) < 1e-9
        assert np.max(np.abs(6.0 * c3)) <= 4.0 / rounding_s * (1.0 + 1e-9)


def test_exactly_one_window_completes_each_point() -> None:
    points = points_of([0.004, 0.5, 3.4], passes=2)
    motion = plan_motion(points, plan_settings())
    assert [w.point.index for w in motion.windows if w.last] == [p.index for p in points]
    for point in points:
        own = [w for w in motion.windows if w.point == point]
        assert own[-1].last


@pytest.mark.parametrize("speed", [0.3, 0.5, 1.0, 2.0, 3.0, 3.4])
def test_a_window_covers_whole_ripple_periods_of_the_joint(speed: float) -> None:
    s = plan_settings()
    stroke = stroke_of(speed, s)
    periods = stroke.window_rad / s.joint_period_rad
    assert stroke.teeth == 1
    assert periods == pytest.approx(round(periods))
    assert stroke.strokes * stroke.teeth * stroke.window_rad / stroke.speed_radps >= 0.6 * s.dwell_s


@pytest.mark.parametrize("speed", [0.0035, 0.01, 0.05])
def test_slow_speeds_are_spread_evenly_over_one_ripple_period(speed: float) -> None:
    s = plan_settings()
    stroke = stroke_of(speed, s)
    assert stroke.teeth * stroke.pitch_rad == pytest.approx(s.joint_period_rad)
    assert stroke.window_rad / s.motor_period_rad == pytest.approx(round(stroke.window_rad / s.motor_period_rad))
    motion = plan_motion(points_of([speed]), s)
    starts = [reference(motion, w.start_s).position_rad for w in motion.windows if w.point.direction > 0]
    assert np.diff(starts) == pytest.approx(s.joint_period_rad / stroke.teeth)


def test_fast_speeds_are_repeated_where_the_travel_is_short() -> None:
    s = plan_settings(dwell_s=2.0)
    assert stroke_of(3.4, s).strokes > 1
    assert stroke_of(3.4, plan_settings(dwell_s=2.0, width_rad=60.0)).strokes == 1


def test_the_fastest_speed_just_fits_and_a_little_more_is_refused() -> None:
    s = plan_settings()
    fastest = fastest_radps(s)
    assert stroke_of(fastest * (1.0 - 1e-6), s).length_rad <= s.width_rad
    narrow = plan_settings(width_rad=0.3)  # not even one ripple period of the joint
    assert stroke_of(fastest_radps(narrow) * (1.0 - 1e-6), narrow).length_rad <= narrow.width_rad
    with pytest.raises(UsageError, match=r"speed \(=20 rad/s\) must be at most"):
        stroke_of(20.0, s)
    with pytest.raises(UsageError, match=r"the travel \(=0.0200 rad\) must be more than"):
        fastest_radps(plan_settings(width_rad=0.02))


def test_shifted_moves_the_motion_and_nothing_else() -> None:
    motion = plan_motion(points_of([0.5]), plan_settings())
    moved = shifted(motion, 2.0)
    assert moved.low_rad == pytest.approx(motion.low_rad + 2.0)
    assert np.array_equal(moved.table[:, 2:], motion.table[:, 2:])
    assert reference(moved, 1.0).position_rad == pytest.approx(reference(motion, 1.0).position_rad + 2.0)


def test_the_default_number_of_points_is_kept_to_the_letter() -> None:
    velocities = both_directions(grid_speeds("near-zero", 113, 0.0035, 3.5), 225)
    assert len(velocities) == 225
    assert sum(v > 0.0 for v in velocities) == 113
    assert {v for v in velocities if v > 0.0} - {-v for v in velocities if v < 0.0} == {0.0035}


@pytest.mark.parametrize("grid", ["near-zero", "linear", "log"])
def test_grids_ascend_from_slowest_to_fastest(grid: str) -> None:
    speeds = grid_speeds(grid, 40, 0.004, 3.2)
    assert len(speeds) == 40
    assert np.all(np.diff(speeds) > 0.0)
    assert speeds[-1] == pytest.approx(3.2)
    assert speeds[0] == pytest.approx(0.08 if grid == "linear" else 0.004)


def test_near_zero_is_denser_near_zero_and_linear_is_even() -> None:
    near = np.diff(grid_speeds("near-zero", 50, 0.004, 3.2))
    assert np.all(np.diff(near) > 0.0)
    assert np.ptp(np.diff(grid_speeds("linear", 50, 0.004, 3.2))) < 1e-12
    with pytest.raises(UsageError, match=r"--grid \(=square\) must be one of near-zero, linear, log, list"):
        grid_speeds("square", 3, 0.1, 1.0)


def test_shuffling_keeps_the_points_and_the_pairs_and_repeats_with_its_seed() -> None:
    velocities = both_directions([0.1, 0.2, 0.3, 0.4, 0.5], 10)
    plain, mixed = ordered_points(velocities, 2, None), ordered_points(velocities, 2, 7)
    assert sorted(p.velocity_radps for p in plain) == sorted(p.velocity_radps for p in mixed)
    assert [p.index for p in mixed] == list(range(20))
    assert [abs(p.velocity_radps) for p in mixed[::2]] == [abs(p.velocity_radps) for p in mixed[1::2]]
    assert mixed == ordered_points(velocities, 2, 7)
    assert mixed != ordered_points(velocities, 2, 8)
    assert [p.velocity_radps for p in mixed[:10]] != [p.velocity_radps for p in mixed[10:]]
    assert [p.pass_number for p in plain] == [0] * 10 + [1] * 10


def test_the_hash_tells_plans_apart() -> None:
    points = points_of([0.1, 0.2])
    assert plan_hash(points, {"dwell_s": 1.0}) == plan_hash(points_of([0.1, 0.2]), {"dwell_s": 1.0})
    assert plan_hash(points, {"dwell_s": 1.0}) != plan_hash(points, {"dwell_s": 1.1})
    assert plan_hash(points, {"dwell_s": 1.0}) != plan_hash(points[:3], {"dwell_s": 1.0})
    assert plan_hash(points, {"dwell_s": 1.0}) != plan_hash(points_of([0.2, 0.1]), {"dwell_s": 1.0})


def test_a_list_of_velocities(tmp_path: Path) -> None:
    file = tmp_path / "speeds.txt"
    file.write_text("velocity_radps\n0.1  # slow\n\n-0.1\n2\n")
    assert listed_velocities(file) == [0.1, -0.1, 2.0]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"0.1\nfast\n", r"line 2 \(=fast\) must be a velocity"),
        (b"0.1\n0\n", r"line 2 \(=0\) must be a velocity"),
        (b"nan\n", r"line 1 \(=nan\) must be a velocity"),
        (b"0.1\n0.2\n0.10\n", r"line 3 \(=0.10\) is a velocity that the list already has"),
        (b"# nothing\n", "holds no velocities"),
        (b"\xff\xfe1", "byte 0 is not UTF-8"),
    ],
)
def test_a_bad_list_is_one_line(tmp_path: Path, content: bytes, text: str) -> None:
    file = tmp_path / "speeds.txt"
    file.write_bytes(content)
    with pytest.raises(DataError, match=text) as error:
        listed_velocities(file)
    assert "\n" not in error.value.message
    with pytest.raises(DataError, match="cannot be read"):
        listed_velocities(tmp_path / "none.txt")


def test_warm_up_travels_the_turns_asked_for() -> None:
    s = plan_settings()
    points = points_of([3.0])
    cold, warm = plan_motion(points, s), plan_motion(points, s, 2.0)
    assert warm.high_rad - warm.low_rad <= s.width_rad
    way = math.tau * 2.0
    assert warm.duration_s - cold.duration_s >= way / s.transit_radps
    assert warm.windows[0].start_s - cold.windows[0].start_s == pytest.approx(
        warm.duration_s - cold.duration_s, rel=0.3
    )


def test_further_passes_begin_with_the_turns_that_warm_the_joint() -> None:
    s = plan_settings()
    points = points_of([3.0], passes=2)
    plain, between = plan_motion(points, s), plan_motion(points, s, 0.0, 2.0)
    assert between.duration_s - plain.duration_s >= math.tau * 2.0 / s.transit_radps
    first = [w for w in between.windows if w.point.pass_number == 0]
    assert [w.end_s for w in first] == [w.end_s for w in plain.windows if w.point.pass_number == 0]
    assert plan_motion(points_of([3.0]), s, 0.0, 2.0).duration_s == plan_motion(points_of([3.0]), s).duration_s


def test_every_load_at_every_place_has_its_passes_and_the_hash_tells_them_apart() -> None:
    options = SweepOptions(loads_Nm=[0.0, 5.0], places_rad=[-0.3, 0.4])
    points = ordered_points([0.1, -0.1], 2, None, options.conditions)
    assert [(p.condition.load_Nm, p.condition.place_rad) for p in points[::4]] == [
        (0.0, -0.3), (0.0, 0.4), (5.0, -0.3), (5.0, 0.4),
    ]  # fmt: skip
    assert [p.pass_number for p in points[::2]] == list(range(8))
    plain = ordered_points([0.1, -0.1], 8, None)
    assert plan_hash(points, {}) != plan_hash(plain, {})


# --- Options of a sweep against the joint: every bad one is a single line, and the defaults fit ---
SWEEP = shipped_config("sweep_virtual")


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(SWEEP)


def limited(config: Config, **limits: float) -> Config:
    return config.changed(limits=limits)


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
        ({"warm_between_turns": 5.0}, r"--warm-between \(=5\) needs --passes of 2 or more, or loads"),
        ({"warm_between_turns": -1.0, "passes": 2}, r"--warm-between \(=-1\) must be in \[0..1000\]"),
        ({"loads_Nm": [5.0, 5.0]}, r"--load-Nm \(=5, 5\) must differ"),
        ({"loads_Nm": [math.inf]}, r"--load-Nm \(=inf\) must be in"),
        ({"loads_Nm": [0.0, 5.0], "assume_yes": True}, r"-y does not go with --load-Nm of several loads"),
        ({"places_rad": [3.2]}, r"--at \(=3.2\) must be in \(-3.1..3.1\) rad, inside the limits"),
    ],
)
def test_a_bad_option_is_one_line_with_exit_code_2(config: Config, options: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError, match=text) as error:
        make_plan(config, SweepOptions(**options))
    assert error.value.exit_code == 2
    assert "\n" not in error.value.message


def test_the_travel_is_the_same_about_each_place_and_inside_the_limits(config: Config) -> None:
    plan = make_plan(config, SweepOptions(places_rad=[-1.0, 2.0], points=24))
    low, high = config.limits.position_min_rad, config.limits.position_max_rad
    half = 0.5 * plan.settings.width_rad
    assert half == pytest.approx(high - config.limits.following_error_max_rad - 2.0)
    assert low < -1.0 - half
    motion = plan.motion(plan.points[:24], 0.0)
    assert max(-motion.low_rad, motion.high_rad) <= half + 1e-9


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
        sweep(config, output()[0], out, SweepOptions(**options))
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
    assert with_mode(config, "torque").drive == config.drive
    assert canopen_section(with_mode(config, "csv")).mode == "csv"
    with pytest.raises(UsageError, match=r"--mode \(=fast\) must be one of auto, csv, pv, speed, torque"):
        with_mode(config, "fast")
    with pytest.raises(DeviceError, match=r"--mode \(=speed\) must be auto, csv, pv or torque"):
        with_mode(config, "speed")


def test_modes_of_a_serial_drive() -> None:
    serial = load_config(shipped_config("elmo_serial"))
    assert elmo_section(serial).unit_mode == "torque"  # what `run` gets
    for mode in ("auto", "speed", "torque"):
        assert elmo_settings(with_mode(serial, mode)).mode == mode
    assert elmo_settings(serial).ramp_radps2 > ACCELERATION_SPARE * serial.sequence.brake_radps2
    with pytest.raises(DeviceError, match=r"--mode \(=csv\) must be auto, speed or torque"):
        with_mode(serial, "csv")


def test_a_law_without_integral_action_gets_an_observer_for_torque_mode() -> None:
    network = load_config(shipped_config("virtual"))
    assert network.control.kind == "computed_torque_rbf"
    changed = with_tracking_law(network).control
    assert (changed.kind, changed.observer_radps > 0.0, changed.learning) == ("computed_torque_observer", True, None)
    observer = load_config(SWEEP)
    assert with_tracking_law(observer).control == observer.control


def test_the_joints_own_friction_is_not_the_controllers(config: Config, tmp_path: Path) -> None:
    assert config.friction is None
    true = plant_settings(config)["friction"]
    assert float(true.positive.coulomb_Nm) == 0.138
    other = edited(tmp_path, ("tc_Nm = 0.138", "tc_Nm = 0.15"), base="sweep_virtual")
    assert float(plant_settings(other)["friction"].positive.coulomb_Nm) == 0.15


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("tc_Nm = 0.138", "tc_Nm = -1.0", "virtual.friction.positive.tc_Nm (=-1) must be in [0..10000]"),
        ("tc_Nm = 0.138", "tc = 0.138", "virtual.friction.positive.tc is not a known key"),
        ("knee = 40.0", "knee = 400.0", "virtual.friction.positive.knee (=400) and max (=205) must be"),
        ("a0 = -0.175", "a0 = 3.0", "virtual.friction.negative: a0..a3 must give friction that opposes"),
        ('mode = "cst"', 'velocity_unit = "rpm"\nmode = "cst"', "drive.velocity_unit (=rpm) must be one of 'counts/s'"),
        ('mode = "cst"', 'mode = "pv"', "drive.mode (=pv) must be one of 'cst', 'tq', 'auto', 'csp' or 'csv'"),
        ('mode = "cst"', 'mode = "csv"', "[drive.cascade] is missing: drive.mode (=csv) needs it"),
    ],
)
def test_a_bad_key_of_the_sweeps_configuration_is_one_line(tmp_path: Path, old: str, new: str, text: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        edited(tmp_path, (old, new), base="sweep_virtual")
    assert text in error.value.message


@pytest.mark.parametrize(("count", "end"), [(8, "+0.8 rad/s"), (9, "+0.8 rad/s and 1 more")])
def test_speeds_that_are_not_listed_are_counted(count: int, end: str) -> None:
    assert _speeds([SweepPoint(i, 0.1 * (i + 1), 0) for i in range(count)]).endswith(end)

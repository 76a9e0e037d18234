"""`map` on the virtual joint in simulated time: what the joint truly has is found and written."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError, MarginError, MotionFault, UsageError
from jointctl.tools.analysis.reducer_map import FoundMap, Wave, found_map
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.output import Output
from jointctl.tools.verbs.map import MapOptions, _table, config_of_map, map_run, map_verb
from tests.configurations import shipped, written

IN_LOCKSTEP = MapOptions(travel_rad=0.5, lockstep=True)


def test_the_map_of_the_realistic_joint_is_found_and_written(tmp_path: Path) -> None:
    path = written(tmp_path / "joint.toml", "realistic", reducer__map=None)
    text = path.read_text()
    out = io.StringIO()
    output = Output(json=True, stdout=out, stderr=io.StringIO())
    assert map_verb(load_config(path), output, options=IN_LOCKSTEP, write=True, figure=tmp_path / "map.png") == 0
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    found = load_config(path)
    assert found.reducer.map is not None
    assert found.virtual is not None
    made, true = found.reducer.map, found.virtual
    kinematic = dict(zip(made.kinematic_error_per_motor_turn, made.kinematic_error_rad, strict=True))
    assert [kinematic[order] for order in (2.0, 4.0)] == pytest.approx(true.kinematic_error_rad, rel=0.03)
    assert kinematic[1.0] == pytest.approx(true.motor_encoder_eccentricity_rad / 121.0, rel=0.05)
    ripple = dict(zip(made.torque_ripple_per_motor_turn, made.torque_ripple_Nm, strict=True))
    assert [ripple[order] for order in (2.0, 10.0)] == pytest.approx(true.torque_ripple_Nm, rel=0.06)
    phases = dict(zip(made.torque_ripple_per_motor_turn, made.torque_ripple_phase_rad, strict=True))
    assert [phases[order] for order in (2.0, 10.0)] == pytest.approx(true.torque_ripple_phase_rad, abs=0.06)
    comments = [line.split("#", 1)[1] for line in text.splitlines() if "#" in line]
    assert all(comment in path.read_text() for comment in comments)
    assert json.loads(out.getvalue())["map"]["direction"] == found.encoder.direction


def test_what_cannot_be_measured_or_written_is_refused_before_anything_moves(tmp_path: Path) -> None:
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    with pytest.raises(ConfigurationError, match="is a shipped configuration and is not changed"):
        map_verb(load_config(shipped_config("realistic")), output, options=IN_LOCKSTEP, write=True)

    path = written(
        tmp_path / "link.toml", "realistic", joint_encoder=None, reducer__map=None, encoder__side="joint",
        encoder__counts_per_turn=2**20, control__kp=209.0, control__kv=12.0, control__observer_radps=29.0,
        control__velocity_cutoff_Hz=11.0,
    )  # fmt: skip
    with pytest.raises(ConfigurationError, match=r"encoder.side \(=joint\) must be motor"):
        map_verb(load_config(path), output, options=IN_LOCKSTEP, write=True, figure=tmp_path / "map.png")
    assert not (tmp_path / "map.png").exists()


def test_the_ripple_of_a_rigid_joint_is_found_written_and_lowers_the_error_before_anything_was_learned(
    tmp_path: Path,
) -> None:
    path = written(tmp_path / "rigid.toml", "precise", control__learning=None, trajectory__duration_s=20.0)
    before = load_config(path)
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    assert map_verb(before, output, options=IN_LOCKSTEP, write=True, figure=tmp_path / "map.png") == 0
    after = load_config(path)
    found = dict(zip(after.ripple.per_motor_turn, after.ripple.torque_Nm, strict=True))
    assert [found[order] for order in (2.0, 10.0)] == pytest.approx(after.virtual.torque_ripple_Nm, rel=0.15)
    rms = []
    for config in (before, after):
        run = LockstepJoint(config).run()
        assert not run.fault
        error = run.true_error_rad[run.tracking & (run.log.trajectory_s < 10.0)]
        rms.append(float(np.sqrt(np.mean(error**2))))
    assert rms[1] < 0.8 * rms[0]


@pytest.mark.parametrize("kv", [30.0, 40.0])
def test_bristles_that_follow_a_quick_swing_late_leave_the_ripple_in_its_interval(tmp_path: Path, kv: float) -> None:
    light = {"joint__inertia_kgm2": 0.82, "reducer__motor_inertia_kgm2": 0.43, "virtual__motor_side_inertia_kgm2": 0.43}
    config = load_config(
        written(
            tmp_path / "light.toml", "realistic", **light, reducer__map=None, control__kp=1.5 * kv**2, control__kv=kv,
            virtual__bristle_stiffness_Nmprad=4e4,
        )
    )  # fmt: skip
    moving = config_of_map(config, IN_LOCKSTEP)
    run = LockstepJoint(moving).run()
    assert not run.fault
    ripple = found_map(map_run(moving, run.log, 0.0015)).ripple_Nm[9]
    assert abs(ripple.amplitude - config.virtual.torque_ripple_Nm[1]) < ripple.amplitude_half < 0.4 * ripple.amplitude


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (MapOptions(travel_rad=0.1), r"--travel \(=0.1\) must be in \[0.2077..1.2\] rad"),
        (MapOptions(travel_rad=2.0), r"--travel \(=2\) must be in"),
        (MapOptions(travel_rad=math.nan), r"--travel \(=nan\) must be in"),
        (MapOptions(speed_radps=0.0), r"--speed \(=0\) must be in \[0\.000194\.\.0\.5\] rad/s"),
        (MapOptions(speed_radps=0.6), r"--speed \(=0.6\) must be in \[0\.000194"),
    ],
)
def test_a_motion_that_does_not_fit_is_one_clear_line(options: MapOptions, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        config_of_map(shipped("realistic"), options)


def test_with_a_small_ratio_four_motor_turns_are_travelled_where_the_limits_allow() -> None:
    slow = {"joint__reduction_ratio": 30.0, "limits__position_min_rad": -0.8, "limits__position_max_rad": 0.8}
    motion = config_of_map(shipped("realistic", **slow), MapOptions()).trajectory
    assert motion.kind == "trapezoid"
    assert motion.target_rad - motion.start_rad == pytest.approx(4.0 * math.tau / 30.0)
    with pytest.raises(UsageError, match=r"--travel \(=0.7\) must be in \[0.8378..1.4\] rad"):
        config_of_map(shipped("realistic", **slow), MapOptions(travel_rad=0.7))


def test_the_motion_stays_within_the_limits_and_learns_nothing() -> None:
    config = config_of_map(shipped("realistic"), MapOptions())
    assert config.trajectory.kind == "trapezoid"
    assert config.control.learning is None
    assert config.trajectory.target_rad - config.trajectory.start_rad == pytest.approx(0.7)
    assert config.limits.position_min_rad < config.trajectory.start_rad


def test_in_simulated_time_the_gate_and_a_dry_run_are_those_of_the_joint(tmp_path: Path) -> None:
    stiff = load_config(written(tmp_path / "stiff.toml", "realistic", control__kp=3600.0, control__kv=120.0))
    err = io.StringIO()
    output = Output(stdout=io.StringIO(), stderr=err)
    figure = tmp_path / "map.png"
    with pytest.raises(MarginError, match=r"phase margin \(=23.7 deg\) must be at least 30 deg"):
        map_verb(stiff, output, options=IN_LOCKSTEP, figure=figure)
    assert map_verb(stiff, output, options=IN_LOCKSTEP, figure=figure, dry_run=True) == 0
    assert "dry run: nothing moved" in err.getvalue()
    assert not figure.exists()
    assert map_verb(stiff, output, options=IN_LOCKSTEP, figure=figure, allow_low_margin=True) == 0
    assert figure.exists()


def test_the_faults_of_the_virtual_joint_end_a_map_in_simulated_time(tmp_path: Path) -> None:
    faulty = load_config(
        written(
            tmp_path / "faulty.toml",
            "realistic",
            virtual__faults=[{"kind": "drive_fault", "at_s": 3.0, "magnitude": 0x7300}],
        )
    )
    with pytest.raises(MotionFault, match=r"DRIVE_FAULT \(\d+\): .*'s error code is 7300h, .*; no map") as fault:
        map_verb(faulty, Output(stdout=io.StringIO(), stderr=io.StringIO()), options=IN_LOCKSTEP)
    assert "likely cause: " in (fault.value.hint or "")


@pytest.mark.parametrize(("start_rad", "outside"), [(0.71, True), (-0.71, True), (0.69, False)])
def test_a_dry_run_says_that_the_joint_stands_outside_its_limits(
    tmp_path: Path, start_rad: float, outside: bool
) -> None:
    joint = load_config(written(tmp_path / "joint.toml", "realistic", virtual__initial_position_rad=start_rad))
    err = io.StringIO()
    assert map_verb(joint, Output(stdout=io.StringIO(), stderr=err), options=IN_LOCKSTEP, dry_run=True) == 0
    assert ("outside limits.position_*: not enabled there" in err.getvalue()) is outside


def test_small_ripple_is_shown_with_the_digits_of_its_interval() -> None:
    """0.002 Nm with an interval of 0.000 said nothing."""
    table = _table(FoundMap((), (Wave(2, 0.001998, 7.4e-5, 0.0, 0.04, True),), (10, 10), 0.03))
    assert [next(iter(column.cells)) for column in table.columns[2:4]] == ["0.001998", "0.000074"]

"""Identification from any motion: what is found again, what is untold, which data are refused, and real joints."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomlkit

import jointctl
from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.identification.identification import Options
from jointctl.tools.identification.models import FORMS
from jointctl.tools.identification.motion_data import Motion, MotionSettings, joined, motion_of_plateaus
from jointctl.tools.identification.motion_fit import MotionFit, identify_motion
from jointctl.tools.identification.motion_report import (
    motion_remarks,
    motion_section,
    prediction_figure,
    residual_figure,
)
from jointctl.tools.identification.motion_table import read_motion
from jointctl.tools.identification.plausibility import JointLimits, check_motion
from jointctl.tools.identification.swarm import SwarmSettings
from jointctl.tools.identification.tables import ForeignFormat
from jointctl.tools.recording.run_log import RunLogWriter
from jointctl.tools.sweeping.carry_out import MeasuredPoint, PlateauResult
from jointctl.tools.sweeping.data_file import SweepFile
from jointctl.tools.sweeping.options import SweepPoint
from jointctl.tools.verbs.identify import identify, motion_from
from tests.page_figures import foreign_colours, svgs
from tests.places import PUBLIC_DATA
from tests.unit.identification.synthetic_friction import output
from tests.unit.identification.synthetic_motion import FORMAT, RATIO, TrueJoint, motion_columns, read, write_table

pytestmark = pytest.mark.usefixtures("undrawn")
SETTINGS = MotionSettings()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("motion")


@pytest.fixture(scope="module")
def loaded(folder) -> tuple[TrueJoint, MotionFit]:
    """A joint with gravity, whose friction grows with the torque that it transmits and falls as it warms up."""
    joint = TrueJoint(load_coulomb=0.2, load_viscous_spr=0.1, coulomb_perK=0.01, viscous_perK=0.03)
    columns = motion_columns(joint, warming_K=30.0, seconds=90.0, seed=5)
    motion = read(folder / "loaded.csv", columns, temperature_column="warmth")
    return joint, identify_motion(motion, SETTINGS)


# --- what is found again ---


def test_every_parameter_of_a_known_joint_is_found_within_its_interval(loaded):
    joint, found = loaded
    warm = found.reference_degC - 40.0  # the middle of the warming, where the true joint counts from
    coulomb, viscous = math.exp(-joint.coulomb_perK * warm), math.exp(-joint.viscous_perK * warm)
    truth = {
        "inertia": joint.inertia_kgm2,
        "gravity_sin": joint.gravity_Nm * math.cos(joint.gravity_zero_rad),
        "gravity_cos": -joint.gravity_Nm * math.sin(joint.gravity_zero_rad),
        "load_coulomb": joint.load_coulomb * coulomb,
        "load_viscous": joint.load_viscous_spr * viscous,
        "temperature_coulomb": joint.coulomb_perK,
        "temperature_viscous": joint.viscous_perK,
        "tc positive": joint.coulomb_Nm[0] * coulomb,
        "tc negative": joint.coulomb_Nm[1] * coulomb,
        "tv positive": joint.viscous_Nmspr * viscous,
        "tv negative": joint.viscous_Nmspr * viscous,
    }
    assert found.model.form is FORMS["stribeck"]
    outside = {
        name: (true, found.parameters[name])
        for name, true in truth.items()
        if not found.parameters[name].low <= true <= found.parameters[name].high
    }
    assert len(outside) <= 1, outside
    for name, true in truth.items():
        assert found.parameters[name].value == pytest.approx(true, rel=0.15), name
    assert found.to_dict()["gravity"]["zero_rad"] == pytest.approx(joint.gravity_zero_rad, abs=0.03)


@pytest.mark.parametrize(("low", "held"), [(-0.1, True), (0.0, True), (0.1, False)])
def test_a_rise_that_may_be_none_is_written_as_far_as_it_was_measured(loaded, low, held):
    _, found = loaded
    unsure = {**found.parameters, "rise positive": replace(found.parameters["rise positive"], low=low)}
    found = replace(found, parameters=unsure)
    whole, written = found.branches(), motion_section(found)
    one = whole["positive"]
    least = one.torque_Nm(np.array([SETTINGS.speed_min_radps]))[0] - one.viscous_Nmspr * SETTINGS.speed_min_radps
    assert written["positive"]["ts_Nm"] == pytest.approx(least if held else one.static_Nm)
    assert least < 0.95 * one.static_Nm
    assert written["negative"]["ts_Nm"] == pytest.approx(whole["negative"].static_Nm)
    assert any(line.startswith("ts_Nm positive: that of 0.05 rad/s") for line in motion_remarks(found)) is held


def test_the_held_out_error_is_the_noise_and_halves_where_the_extension_is_allowed(loaded):
    _, found = loaded
    assert found.rmse_Nm(odd=True) < 1.15 * 0.3
    before = next(step for step in found.steps if step.name == "stribeck")
    assert found.rmse_Nm(odd=True) < 0.5 * before.held_out_rmse_Nm


def test_no_term_comes_in_that_the_joint_does_not_have(folder):
    columns = motion_columns(TrueJoint(), seed=2)
    found = identify_motion(read(folder / "plain.csv", columns), SETTINGS)
    assert not found.model.terms & {"load-viscous", "temperature-coulomb", "temperature-viscous"}
    assert found.value.get("load_coulomb", 0.0) < 0.03


def test_a_known_load_gives_the_scale_of_the_torque_too(folder):
    columns = motion_columns(TrueJoint(load_coulomb=0.2), load_Nm=20.0, seed=3)
    columns["load"] = columns["load"] / 0.9  # the masses are thought to be larger than they are
    found = identify_motion(read(folder / "known.csv", columns, load_column="load"), SETTINGS)
    assert found.parameters["load_scale"].value == pytest.approx(-0.1, abs=0.02)
    assert found.parameters["load_coulomb"].value == pytest.approx(0.2, abs=0.04)
    assert not any("torque constant" in line for line in found.untold)


def plateaus(path: Path, joint: TrueJoint, noise_Nm: float = 0.05) -> Path:
    """A sweep of `joint` under three loads, each cold and warm, as `sweep` writes it."""
    random = np.random.default_rng(4)
    file = SweepFile.create(path, RATIO, 0.1, "abc", {"loaded": True})
    speeds = np.geomspace(0.01, 1.0, 20)
    moves = [(load, warm, side * v) for load in (-15.0, 0.0, 15.0) for warm in (0.0, 20.0) for v in speeds
             for side in (1.0, -1.0)]  # fmt: skip
    for index, (load, warm, v) in enumerate(moves):
        torque = float(joint.torque_Nm(0.0, v, 0.0, load, warm)) - load + noise_Nm * random.standard_normal()
        result = PlateauResult(v, torque / RATIO, 0.001, 0.001, 900, -0.1, 0.1, 1e-4, "")
        file.add(MeasuredPoint(SweepPoint(index, v, 0), result, 3.0 * index, 25.0 + warm, load))
    file.close()
    return path


def test_a_sweep_under_loads_cold_and_warm_gives_their_terms(tmp_path):
    joint = TrueJoint(gravity_Nm=0.0, load_coulomb=0.1, load_viscous_spr=0.05, coulomb_perK=0.006, viscous_perK=0.02)
    data = plateaus(tmp_path / "loads.csv", joint)
    out = output(json=True)
    assert identify(data, out, out=tmp_path / "found.toml", options=Options()) == 0
    assert "samples, which takes some seconds" in out.stderr.getvalue()
    found = json.loads(out.stdout.getvalue())
    assert set(found["terms"]) >= {"load-coulomb", "load-viscous", "temperature-coulomb", "temperature-viscous"}
    true = {"load_coulomb": 0.1, "load_viscous": 0.05, "temperature_coulomb": 0.006, "temperature_viscous": 0.02}
    # friction at T0, the middle: the sizes are those of 25 degC times a factor
    cool = np.exp(-0.006 * (found["reference_degC"] - 25.0)), np.exp(-0.02 * (found["reference_degC"] - 25.0))
    factor = {"load_coulomb": cool[0], "load_viscous": cool[1]}
    for name, value in true.items():
        parameter = found["parameters"][name]
        assert parameter["low"] <= value * factor.get(name, 1.0) <= parameter["high"], name
    assert found["held_out_rmse_Nm"] < 2.0 * 0.05


def test_a_sweep_without_loads_is_fitted_as_always(tmp_path):
    data = plateaus(tmp_path / "loads.csv", TrueJoint(gravity_Nm=0.0))
    heading, *rows = data.read_text().splitlines()
    data.write_text("\n".join(line.rsplit(",", 1)[0] for line in (heading, *rows)) + "\n")
    assert motion_of_plateaus(data, ForeignFormat()) is None


def test_a_cold_and_a_warm_motion_together_tell_the_temperature(tmp_path):
    joint = TrueJoint(coulomb_perK=0.01, viscous_perK=0.03)
    cold = motion_columns(joint, seconds=30.0, seed=1)
    warm = motion_columns(joint, seconds=30.0, seed=2)
    warm["warmth"] = warm["warmth"] + 20.0
    warm["tau"] = _at(joint, warm, 20.0)
    settings = replace(SETTINGS, also=(write_table(tmp_path / "warm.csv", warm),))
    given = replace(FORMAT, temperature_column="warmth")
    motion = motion_from(write_table(tmp_path / "cold.csv", cold), given, settings)
    assert np.all(np.diff(motion.time_s) > 0.0)
    assert np.count_nonzero(~motion.whole) > 2  # nothing is used across the joint of both files
    found = identify_motion(motion, settings)
    assert found.parameters["temperature_viscous"].value == pytest.approx(0.03, rel=0.2)
    assert found.parameters["temperature_coulomb"].value == pytest.approx(0.01, rel=0.25)


def _at(joint, columns, warming_K):
    """The torque of the same motion at another temperature, with its noise."""
    t, q = columns["t"], columns["q"]
    v, a = np.gradient(q, t), np.gradient(np.gradient(q, t), t)
    return columns["tau"] - joint.torque_Nm(q, v, a) + joint.torque_Nm(q, v, a, None, warming_K)


@pytest.mark.parametrize(
    ("change", "also", "message"),
    [
        ({"ratio": 50.0}, "b.csv", r"a.csv: reduction ratio \(=100\) must be that of .*b.csv \(=50\)"),
        ({"load_column": "load"}, "b.csv", r"a known load in one file and none in another"),
    ],
)
def test_motions_that_do_not_go_together_are_refused(tmp_path, change, also, message):
    one = read(tmp_path / also, motion_columns(seconds=10.0, load_Nm=5.0), **change)
    two = read(tmp_path / "a.csv", motion_columns(seconds=10.0))
    with pytest.raises(DataError, match=message):
        joined([one, two])


def test_a_further_file_must_be_a_motion(tmp_path):
    data = write_table(tmp_path / "move.csv", motion_columns(seconds=10.0))
    log = run_log(tmp_path / "run.mcap", motion_columns(seconds=10.0))
    with pytest.raises(DataError, match=r"x\.csv: no such file"):
        motion_from(log, ForeignFormat(), replace(SETTINGS, also=(tmp_path / "x.csv",)))
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"x\.csv: is no motion in time"):
        motion_from(log, ForeignFormat(), replace(SETTINGS, also=(tmp_path / "x.csv",)))
    sweep = plateaus(tmp_path / "s.csv", TrueJoint())
    with pytest.raises(UsageError, match=r"--also does not apply to .*s\.csv, which holds plateaus"):
        identify(sweep, output(), options=Options(motion=replace(SETTINGS, also=(data,))))


def test_options_that_a_motion_has_no_use_for_are_refused(tmp_path):
    data = run_log(tmp_path / "run.mcap", motion_columns(seconds=10.0))
    for change, flag in (
        ({"model": "stribeck"}, "--model"),
        ({"folds": 3}, "--folds"),
        ({"ws_max_radps": 0.1}, "--ws-max"),
    ):
        with pytest.raises(UsageError, match=rf"{flag} does not apply to .*run\.mcap, which holds motions"):
            identify(data, output(), options=Options(**change))
    with pytest.raises(UsageError, match=r"--seed \(=-1\) must be in"):
        identify(data, output(), options=Options(swarm=SwarmSettings(seed=-1)))
    for given in (ForeignFormat(side="motor"), ForeignFormat(where=("a=1",)), ForeignFormat(velocity_column="v")):
        with pytest.raises(UsageError, match="does not apply to a run log"):
            motion_from(data, given, SETTINGS)
    with pytest.raises(UsageError, match="--temperature-unit does not apply to a motion in time with the columns"):
        read(tmp_path / "a.csv", motion_columns(seconds=10.0), temperature_unit="K")


def test_single_wild_samples_do_not_move_the_result(folder):
    columns = motion_columns(TrueJoint(), seed=2)
    wild = np.random.default_rng(0).random(len(columns["t"])) < 0.005
    spoiled = {**columns, "tau": np.where(wild, 80.0, columns["tau"])}
    found = identify_motion(read(folder / "wild.csv", spoiled), SETTINGS)
    assert found.parameters["inertia"].value == pytest.approx(2.0, rel=0.1)
    assert found.parameters["tc positive"].value == pytest.approx(6.0, rel=0.1)


def test_both_halves_of_the_blocks_see_both_directions(folder):
    """One slow stroke there and one back: halves of eighths would do, eighths of quarters would not."""
    t = np.arange(0.0, 80.0, 0.01)
    w = 2.0 * np.pi / 80.0
    q, v, a = 8.0 * np.sin(w * t), 8.0 * w * np.cos(w * t), -8.0 * w * w * np.sin(w * t)
    tau = TrueJoint().torque_Nm(q, v, a) + 0.1 * np.random.default_rng(0).standard_normal(len(t))
    found = identify_motion(read(folder / "stroke.csv", {"t": t, "q": q, "tau": tau}), SETTINGS)
    used = found.motion.used(SETTINGS)
    for sign in (1.0, -1.0):
        mine = used & (sign * found.motion.velocity_radps > 0.0)
        assert 0.2 <= np.mean(found.block[mine] % 2) <= 0.8


# --- what the data cannot tell ---


def untold_of(folder, columns, **change):
    return " | ".join(identify_motion(read(folder / "untold.csv", columns, **change), SETTINGS).untold)


def test_each_thing_that_cannot_be_told_is_named_with_the_experiment_that_would(folder):
    forward = motion_columns(TrueJoint(), seconds=30.0)
    t, slow = forward["t"], 0.3 * forward["t"]
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(t))
    still = np.zeros_like(t)
    constant = TrueJoint().torque_Nm(slow, np.full_like(t, 0.3), still) + noise
    text = untold_of(folder, {"t": t, "q": slow, "tau": constant})
    assert "q: no reversal" in text
    assert "move both ways" in text
    assert "q: constant speed only (0.3 to 0.3 rad/s)" in text
    assert "temperature: not in these data" in text
    assert "tau: its scale (the torque constant) stays unknown without a known load" in text
    text = untold_of(folder, forward, temperature_column="warmth")
    assert "temperature: constant within 0 K: measure cold, and again 15 K warmer" in text
    assert "no reversal" not in text
    one_way = {"t": t, "q": slow, "tau": TrueJoint().torque_Nm(slow, np.full_like(t, 0.3), still, 9.0 * np.sin(slow))}
    text = untold_of(folder, {**one_way, "load": 10.0 * np.sin(slow)}, load_column="load")
    assert "one direction only cannot tell load friction from an error of the torque constant" in text


def test_one_sine_and_a_ripple_that_repeats_with_the_angle_are_named(loaded, folder):
    t = np.arange(0.0, 60.0, 0.005)
    w = 2.0 * np.pi * 0.2
    q, v, a = 0.6 * np.sin(w * t), 0.6 * w * np.cos(w * t), -0.6 * w * w * np.sin(w * t)
    noise = 0.1 * np.random.default_rng(1).standard_normal(len(t))
    plain = {"t": t, "q": q, "tau": TrueJoint().torque_Nm(q, v, a) + noise}
    text = untold_of(folder, plain)
    assert "q: the acceleration goes with the angle, as in a single sine" in text
    assert "repeats with the angle" not in text
    text = untold_of(folder, {**plain, "tau": plain["tau"] + 0.8 * np.sin(40.0 * q)})
    assert "tau: the residual repeats with the angle" in text
    assert not any("the acceleration goes with" in line for line in loaded[1].untold)  # of several sines


def test_without_a_way_gravity_is_not_made_up(folder):
    t = np.arange(0.0, 30.0, 0.005)
    w = 2.0 * np.pi * 1.3
    q, v, a = 0.05 * np.sin(w * t), 0.05 * w * np.cos(w * t), -0.05 * w * w * np.sin(w * t)
    tau = TrueJoint(gravity_Nm=0.0).torque_Nm(q, v, a) + 0.1 * np.random.default_rng(1).standard_normal(len(t))
    found = identify_motion(read(folder / "small.csv", {"t": t, "q": q, "tau": tau}), SETTINGS)
    assert "gravity" not in found.model.terms
    assert any("gravity cannot be separated from friction: move over 1 rad or more" in line for line in found.untold)


# --- data that are wrong, one line that names the column and what was seen ---

WITH_VELOCITY = {"velocity_column": "v", "velocity_unit": "rad/s"}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: {**c, "v": np.degrees(c["v"])}, r"v: is 57.\d* times the slope of q: one of them is in degrees"),
        (lambda c: {**c, "v": np.radians(c["v"])}, r"v: is 0.0174\d* times the slope of q: one of them is in degrees"),
        (lambda c: {**c, "v": 100.0 * c["v"]}, r"v: is 100 times the slope of q: one of them is of the motor"),
        (lambda c: {**c, "q": 100.0 * c["q"]}, r"v: is 0.01 times the slope of q: one of them is of the motor"),
        (lambda c: {**c, "v": -c["v"]}, r"v: is -1 times the slope of q: must be near 1"),
        (lambda c: {**c, "v": 1.5 * c["v"]}, r"v: is 1.5 times the slope of q: must be near 1"),
        (lambda c: {**c, "t": np.where(c["t"] > 5.0, c["t"] - 2.0, c["t"])}, r"t: does not go on at sample 1002: 5 s"),
        (
            lambda c: {**c, "tau": np.clip(c["tau"], -3.0, 3.0)},
            r"tau: is at its greatest or least value in \d+% of the samples",
        ),
        (lambda c: {**c, "tau": 0.0 * c["tau"]}, r"tau: is zero throughout"),
        (lambda c: {**c, "tau": -c["tau"]}, r"tau: friction at \w+ velocity would drive the motion"),
        (lambda c: {**c, "q": 0.01 * c["q"], "v": 0.01 * c["v"]}, r"v: 0 of \d+ samples are faster than 0.05 rad/s"),
        (lambda c: {**c, "q": 300.0 * c["q"], "v": 300.0 * c["v"]}, r"v: reaches \d+\.?\d* rad/s of the joint"),
        (lambda c: {name: values[:150] for name, values in c.items()}, r"t: 150 samples: at least 200 are needed"),
    ],
)
def test_wrong_data_are_refused_with_the_column_and_what_was_seen(tmp_path, spoil, message):
    columns = spoil(motion_columns(seconds=20.0))
    with pytest.raises(DataError, match=message) as caught:
        identify_motion(read(tmp_path / "wrong.csv", columns, **WITH_VELOCITY), SETTINGS)
    assert "\n" not in caught.value.message


def test_a_torque_on_the_wrong_side_shows_against_a_known_load(tmp_path):
    columns = motion_columns(seconds=20.0, load_Nm=60.0)
    columns["tau"] = columns["tau"] / 100.0
    with pytest.raises(DataError, match=r"tau: goes with 0\.0\d+ times load, near the ratio"):
        read(tmp_path / "side.csv", columns, load_column="load")


def test_gaps_and_some_saturation_are_told_and_not_used(tmp_path):
    columns = motion_columns(seconds=30.0)
    columns["tau"] = np.clip(columns["tau"], None, 14.0)
    columns["t"] = np.where(columns["t"] > 10.0, columns["t"] + 0.7, columns["t"])
    motion = read(tmp_path / "gap.csv", columns)
    assert [note.split(":")[0] for note in motion.notes] == ["t", "tau"]
    assert "1 gaps of up to 0.705 s" in motion.notes[0]
    assert "saturated; they are not used" in motion.notes[1]
    inside = (motion.time_s > 10.0) & (motion.time_s < 10.7)
    assert not motion.whole[inside].any()
    assert motion.torque_Nm[motion.whole].max() < 14.0


def test_some_samples_at_the_time_of_another_are_left_out_and_a_coarse_clock_is_refused(tmp_path):
    columns = motion_columns(seconds=20.0)
    twice = np.arange(len(columns["t"])) % 10 == 5
    motion = read(tmp_path / "twice.csv", {**columns, "t": np.where(twice, columns["t"] - 0.005, columns["t"])})
    assert motion.notes[0] == "t: 400 samples at the time of the one before: left out"
    with pytest.raises(DataError, match="t: does not go on at sample 2"):
        read(tmp_path / "coarse.csv", {**columns, "t": np.floor(columns["t"] * 50.0) / 50.0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position_unit": None}, "--position-unit is missing"),
        ({"position_column": None}, "--position-column or --velocity-column is missing"),
        ({"torque_column": None}, "--torque-column or --current-column is missing"),
        ({"torque_side": None}, "--torque-side is missing"),
        ({"ratio": None}, "--ratio is missing"),
        ({"torque_column": None, "current_column": "tau"}, "--torque-constant is missing"),
        ({"position_unit": "count"}, "--counts-per-turn is missing"),
        ({"position_unit": "grad"}, r"--position-unit \(=grad\) must be one of rad, deg, turn"),
        ({"time_unit": "min"}, r"--time-unit \(=min\) must be one of s, ms, us, ns"),
        ({"temperature_unit": "C"}, r"--temperature-unit \(=C\) must be one of degC, K, degF"),
        ({"torque_unit": "kNm"}, r"--torque-unit \(=kNm\) must be one of Nm, Ncm, mNm"),
        ({"reverse": ("current",)}, r"--reverse \(=current\) must be one of position, velocity, torque, load"),
        ({"sample_rate_Hz": 200.0}, "--time-column and --sample-rate: give one of them"),
        (replace(SETTINGS, band_Hz=95.0), r"--band \(=95 Hz\) must be below 90 Hz"),
        (replace(SETTINGS, speed_min_radps=-1.0), r"--speed-min \(=-1\) must be in"),
        (replace(SETTINGS, acceleration_max_radps2=0.0), r"--acceleration-max \(=0\) must be in"),
        (replace(SETTINGS, mean_samples=0), r"--mean-samples \(=0\)"),
    ],
)
def test_what_is_missing_is_not_guessed_and_what_is_wrong_is_refused(tmp_path, change, message):
    given, settings = (change, SETTINGS) if isinstance(change, dict) else ({}, change)
    with pytest.raises(UsageError, match=message):
        read(tmp_path / "a.csv", motion_columns(seconds=5.0), settings, **given)


def test_sizes_are_checked_against_a_configuration(tmp_path):
    motion = read(tmp_path / "a.csv", motion_columns(seconds=5.0))
    assert check_motion(motion, JointLimits(60.0, 3.0, 100.0, 0.1)).problems == []
    (problem,) = check_motion(motion, JointLimits(60.0, 3.0, 121.0, 0.1)).problems
    assert "reduction ratio of the data (=100) differs from joint.reduction_ratio (=121)" in problem
    (problem,) = check_motion(motion, JointLimits(60.0, 0.1, 100.0, 0.1)).problems
    assert "q: reaches" in problem
    (problem,) = check_motion(motion, JointLimits(5.0, 3.0, 100.0, 0.1)).problems
    assert "tau: reaches" in problem


# --- sources: units, sides, run logs ---


def test_differentiation_has_no_phase_and_the_band_that_it_states(tmp_path):
    t = np.arange(0.0, 20.0, 0.002)
    for frequency_Hz, kept in ((1.0, 1.0), (10.0, 0.5)):
        w = 2.0 * np.pi * frequency_Hz
        columns = {"t": t, "q": 2.0 * t + np.sin(w * t) / w, "tau": np.cos(w * t)}
        motion = read(tmp_path / "a.csv", columns, replace(SETTINGS, band_Hz=10.0))
        inside = slice(1000, -1000)
        wave = motion.velocity_radps[inside] - 2.0
        share = wave @ np.cos(w * t[inside]) / np.sum(np.cos(w * t[inside]) ** 2)
        quadrature = wave @ np.sin(w * t[inside]) / np.sum(np.sin(w * t[inside]) ** 2)
        assert share == pytest.approx(kept, abs=0.02)
        assert quadrature == pytest.approx(0.0, abs=1e-3)


def run_log(path, columns, ratio_text="reduction_ratio = 100.0"):
    records = new(LogRecord, len(columns["t"]))
    records.time_ns = 10**12 + np.round(columns["t"] * 1e9).astype(np.int64)
    records.position_rad, records.measured_torque_Nm = columns["q"], columns["tau"]
    records.phase = AxisPhase.TRACKING
    records.phase[:20] = AxisPhase.ENABLING
    with RunLogWriter(path, {"run": {"configuration": f"[joint]\n{ratio_text}\n", "path": "joint.toml"}}) as log:
        log.write_records(records)
    return path


def test_a_run_log_is_read_as_a_table_is_and_knows_its_ratio(tmp_path):
    columns = motion_columns(seconds=20.0)
    motion = motion_from(run_log(tmp_path / "run.mcap", columns), ForeignFormat(), SETTINGS)
    table = read(tmp_path / "a.csv", columns)
    assert motion.reduction_ratio == 100.0
    assert len(motion.time_s) == len(table.time_s) - 20  # nothing of before the law moves the joint
    assert motion.torque_Nm[500:-500] == pytest.approx(table.torque_Nm[520:-500], abs=1e-3)
    with pytest.raises(DataError, match="names no reduction ratio"):
        motion_from(run_log(tmp_path / "none.mcap", columns, "x = 1"), ForeignFormat(), SETTINGS)


# --- the verb ---


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "joint.toml"
    shutil.copy(shipped_config("virtual"), path)
    return path


def test_a_long_motion_is_shown_in_windows_of_held_out_blocks_and_a_short_one_whole(loaded, folder):
    _, found = loaded
    figure = prediction_figure(found)
    titles = [axis.get_title(loc="left").split(":")[0] for axis in figure.axes]
    assert titles == ["best window", "usual window", "worst window", ""]
    rmse_Nm = [float(axis.get_title(loc="left").split()[-2]) for axis in figure.axes[:3]]
    assert rmse_Nm == sorted(rmse_Nm)
    assert rmse_Nm[0] <= found.rmse_Nm(odd=True) <= rmse_Nm[2]
    for axis in figure.axes[:3]:
        begin, end = axis.get_lines()[0].get_xdata()[[0, -1]]
        assert end - begin == pytest.approx(5.0, abs=0.1)
    short = identify_motion(read(folder / "short.csv", motion_columns(seconds=20.0)), MotionSettings())
    assert [axis.get_title(loc="left") for axis in prediction_figure(short).axes] == ["", ""]


def test_means_of_the_residual_at_two_temperatures_stand_at_these(loaded):
    _, found = loaded
    two = np.where(np.arange(len(found.motion.time_s)) % 1000 < 500, 20.0, 45.0)
    figure = residual_figure(replace(found, motion=replace(found.motion, temperature_degC=two)))
    axis = next(axis for axis in figure.axes if "temperature" in axis.get_xlabel())
    assert axis.get_lines()[1].get_xdata().tolist() == [20.0, 45.0]


def test_the_python_interface_gives_the_fit_and_writes_nothing(tmp_path):
    data = write_table(tmp_path / "move.csv", motion_columns(TrueJoint(), seconds=20.0))
    table = {name: value for name, value in vars(FORMAT).items() if value is not None}
    found = jointctl.identify_motion(data, table=table, speed_min_radps=0.1)
    assert found.parameters["inertia"].value == pytest.approx(2.0, rel=0.1)
    assert [path.name for path in tmp_path.iterdir()] == ["move.csv"]


@pytest.mark.draws
def test_the_verb_writes_section_pictures_page_and_report(tmp_path, config):
    joint = TrueJoint(load_coulomb=0.2, coulomb_perK=0.01)
    data = write_table(tmp_path / "move.csv", motion_columns(joint, seconds=40.0, warming_K=25.0))
    given = replace(FORMAT, ratio=121.0, temperature_column="warmth")
    out, page = output(json=True), tmp_path / "found.html"
    assert identify(data, out, into=config, given=given, options=Options(), report=page) == 0
    result = json.loads(out.stdout.getvalue())
    assert result["kind"] == "motion"
    friction = load_config(config).friction
    assert friction.load.coulomb == pytest.approx(0.2, rel=0.2)
    assert friction.temperature.coulomb_pK == pytest.approx(0.01, rel=0.2)
    assert friction.temperature.lowest_degC < friction.temperature.reference_degC < friction.temperature.highest_degC
    assert friction.model_dump(exclude_none=True)["load"] == result["friction"]["load"]
    tc_Nm = result["friction"]["positive"]["tc_Nm"] * 121.0
    assert tc_Nm == pytest.approx(6.0, rel=0.15)
    assert "# identified by jointctl: for [joint]: inertia_kgm2 = " in config.read_text()
    html = page.read_text()
    assert [foreign_colours(svg) for svg in svgs(html)] == [set(), set(), set()]
    for word in ("load_coulomb", "held out", "Left open by these data", "[friction.temperature]"):
        assert word in html
    for end in ("", ".residuals", ".families"):
        assert (tmp_path / f"move.friction{end}.png").read_bytes().startswith(b"\x89PNG")


def test_a_curve_without_load_and_temperature_takes_those_of_an_earlier_one_away(tmp_path, config):
    """They belong to the curve that they were found with."""
    document = tomlkit.parse(config.read_text())
    document["friction"] |= {
        "load": {"coulomb": 0.2},
        "temperature": {"coulomb_pK": 0.01, "reference_degC": 40.0, "lowest_degC": 25.0, "highest_degC": 55.0},
    }
    config.write_text(tomlkit.dumps(document))
    before = load_config(config).friction
    assert before.load.coulomb == 0.2
    assert before.temperature.coulomb_pK == 0.01
    plain = write_table(tmp_path / "plain.csv", motion_columns(TrueJoint(), seconds=40.0, seed=2))
    identify(plain, output(), into=config, given=replace(FORMAT, ratio=121.0), options=Options())
    after = tomlkit.parse(config.read_text()).unwrap()["friction"]
    assert not {"load", "temperature"} & set(after)
    assert load_config(config).friction.lugre is not None


# --- real joints ---

KINOVA = PUBLIC_DATA / "kinova"
COLUMNS = ForeignFormat(
    time_column="time_s", position_column="position_rad", position_unit="rad", velocity_column="velocity_radps",
    velocity_unit="rad/s", side="joint", torque_column="current_torque_Nm", torque_side="joint", ratio=100.0,
    load_column="model_torque_Nm", temperature_column="temperature_degC",
)  # fmt: skip
# speed above 0.05 rad/s, acceleration below 1 rad/s2, mean of 25 samples
CONDITIONS = MotionSettings(speed_min_radps=0.05, acceleration_max_radps2=1.0, mean_samples=25)


def real_motion(number: int) -> Motion:
    path = KINOVA / f"joint_{number}.csv"
    if not path.exists():
        pytest.skip(f"{path}: the public data of five strain-wave joints are not here")
    return read_motion(path, COLUMNS, CONDITIONS)


@pytest.mark.parametrize(("number", "most_Nm"), [(1, 0.20), (4, 0.35), (5, 0.09), (6, 0.08), (7, 0.12)])
def test_five_real_strain_wave_joints_on_held_out_blocks(number, most_Nm):
    found = identify_motion(real_motion(number), CONDITIONS)
    assert found.blocks == 8
    assert found.rmse_Nm(odd=True) <= most_Nm
    assert found.rmse_Nm(odd=True, every=True) < 3.0 * most_Nm
    text = " | ".join(found.untold)
    assert "velocity_radps: no reversal" in text
    assert "velocity_radps: constant speed only" in text
    assert "temperature: constant within" in text
    if number in (4, 6):  # under gravity load
        assert found.model.terms & {"load-scale", "load-coulomb"}
        assert "one direction only cannot tell load friction from an error of the torque constant" in text


# --- ripple, and friction that goes with the angle ---


def slow_strokes(share, ripple_Nm, seconds=60.0):
    """Slow motion both ways over several motor turns; friction times 1 + share, and a torque besides."""
    t = np.arange(0.0, seconds, 0.005)
    w = 2.0 * np.pi / 20.0
    q = 0.9 * np.sin(w * t) + 0.06 * np.sin(7.3 * w * t)
    v, a = np.gradient(q, t), np.gradient(np.gradient(q, t), t)
    joint = TrueJoint()
    tau = joint.inertia_kgm2 * a + joint.gravity_Nm * np.sin(q - joint.gravity_zero_rad)
    friction = joint.torque_Nm(q, v, a) - tau
    noise = 0.2 * np.random.default_rng(3).standard_normal(len(t))
    return {"t": t, "q": q, "tau": tau + friction * (1.0 + share(q)) - ripple_Nm(q) + noise}


SLOW = replace(SETTINGS, speed_min_radps=0.02)


def test_friction_that_turns_round_with_the_motion_is_told_from_ripple(tmp_path):
    columns = slow_strokes(lambda q: 0.12 * np.sin(2.0 * RATIO * q + 0.7), lambda q: 0.6 * np.sin(RATIO * q + 1.1))
    found = identify_motion(read(tmp_path / "slow.csv", columns, SLOW), SLOW)
    (friction,) = found.model.waves(found.value, "angle", RATIO)
    (ripple,) = found.model.waves(found.value, "ripple", RATIO)
    assert friction == pytest.approx((0.12, 2.0, 0.7), rel=0.05)
    assert ripple == pytest.approx((0.6, 1.0, 1.1), rel=0.05)
    assert found.rmse_Nm(odd=True) < 0.12
    section = motion_section(found)
    assert section["angle"]["share"] == [pytest.approx(0.12, rel=0.05)]
    assert section["angle"]["per_motor_turn"] == [2.0]
    assert any(line.startswith("for [ripple]: torque_Nm = [0.") for line in motion_remarks(found))


def test_load_friction_is_not_taken_for_friction_of_the_angle(tmp_path):
    """Gravity goes with the angle, so that its load friction looks like friction twice a joint turn."""
    joint = TrueJoint(load_coulomb=0.12, gravity_Nm=20.0)
    found = identify_motion(read(tmp_path / "a.csv", motion_columns(joint, seconds=60.0)), MotionSettings())
    assert "load-coulomb" in found.model.terms
    assert not any(term.startswith("angle-") for term in found.model.terms)
    assert found.parameters["load_coulomb"].value == pytest.approx(0.12, abs=0.03)


def test_a_joint_without_them_gets_none(tmp_path):
    columns = slow_strokes(lambda q: 0.0, lambda q: 0.0 * q)
    found = identify_motion(read(tmp_path / "slow.csv", columns, SLOW), SLOW)
    assert not [term for term in found.model.terms if term.startswith(("angle-", "ripple-"))]
    assert "angle" not in motion_section(found)


def test_one_way_alone_tells_no_friction_of_the_angle(tmp_path):
    t = np.arange(0.0, 60.0, 0.005)
    q = 0.03 * t + 0.01 * np.sin(0.7 * t)
    tau = 5.0 * (1.0 + 0.2 * np.sin(2.0 * RATIO * q)) + 0.2 * np.random.default_rng(3).standard_normal(len(t))
    settings = replace(SETTINGS, speed_min_radps=0.01)
    found = identify_motion(read(tmp_path / "way.csv", {"t": t, "q": q, "tau": tau}, settings), settings)
    assert "ripple-m2" in found.model.terms
    assert not [term for term in found.model.terms if term.startswith("angle-")]

"""Tables from CSV, the demands of a trajectory, the duration of an approach; compiled and plain runs agree."""

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.firmware_py.records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import (
    approach_duration_s,
    approach_peak,
    ends_meet,
    peak_of,
    reference_at,
    table_from_csv,
)

POINTS = "time_s,position_rad\n10,0.0\n11,0.5\n12.5,-0.25\n13,0.0\n"


def constants(kind, **values):
    c = new(TrajectoryConstants)[0]
    c.kind = kind
    for name, value in values.items():
        c[name] = value
    return c


def sampled(c, table, times, hint=0):
    reference = new(Reference)[0]
    rows = []
    for t_s in times:
        hint = reference_at(c, table, hint, float(t_s), reference)
        rows.append(reference.tolist())
    return np.array(rows)


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text(POINTS)
    return table_from_csv(path)


def test_table_goes_through_the_points_at_rest_at_both_ends(table):
    assert table.shape == (4, 5)
    c = constants(TrajectoryKind.TABLE, table_rows=4)
    motion = sampled(c, table, [-1.0, 0.0, 1.0, 2.5, 3.0, 9.0])
    assert motion[:, 0] == pytest.approx([0.0, 0.0, 0.5, -0.25, 0.0, 0.0], abs=1e-12)
    assert motion[[0, 1, 4, 5], 1] == pytest.approx([0.0] * 4, abs=1e-12)
    assert sampled(c, table, [1e-9, 3.0 - 1e-9])[:, 1] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_table_is_continuous_up_to_the_acceleration(table):
    c = constants(TrajectoryKind.TABLE, table_rows=4)
    for join in (1.0, 2.5):
        before, after = sampled(c, table, [join - 1e-9, join + 1e-9])
        assert after == pytest.approx(before, abs=1e-6)


def test_table_derivatives(table):
    c = constants(TrajectoryKind.TABLE, table_rows=4)
    for t_s in np.linspace(0.01, 2.99, 50):
        before, now, after = sampled(c, table, [t_s - 1e-5, t_s, t_s + 1e-5])
        assert (after[0] - before[0]) / 2e-5 == pytest.approx(now[1], abs=1e-6)
        assert (after[1] - before[1]) / 2e-5 == pytest.approx(now[2], abs=1e-3)


def test_repeat_wraps_where_the_ends_meet_and_stays_where_they_do_not(table, tmp_path):
    assert ends_meet(table)
    c = constants(TrajectoryKind.TABLE, table_rows=4, repeats=1)
    once, later = sampled(c, table, [0.7, 2.2]), sampled(c, table, [30.7, 32.2])
    assert later == pytest.approx(once, abs=1e-9)
    path = tmp_path / "open.csv"
    path.write_text("time_s,position_rad\n0,0\n1,1\n")
    open_table = table_from_csv(path)
    assert not ends_meet(open_table)
    c = constants(TrajectoryKind.TABLE, table_rows=2, repeats=1)
    assert sampled(c, open_table, [1.0, 1.5]).tolist() == [[1.0, 0.0, 0.0]] * 2


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1.0, 105.0), min_size=1, max_size=20), st.integers(-5, 200))
def test_any_row_hint_gives_the_same_motion(times, hint):
    steps = np.arange(101.0)
    rng = np.random.default_rng(3)
    table = np.column_stack([steps + 0.3 * np.sin(steps), rng.normal(size=(101, 4))])
    c = constants(TrajectoryKind.TABLE, table_rows=101)
    expected = [sampled(c, table, [t_s])[0].tolist() for t_s in times]
    assert sampled(c, table, times, hint).tolist() == expected
    for t_s, row in zip(times, expected, strict=True):
        if table[0, 0] < t_s < table[-1, 0]:
            i = int(np.searchsorted(table[:, 0], t_s, side="right")) - 1
            assert row[0] == pytest.approx(np.polyval(table[i, :0:-1], t_s - table[i, 0]), abs=1e-12)


def test_a_table_that_is_missing_rests_at_the_start():
    c = constants(TrajectoryKind.TABLE, table_rows=7, start_rad=0.4)
    assert sampled(c, np.zeros((0, 5)), [0.0, 3.0]).tolist() == [[0.4, 0.0, 0.0]] * 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "row 1 (='') must name the column time_s once; needed: time_s,position_rad"),
        (b"time_s,position_deg\n0,0\n1,1\n", "row 1 (='time_s,position_deg') must name the column position_rad once"),
        (b"time_s,position_rad,time_s\n0,0,0\n", "row 1 (='time_s,position_rad,time_s') must name the column time_s"),
        (b"time_s,position_rad\n0,0\n", "rows of values (=1) must be at least 2"),
        (b"time_s,position_rad\n0,0\n1,nan\n", "row 3: position_rad (='nan') must be a finite number"),
        (b"time_s,position_rad\n0,0\ninf,1\n", "row 3: time_s (='inf') must be a finite number"),
        (b"time_s,position_rad\n0,0\n1,abc\n", "row 3: position_rad (='abc') must be a finite number"),
        (b"time_s,position_rad\n0,0\n2,1\n1,1\n", "row 4: time_s (=1) must be above that of the row before (2)"),
        (b"time_s,position_rad\n0,0\n1,1\n1,2\n", "row 4: time_s (=1) must be above that of the row before (1)"),
        (b"time_s,position_rad\n0,0\n1\n2,3\n", "row 3 (='1') must have 2 values, like row 1"),
        (b"time_s,position_rad\n0,0\n1,0.3", "row 3 (='1,0.3') must end with a line end; cut off?"),
        (b"\x89PNG\r\n\x1a\n", "byte 0 is not UTF-8 text; a CSV file is needed"),
        (b"time_s,position_rad\n0,\0\n", "byte 22 is zero: a binary file"),
        (b"time_s,position_rad\n0,0\n1e-300,1\n1,1\n", "the smallest time step (=1e-300 s) must be longer"),
    ],
)
def test_a_bad_file_is_named_with_row_and_value(tmp_path, content, message):
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.csv") as caught:
        table_from_csv(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"none\.csv: cannot be read \(No such file or directory\)"):
        table_from_csv(tmp_path / "none.csv")


def test_good_files_with_other_columns_blank_lines_and_windows_line_ends_are_read(tmp_path, table):
    path = tmp_path / "good.csv"
    path.write_bytes(b"\xef\xbb\xbfnote, position_rad ,time_s\r\na,0,10\r\nb,0.5,11\r\n\r\nc,-0.25,12.5\r\nd,0,13\r\n")
    assert table_from_csv(path).tolist() == table.tolist()


def assert_peak_covers_exactly(c, table, duration_s):
    """No sample is outside, and the samples come close to every bound."""
    motion = sampled(c, table, np.linspace(0.0, duration_s, 20001))
    peak = peak_of(c, table)
    seen = (motion[:, 0].min(), motion[:, 0].max(), np.abs(motion[:, 1]).max(), np.abs(motion[:, 2]).max())
    assert peak == pytest.approx(seen, rel=1e-3, abs=1e-4)
    assert peak[0] <= seen[0] + 1e-12
    assert all(bound >= value - 1e-12 for bound, value in zip(peak[1:], seen[1:], strict=True))


@settings(max_examples=15, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0), st.floats(-2.0, 2.0), st.floats(0.0, 6.0), st.floats(0.5, 6.0))
def test_peak_of_a_sine_over_the_run(amplitude, omega, shift, switch_s, duration_s):
    c = constants(
        TrajectoryKind.SINE, duration_s=duration_s, switch_s=switch_s,
        amplitude_rad=amplitude, omega_radps=omega, shift_s=shift, offset_rad=0.1,
        amplitude2_rad=0.3, omega2_radps=2.0, shift2_s=0.4, offset2_rad=-0.2,
    )  # fmt: skip
    assert_peak_covers_exactly(c, np.zeros((0, 5)), duration_s)


def test_peak_of_an_endless_sine():
    c = constants(TrajectoryKind.SINE, amplitude_rad=0.35, omega_radps=0.2 * math.pi, offset_rad=1.0)
    assert peak_of(c) == pytest.approx((0.65, 1.35, 0.07 * math.pi, 0.35 * (0.2 * math.pi) ** 2))


@pytest.mark.parametrize("target", [0.1, 2.0, -1.0])
@pytest.mark.parametrize("kind", [TrajectoryKind.MIN_JERK, TrajectoryKind.TRAPEZOID])
def test_peak_of_moves(kind, target):
    c = constants(kind, target_rad=target, move_s=1.5, speed_radps=0.8, acceleration_radps2=2.0)
    assert_peak_covers_exactly(c, np.zeros((0, 5)), 4.0)


def test_peak_of_a_table_finds_what_lies_between_the_points(table):
    c = constants(TrajectoryKind.TABLE, table_rows=4)
    assert_peak_covers_exactly(c, table, 3.0 - 1e-12)
    assert peak_of(c, table).position_max_rad > 0.5


def test_peak_of_rest():
    assert peak_of(constants(TrajectoryKind.HOLD, start_rad=0.2)) == (0.2, 0.2, 0.0, 0.0)
    assert peak_of(constants(TrajectoryKind.TABLE, start_rad=0.2)) == (0.2, 0.2, 0.0, 0.0)


@settings(max_examples=30, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05), st.floats(0.6, 3.0), st.floats(1.1, 10.0))
def test_approach_duration_keeps_both_limits_and_is_not_longer_than_needed(start, velocity, acceleration, v_max, a_max):
    target = new(Reference)[0]
    target.velocity_radps, target.acceleration_radps2 = velocity, acceleration
    duration_s = approach_duration_s(start, target, v_max, a_max)
    peak = approach_peak(start, target, duration_s)
    assert peak.velocity_radps <= v_max * (1.0 + 1e-6)
    assert peak.acceleration_radps2 <= a_max * (1.0 + 1e-6)
    if duration_s > 0.1:
        shorter = approach_peak(start, target, 0.998 * duration_s)
        assert shorter.velocity_radps > v_max or shorter.acceleration_radps2 > a_max


def test_approach_duration_of_a_plain_move_is_the_closed_form():
    target = new(Reference)[0]
    target.position_rad = 1.0
    assert approach_duration_s(0.0, target, 0.5, 100.0) == pytest.approx(1.875 / 0.5, rel=2e-3)
    assert approach_duration_s(0.0, target, 100.0, 2.0) == pytest.approx(
        math.sqrt(10.0 / math.sqrt(3.0) / 2.0), rel=2e-3
    )
    assert approach_duration_s(1.0, target, 0.5, 2.0, minimum_s=0.25) == 0.25


def test_an_approach_to_a_start_above_the_limits_is_refused():
    target = new(Reference)[0]
    target.velocity_radps = 0.5
    approach_duration_s(0.0, target, 0.5, 2.0)
    target.acceleration_radps2 = 1.0
    with pytest.raises(ValueError, match=r"approach distance \(=-2 rad\) cannot be covered"):
        approach_duration_s(2.0, target, 0.5, 2.0)
    with pytest.raises(ValueError, match=r"velocity_radps \(=0.5\) at the trajectory start must be in \[-0.49..0.49\]"):
        approach_duration_s(0.0, target, 0.49, 2.0)


_BOTH_WAYS = """
import json
import numpy as np
from jointctl.firmware_py.records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.trajectory import approach_at, brake_step, plan_approach, reference_at
from jointctl.hil.plant.joint import R1, encoder_counts, plant, step_plant

c, r, a, out = new(TrajectoryConstants)[0], new(Reference)[0], np.zeros(6), []
c.repeats, c.start_rad, c.target_rad, c.move_s, c.dwell_s = 1, 0.1, 0.9, 1.3, 0.2
c.speed_radps, c.acceleration_radps2 = 0.7, 2.0
c.amplitude_rad, c.omega_radps, c.switch_s, c.amplitude2_rad, c.omega2_radps, c.table_rows = 0.3, 2.0, 2.0, 0.2, 3.0, 3
table = np.array([[0.0, 0.0, 0.0, 3.0, -2.0], [1.0, 1.0, 0.0, -3.0, 2.0], [2.0, 0.0, 0.0, 0.0, 0.0]])
for kind in range(5):
    c.kind = kind
    row = 0
    for k in range(40):
        row = reference_at(c, table, row, 0.13 * k - 0.2, r)
        out.append([int(row), *map(float, r.tolist())])
plan_approach(0.3, r, 1.7, a)
approach_at(a, 0.9, r)
for _ in range(30):
    out.append([0, *map(float, r.tolist())])
    brake_step(r, 2.0, 0.01)
for kind in range(4):
    loaded = {"flexible": True, "thermal": True, "gravity_Nm": 5.0, "end_stops": True, "encoder_noise_counts": 2.0}
    for extra in ({}, loaded):
        pc, ps = plant(**{**R1, "friction_kind": kind, **extra})
        for k in range(300):
            step_plant(pc[0], ps[0], 40.0 if k < 200 else -55.0)
        s = ps[0]
        out.append([encoder_counts(pc[0], s), float(s.joint_position_rad), float(s.joint_velocity_radps),
                    float(s.friction_torque_Nm)])
print(json.dumps(out))
"""


def test_compiled_and_plain_python_agree():
    results = []
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", _BOTH_WAYS],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        results.append(np.array(json.loads(done.stdout)))
    assert results[0].shape == (238, 4)
    assert results[1] == pytest.approx(results[0], rel=1e-9, abs=1e-12)

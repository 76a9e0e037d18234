"""Motions as other programs write them: one known joint in the styles of public data, read as if it were ours."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.identification.motion_data import MotionSettings
from jointctl.tools.identification.motion_fit import identify_motion
from jointctl.tools.identification.motion_table import read_motion
from jointctl.tools.identification.tables import ForeignFormat
from tests.unit.identification.synthetic_motion import FORMAT, RATIO, TrueJoint, motion_columns, read, write_table

SETTINGS = MotionSettings()
SAME = ("position_rad", "velocity_radps", "acceleration_radps2", "torque_Nm")


@pytest.fixture(scope="module")
def columns():
    return motion_columns(TrueJoint(), seconds=12.0, warming_K=10.0)


@pytest.fixture(scope="module")
def ours(columns, tmp_path_factory):
    return read(tmp_path_factory.mktemp("ours") / "ours.csv", columns)


def written(path, text, *, encoding="utf-8"):
    path.write_bytes(text.encode(encoding))
    return path


def lines(columns, mark=",", number="{:.9g}", comma="."):
    rows = np.column_stack(list(columns.values()))
    return [mark.join(number.format(value).replace(".", comma) for value in row) for row in rows]


def alike(motion, ours, tolerance=2e-3, inside=slice(100, -100)):
    for name in SAME:
        theirs, mine = getattr(motion, name)[inside], getattr(ours, name)[inside]
        assert theirs == pytest.approx(mine, abs=tolerance * np.max(np.abs(mine))), name


# --- the form of the file ---

STYLES = {
    "a logger's preamble, units below the names, semicolons and decimal commas": (
        "Messung vom 3.4.2021\nAntrieb;HD 25\nAbtastrate;200\n\nt;q;tau\ns;rad;Nm\n", ";", ",",
    ),
    "a spreadsheet's preamble, filled up with empty cells": (
        "Messung vom 3.4.2021;;\nAbtastrate;200;\n;;\nt;q;tau\ns;rad;Nm\n", ";", ",",
    ),
    "tabs with decimal commas": ("t\tq\ttau\n", "\t", ","),
    "spaces with decimal commas": ("t q tau\n", " ", ","),
    "spaces in front and comments": ("# robot 3\n# t q tau\n  t   q  tau\n", "  ", "."),
    "quoted names": ('"t","q","tau"\n', ",", "."),
    "degrees sign in Latin-1": ("t,q,tau\ns,°,Nm\n", ",", "."),
}  # fmt: skip


@pytest.mark.parametrize("style", STYLES)
def test_forms_of_tables_are_recognised(tmp_path, columns, ours, style):
    head, mark, comma = STYLES[style]
    chosen = {name: columns[name] for name in ("t", "q", "tau")}
    text = head + "\n".join(lines(chosen, mark, comma=comma)) + "\n"
    alike(read_motion(written(tmp_path / "a.csv", text, encoding="latin-1"), FORMAT, SETTINGS), ours)


def test_what_is_not_read_of_a_file_is_told(tmp_path, columns):
    body = "\n".join(lines({name: columns[name] for name in ("t", "q", "tau")})) + "\n"
    motion = read_motion(written(tmp_path / "a.csv", "a robot\n\nt,q,tau\ns,rad,Nm\n" + body), FORMAT, SETTINGS)
    assert motion.notes[:2] == (
        "line 1: above the header: not read", "line 4 (=s,rad,Nm): no numbers, such as units: not read",
    )  # fmt: skip


def test_a_mark_at_the_end_of_each_line_and_no_header(tmp_path, columns, ours):
    body = ";\n".join(lines({name: columns[name] for name in ("t", "q", "tau")}, ";")) + ";\n"
    given = replace(FORMAT, time_column="1", position_column="2", torque_column="3")
    alike(read_motion(written(tmp_path / "a.csv", body), given, SETTINGS), ours)
    alike(read_motion(written(tmp_path / "b.csv", "t;q;tau;\n" + body), FORMAT, SETTINGS), ours)
    alike(read_motion(written(tmp_path / "c.csv", "t;q;tau\n" + body), FORMAT, SETTINGS), ours)


def test_a_column_of_words_beside_the_numbers(tmp_path, columns, ours):
    body = [f"{line},moving" for line in lines({name: columns[name] for name in ("t", "q", "tau")})]
    alike(read_motion(written(tmp_path / "a.csv", "\n".join(["t,q,tau,state", *body])), FORMAT, SETTINGS), ours)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_two_bytes_a_character_are_read_with_and_without_their_mark(tmp_path, columns, ours, encoding):
    text = "\n".join(["t,q,tau", *lines({name: columns[name] for name in ("t", "q", "tau")})]) + "\n"
    alike(read_motion(written(tmp_path / "a.csv", text, encoding=encoding), FORMAT, SETTINGS), ours)


def test_zeros_that_are_no_text_stay_a_binary_file(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"t,q" + bytes(1000) + b"3,4\n" * 300)
    with pytest.raises(DataError, match="binary file"):
        read_motion(tmp_path / "a.csv", FORMAT, SETTINGS)


def test_columns_are_found_without_their_unit_and_by_their_own_case_first(tmp_path, columns, ours):
    theirs = {"t [s]": columns["t"], "q (rad)": columns["q"], "tau [Nm]": columns["tau"], "T": columns["warmth"]}
    given = replace(FORMAT, temperature_column="T")
    motion = read_motion(write_table(tmp_path / "a.csv", theirs), given, SETTINGS)
    alike(motion, ours)
    assert motion.temperature_degC[100] == pytest.approx(columns["warmth"][100], abs=1e-3)
    own_case = {"t": columns["t"], "q": columns["q"], "tau": columns["tau"], "T": columns["warmth"]}
    alike(read_motion(write_table(tmp_path / "b.csv", own_case), given, SETTINGS), ours)
    both = {**theirs, "tau (Nm)": columns["tau"]}
    with pytest.raises(DataError, match="column 'tau' occurs 2 times"):
        read_motion(write_table(tmp_path / "c.csv", both), given, SETTINGS)


@pytest.mark.parametrize(
    ("heading", "change", "message"),
    [
        ("q [deg]", {}, r"q: its heading has deg, but --position-unit \(=rad\)"),
        ("q (°)", {}, r"q: its heading has °, but --position-unit \(=rad\)"),
        ("tau [mNm]", {}, r"tau: its heading has mNm, but --torque-unit \(=Nm\)"),
        ("t [ms]", {}, r"t: its heading has ms, but --time-unit \(=s\)"),
        ("v (rpm)", {"velocity_column": "v", "velocity_unit": "rad/s"}, r"v: its heading has rpm, but --velocity-unit"),
    ],
)
def test_a_unit_in_the_heading_that_is_not_the_one_given_is_refused(tmp_path, columns, heading, change, message):
    theirs = {(heading if name == heading.split()[0] else name): values for name, values in columns.items()}
    with pytest.raises(DataError, match=message):
        read(tmp_path / "a.csv", theirs, **change)


@pytest.mark.parametrize(
    "heading", ["q [rad]", "q (radians)", "q [raw]", "tau [N·m]", "tau [Nm]", "t [sec]", "tau (filtered)"]
)
def test_a_unit_in_the_heading_that_is_the_same_or_none_is_not(tmp_path, columns, ours, heading):
    theirs = {(heading if name == heading.split()[0] else name): values for name, values in columns.items()}
    alike(read(tmp_path / "a.csv", theirs), ours)


# --- times ---

CLOCKS = {
    "ISO 8601": "2024-05-01T23:59:58",
    "a space between, hours before UTC": "2024-05-01 23:59:58",
    "of day": "9:59:58",
}  # fmt: skip


@pytest.mark.parametrize("style", CLOCKS)
def test_timestamps_are_seconds(tmp_path, columns, ours, style):
    zone = "+02:00" if "UTC" in style else ""
    first = np.datetime64(CLOCKS[style] if "of day" not in style else "1970-01-01T09:59:58", "us")
    stamps = [str(first + np.timedelta64(round(1e6 * t), "us")) for t in columns["t"]]
    if "of day" in style:
        stamps = [stamp.split("T0")[-1].split("T")[-1] for stamp in stamps]
    body = lines({name: columns[name] for name in ("q", "tau")})
    rows = [
        f"{stamp.replace('T', ' ' if zone else 'T')}{zone},{line}" for stamp, line in zip(stamps, body, strict=True)
    ]
    alike(read_motion(written(tmp_path / "a.csv", "\n".join(["t,q,tau", *rows])), FORMAT, SETTINGS), ours)
    with pytest.raises(UsageError, match=r"--time-unit \(=ms\) is for numbers: t has dates or times of day"):
        read_motion(tmp_path / "a.csv", replace(FORMAT, time_unit="ms"), SETTINGS)
    twice = written(tmp_path / "c.csv", "\n".join(["t,q,tau", *rows, *rows]))
    assert any(
        "2 motions by t" in note for note in read_motion(twice, replace(FORMAT, motion_column="t"), SETTINGS).notes
    )
    rows[300] = "yesterday," + body[300]
    with pytest.raises(DataError, match=r"line 302: t \(=yesterday\) must be a time as"):
        read_motion(written(tmp_path / "b.csv", "\n".join(["t,q,tau", *rows])), FORMAT, SETTINGS)


def test_lines_out_of_order_are_sorted_where_the_clock_is_even(tmp_path, columns, ours):
    order = np.random.default_rng(3).permutation(len(columns["t"]))
    motion = read(tmp_path / "a.csv", {name: values[order] for name, values in columns.items()})
    assert any(note.endswith("lines out of order: sorted") for note in motion.notes)
    alike(motion, ours)


@pytest.mark.parametrize("back_s", [0.0025, 1.0, 3.0])
def test_a_clock_that_was_set_back_is_not_sorted(tmp_path, columns, back_s):
    theirs = {**columns, "t": columns["t"] - np.where(columns["t"] > 6.0, back_s + 0.005, 0.0)}
    with pytest.raises(DataError, match="t: does not go on"):
        read(tmp_path / "a.csv", theirs)


def test_lines_that_stand_twice_are_left_out(tmp_path, columns, ours):
    motion = read(tmp_path / "a.csv", {name: np.repeat(values, 2) for name, values in columns.items()})
    assert "t: 2400 lines that stand twice: left out" in motion.notes
    alike(motion, ours)


# --- units, sides and signs ---


def test_units_of_every_column(tmp_path, columns, ours):
    theirs = {
        "stamp": 1.7e9 * 1e3 + columns["t"] * 1e3, "q": np.round(columns["q"] / math.tau * RATIO * 4096),
        "v": columns["v"] / math.tau, "i": columns["tau"] / RATIO / 0.1 * 1e3, "warm": columns["warmth"] + 273.15,
    }  # fmt: skip
    given = ForeignFormat(
        time_column="stamp", time_unit="ms", position_column="q", position_unit="count", counts_per_turn=4096,
        position_side="motor", velocity_column="v", velocity_unit="turn/s", side="joint", current_column="i",
        current_unit="mA", torque_constant_NmpA=0.1, ratio=RATIO, temperature_column="warm", temperature_unit="K",
    )  # fmt: skip
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",".join(theirs), *lines(theirs, number="{:.15g}")]))
    motion = read_motion(path, given, SETTINGS)
    alike(motion, ours)
    assert motion.temperature_degC[100:-100] == pytest.approx(columns["warmth"][100:-100], abs=1e-3)
    milli = read(tmp_path / "b.csv", {**columns, "tau": columns["tau"] / RATIO * 1e3}, torque_unit="mNm",
                 torque_side="motor")  # fmt: skip
    alike(milli, ours)
    motor = {**columns, "q": np.degrees(columns["q"]) * RATIO, "tau": columns["tau"] / RATIO / 0.1}
    alike(read(tmp_path / "d.csv", motor, position_unit="deg", side="motor", torque_column=None, torque_side=None,
               current_column="tau", torque_constant_NmpA=0.1), ours, 2e-5)  # fmt: skip
    warm = {**columns, "warmth": columns["warmth"] * 1.8 + 32.0}
    far = read(tmp_path / "c.csv", warm, temperature_column="warmth", temperature_unit="degF")
    assert far.temperature_degC[50] == pytest.approx(columns["warmth"][50], abs=1e-3)


@pytest.mark.parametrize("name", ["position", "velocity", "torque"])
def test_a_sign_that_is_the_other_way_round(tmp_path, columns, ours, name):
    column = {"position": "q", "velocity": "v", "torque": "tau"}[name]
    theirs = {**columns, column: -columns[column]}
    given = {"velocity_column": "v", "velocity_unit": "rad/s", "reverse": (name,)}
    alike(read(tmp_path / "a.csv", theirs, **given), ours, 5e-3)


def test_a_load_against_the_torque_is_refused_with_what_helps(tmp_path):
    columns = motion_columns(seconds=20.0, load_Nm=60.0)
    theirs = {**columns, "load": -columns["load"]}
    with pytest.raises(DataError, match="tau: goes against load") as caught:
        read(tmp_path / "a.csv", theirs, load_column="load")
    assert "--reverse load" in caught.value.hint
    read(tmp_path / "a.csv", theirs, load_column="load", reverse=("load",))


@pytest.mark.parametrize("rate_Hz", [100.0, 4000.0])
def test_rates_and_position_alone(tmp_path, rate_Hz):
    columns = motion_columns(TrueJoint(), seconds=24.0, rate_Hz=rate_Hz, noise_Nm=0.1)
    del columns["t"], columns["v"]
    given = replace(FORMAT, time_column=None, sample_rate_Hz=rate_Hz)
    motion = read_motion(write_table(tmp_path / "a.csv", columns), given, SETTINGS)
    assert motion.rate_Hz == pytest.approx(rate_Hz)
    found = identify_motion(motion, SETTINGS)
    assert found.parameters["inertia"].value == pytest.approx(2.0, rel=0.1)
    assert found.parameters["tc positive"].value == pytest.approx(6.0, rel=0.1)


def test_uneven_times(tmp_path, ours):
    random = np.random.default_rng(0)
    fine = motion_columns(TrueJoint(), seconds=12.0, rate_Hz=1000.0, noise_Nm=0.0)
    chosen = np.cumsum(random.integers(3, 8, 2300))
    chosen = chosen[chosen < len(fine["t"])]
    theirs = {name: values[chosen] for name, values in fine.items()}
    motion = read(tmp_path / "a.csv", theirs)
    mine = read(tmp_path / "b.csv", motion_columns(TrueJoint(), seconds=12.0, noise_Nm=0.0))
    for name in ("position_rad", "velocity_radps", "torque_Nm"):
        at = np.interp(motion.time_s[100:-100], mine.time_s, getattr(mine, name))
        used = ~motion.reversing[100:-100]
        assert getattr(motion, name)[100:-100][used] == pytest.approx(at[used], abs=0.03 * np.max(np.abs(at))), name


# --- angles that begin anew ---


@pytest.mark.parametrize(
    ("unit", "side", "wrap"),
    [
        ("rad", "joint", lambda q: (q + np.pi + 3.0) % math.tau - np.pi),
        ("deg", "motor", lambda q: np.degrees(q * RATIO) % 360.0),
        ("count", "motor", lambda q: np.round(q * RATIO / math.tau * 4096) % 4096),
        ("count", "joint", lambda q: (np.round(q / math.tau * 2.0**19) + 2**15) % 2**16 - 2**15),
    ],
)
def test_angles_that_wrap_around_are_continued(tmp_path, columns, ours, unit, side, wrap):
    counts = {"motor": 4096.0, "joint": 2.0**19}[side] if unit == "count" else None
    theirs = {**columns, "q": wrap(columns["q"])}
    motion = read(tmp_path / "a.csv", theirs, position_unit=unit, position_side=side, counts_per_turn=counts)
    assert any("jumps of a period" in note for note in motion.notes)
    shifted = replace(motion, position_rad=motion.position_rad - motion.position_rad[200] + ours.position_rad[200])
    alike(shifted, ours, 0.02)  # counts are coarse


def test_an_angle_over_several_turns_with_a_jump_is_not_continued(tmp_path):
    t = np.arange(0.0, 20.0, 0.005)
    q = 3.0 * t - np.where(t > 10.0, 4.0, 0.0)
    motion = read(tmp_path / "a.csv", {"t": t, "q": q, "tau": 5.0 + 0.1 * np.sin(7.0 * t)})
    assert not any("jumps" in note for note in motion.notes)
    assert any("turns: is the unit another" in note for note in motion.notes)


# --- what is missing, and several motions or joints in one file ---


@pytest.mark.parametrize("empty", ["", "NaN", "N/A", "-"])
def test_samples_without_a_value_are_left_out(tmp_path, columns, ours, empty):
    rows = lines({name: columns[name] for name in ("t", "q", "tau", "warmth")})
    for at in (500, 501, 900, *range(1300, 1330)):
        t, q, _, warmth = rows[at].split(",")
        rows[at] = f"{t},{q},{empty},{warmth}"
    for at in range(len(rows)):  # the temperature comes ten times more rarely
        rows[at] = rows[at] if at % 10 == 0 else rows[at].rsplit(",", 1)[0] + "," + empty
    path = written(tmp_path / "a.csv", "\n".join(["t,q,tau,warmth", *rows]) + "\n")
    motion = read_motion(path, replace(FORMAT, temperature_column="warmth"), SETTINGS)
    assert "tau: 33 samples without a value: left out" in motion.notes
    assert any(note.startswith("t: 1 gaps of up to 0.155 s") for note in motion.notes)
    assert any(note.startswith("warmth: ") and "followed in between" in note for note in motion.notes)
    alike(motion, ours, 0.05, slice(100, 480))
    assert motion.temperature_degC[100:-100] == pytest.approx(columns["warmth"][100:-100], abs=0.01)
    assert not motion.whole[1305:1325].any()


@pytest.mark.parametrize("stamped", [False, True])
@pytest.mark.parametrize("at", [0, 500])
def test_a_time_without_a_value_costs_its_sample_alone(tmp_path, columns, ours, at, stamped):
    body = [line.split(",") for line in lines({name: columns[name] for name in ("t", "q", "tau")})]
    if stamped:
        first = np.datetime64("2024-05-01T23:59:58", "us")
        for cells in body:
            cells[0] = str(first + np.timedelta64(round(1e6 * float(cells[0])), "us"))
    body[at][0] = ""
    path = written(tmp_path / "a.csv", "\n".join(["t,q,tau", *map(",".join, body)]) + "\n")
    motion = read_motion(path, FORMAT, SETTINGS)
    assert "t: 1 samples without a value: left out" in motion.notes
    assert len(motion.time_s) == len(ours.time_s) - (at == 0)


@pytest.mark.parametrize("name", ["t", "q", "tau"])
def test_a_column_without_any_value_is_named(tmp_path, columns, name):
    with pytest.raises(DataError, match=f"{name}: has no value"):
        read(tmp_path / "a.csv", {**columns, name: columns[name] * np.nan})


@pytest.mark.parametrize(("name", "value"), [("q", 0.0), ("q", 1e6), ("tau", -9999.0), ("v", 1e3)])
def test_samples_that_jump_off_and_back_are_left_out(tmp_path, columns, ours, name, value):
    """A lost message that reads as zero, a number that stands for none."""
    theirs = {column: values.copy() for column, values in columns.items()}
    where = np.array([at for at in range(200, 2300, 150) if abs(columns[name][at] - value) > 0.2])
    theirs[name][where] = value
    motion = read(tmp_path / "a.csv", theirs, velocity_column="v", velocity_unit="rad/s")
    assert f"{name}: {len(where)} samples far off their neighbours: left out" in motion.notes
    alike(motion, ours, 0.03)


def test_noise_and_coarse_readings_are_not_far_off(tmp_path, columns):
    noise = np.random.default_rng(2).standard_normal(len(columns["t"]))
    theirs = {**columns, "q": np.round(columns["q"], 2), "tau": columns["tau"] + 20.0 * noise}
    assert not any("far off" in note for note in read(tmp_path / "a.csv", theirs).notes)


def test_a_cell_that_is_no_number_is_one_line(tmp_path, columns):
    rows = lines({name: columns[name] for name in ("t", "q", "tau")})
    rows[700] = rows[700].rsplit(",", 1)[0] + ",overflow"
    with pytest.raises(DataError, match=r"line 702: tau \(=overflow\) must be a finite number"):
        read_motion(written(tmp_path / "a.csv", "\n".join(["t,q,tau", *rows])), FORMAT, SETTINGS)


def several(tmp_path, columns, *, restart):
    """Three motions and one that is too short, with a column of their names."""
    rows = ["run,t,q,tau"]
    for name, count in (("slow", 700), ("none", 50), ("fast", 900), ("back", 800)):
        start = 0.0 if restart else 0.005 * len(rows)
        for k in range(count):
            q, tau = columns["q"][k], columns["tau"][k]
            rows.append(f"{name},{start + 0.005 * k:.6g},{q:.9g},{tau:.9g}")
    return written(tmp_path / "a.csv", "\n".join(rows) + "\n")


@pytest.mark.parametrize("by", ["run", "t"])
def test_several_motions_in_one_file(tmp_path, columns, by):
    path = several(tmp_path, columns, restart=True)
    with pytest.raises(DataError, match="t: does not go on") as caught:
        read_motion(path, FORMAT, SETTINGS)
    assert "--motion-column" in caught.value.hint
    motion = read_motion(path, replace(FORMAT, motion_column=by), SETTINGS)
    assert motion.notes[0] == f"3 motions by {by}"
    assert motion.notes[1].endswith("50 samples: too few, left out")
    assert len(motion.time_s) == 2400
    assert np.all(np.diff(motion.time_s) > 0.0)
    for end in (699, 700, 1599, 1600):  # nothing is used across the joint of two motions
        assert not motion.whole[end]
    assert identify_motion(motion, SETTINGS).parameters["inertia"].value == pytest.approx(2.0, rel=0.3)


def test_lines_of_one_joint_of_a_long_table(tmp_path, columns, ours):
    own = lines({name: columns[name] for name in ("t", "q", "tau")})
    rows = [f"{joint},{line if joint == 2 else '0,0,0'}" for line in own for joint in (1, 2, 3)]
    path = written(tmp_path / "a.csv", "\n".join(["joint,t,q,tau", *rows]) + "\n")
    alike(read_motion(path, replace(FORMAT, where=("joint=2.0",)), SETTINGS), ours)
    with pytest.raises(DataError, match="no line has joint = 4"):
        read_motion(path, replace(FORMAT, where=("joint=4",)), SETTINGS)
    with pytest.raises(UsageError, match=r"--where \(=joint\) must be COLUMN=VALUE"):
        read_motion(path, replace(FORMAT, where=("joint",)), SETTINGS)


# --- what is wrong ---


def test_a_clock_in_another_unit_is_named(tmp_path, columns):
    with pytest.raises(DataError, match=r"t: usual step is 5 s: must be in \[1e-05..0.1\] s") as caught:
        read(tmp_path / "a.csv", {**columns, "t": columns["t"] * 1e3})
    assert "--time-unit" in caught.value.hint


def test_a_velocity_that_does_not_follow_the_position_is_refused(tmp_path, columns):
    with pytest.raises(DataError, match=r"v: is 0.4 rad/s throughout, q moves otherwise"):
        read(tmp_path / "a.csv", {**columns, "v": 0.4 + 0.0 * columns["v"]}, velocity_column="v", velocity_unit="rad/s")


@pytest.mark.parametrize(("factor", "refused"), [(1e3, True), (1e-3, True), (5.0, True), (1.5, False), (0.7, False)])
def test_a_torque_many_times_its_known_load_is_refused(tmp_path, factor, refused):
    columns = motion_columns(seconds=20.0, load_Nm=60.0)
    theirs = {**columns, "tau": factor * columns["tau"]}
    if not refused:
        read(tmp_path / "a.csv", theirs, load_column="load")
        return
    with pytest.raises(DataError, match=r"tau: goes with .* times load: must be in") as caught:
        read(tmp_path / "a.csv", theirs, load_column="load")
    assert "--torque-unit" in caught.value.hint


def test_a_load_that_is_constant_is_told(tmp_path, columns):
    told = "load: is 0 Nm throughout: gravity is not looked for"
    assert told in read(tmp_path / "a.csv", {**columns, "load": 0.0 * columns["t"]}, load_column="load").notes
    varied = motion_columns(seconds=12.0, load_Nm=60.0)
    assert not any("gravity is not" in note for note in read(tmp_path / "b.csv", varied, load_column="load").notes)


def test_a_coarse_torque_is_no_limit_and_a_limit_is_one(tmp_path, columns):
    coarse = {**columns, "tau": np.round(columns["tau"] / 2.0) * 2.0}
    assert not any("saturated" in note for note in read(tmp_path / "a.csv", coarse).notes)
    clipped = {**columns, "tau": np.clip(coarse["tau"], -10.0, 10.0)}
    assert any("saturated" in note for note in read(tmp_path / "b.csv", clipped).notes)

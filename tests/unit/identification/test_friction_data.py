"""Reading friction data: our sweep, other people's tables, and everything that can be wrong with a file."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.identification.friction_data import (
    LEAST_SHARE,
    SWEEP_COLUMNS,
    read_friction_data,
    relative_errors,
    relative_figures,
    sidecar_contents,
)
from jointctl.tools.identification.tables import ForeignFormat
from jointctl.tools.output import Output
from jointctl.tools.verbs.validate import validate
from tests.places import CONFIGS

# --- Reading friction data: our sweep, other people's tables, and everything that can be wrong with a file ---
RATIO, CONSTANT = 121.0, 0.1
SPEEDS = np.concatenate([-np.arange(1, 14)[::-1], np.arange(1, 14)]) * 0.2
FOREIGN = ForeignFormat(
    velocity_column="speed", torque_column="torque", velocity_unit="rad/s", side="joint", torque_side="motor",
    ratio=RATIO,
)  # fmt: skip


def row(velocity, torque, settled=1, current=None):
    current = torque / CONSTANT if current is None else current
    direction = 1 if velocity > 0 else -1
    return f"{velocity:.6g},{current:.6g},{torque:.6g},0.01,0.02,500,{settled},-0.5,0.5,12.5,,{direction},0"


def rows(speeds=SPEEDS):
    return [row(v, math.copysign(0.1 + 0.05 * abs(v), v)) for v in speeds]


def write_sweep(folder, lines, sidecar=None):
    path = folder / "sweep.csv"
    path.write_text("\n".join([",".join(SWEEP_COLUMNS), *lines]) + "\n")
    content = sidecar_contents(RATIO, CONSTANT) if sidecar is None else sidecar
    path.with_suffix(".json").write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def write_foreign(folder, text):
    path = folder / "theirs.csv"
    path.write_text(text)
    return path


def test_a_sweep_is_read_with_its_constants(tmp_path):
    data = read_friction_data(write_sweep(tmp_path, rows()))
    assert data.velocity_radps == pytest.approx(SPEEDS)
    assert data.motor_torque_Nm == pytest.approx(np.sign(SPEEDS) * (0.1 + 0.05 * np.abs(SPEEDS)))
    assert (data.reduction_ratio, data.torque_constant_NmpA) == (RATIO, CONSTANT)
    assert data.notes == ()
    assert list(data.line) == list(range(2, 28))
    assert len(data.direction(1)) == len(data.direction(-1)) == 13


def test_a_sweep_goes_to_and_fro_and_is_sorted_without_a_word(tmp_path):
    data = read_friction_data(write_sweep(tmp_path, rows()[::-1]))
    assert data.velocity_radps == pytest.approx(SPEEDS)
    assert data.line[0] == 27
    assert data.notes == ()


@pytest.mark.parametrize(("step", "told"), [(-1, True), (1, False)])
def test_unsorted_points_of_others_are_sorted_and_it_is_told(tmp_path, step, told):
    lines = [f"{v:.6g},{math.copysign(0.1 + 0.05 * abs(v), v):.6g}" for v in SPEEDS[::step]]
    data = read_friction_data(write_foreign(tmp_path, "\n".join(["speed,torque", *lines]) + "\n"), FOREIGN)
    assert data.velocity_radps == pytest.approx(SPEEDS)
    assert any("sorted" in note for note in data.notes) is told


def test_repeated_speeds_are_kept_but_an_exact_copy_counts_once(tmp_path):
    lines = [*rows(), row(0.2, 0.115), rows()[-1]]
    data = read_friction_data(write_sweep(tmp_path, lines))
    assert len(data.velocity_radps) == len(SPEEDS) + 1
    assert any(note.startswith("line 29: exact copy") for note in data.notes)
    assert any("1 repeated speeds" in note for note in data.notes)


def test_points_that_never_settled_and_zero_speed_are_named_and_not_used(tmp_path):
    lines = [*rows(), row(1.9, 0.5, settled=0), row(0.0, 0.01)]
    data = read_friction_data(write_sweep(tmp_path, lines))
    assert len(data.direction(1)) == 13
    assert any("line 28: did not settle" in note for note in data.notes)
    assert any("line 29: zero velocity" in note for note in data.notes)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([*rows(), row(1.0, math.nan, current=1.0)], r"line 28: motor_torque_Nm \(=nan\) must be a finite number"),
        ([*rows(), row(math.inf, 0.1)], r"line 28: velocity_radps \(=inf\)"),
        ([*rows(), row(1.0, 0.1).replace("0.1", "abc", 1)], r"line 28: "),
        ([*rows(), "1.0,0.2"], r"line 28 has 2 columns, the header 13 \(the last line: is the file cut off\?\)"),
        (["1.0,0.2", *rows()], r"line 2 has 2 columns, the header 13$"),
        (rows(SPEEDS[SPEEDS > 0]), r"13 usable points at positive and 0 at negative velocity: both directions"),
        (rows(SPEEDS[2:]), r"13 usable points at positive and 11 at negative velocity: at least 12"),
        ([*rows(), row(1.0, 0.15, settled=2)], r"line 28: settled \(=2\) must be 0 or 1"),
        ([], r"has a header but no points"),
    ],
)
def test_a_bad_sweep_is_one_clear_line(tmp_path, lines, message):
    path = write_sweep(tmp_path, lines)
    with pytest.raises(DataError, match=message) as caught:
        read_friction_data(path)
    assert str(path) in caught.value.message
    assert "\n" not in str(caught.value)


def test_twelve_points_per_direction_are_enough(tmp_path):
    assert len(read_friction_data(write_sweep(tmp_path, rows(SPEEDS[1:-1]))).velocity_radps) == 24


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"\n\n# only a comment\n", "is empty"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "is a binary file"),
        (b"speed,torque\n\xff\xfe\xfa,1\n", "byte 13 is not UTF-8 text"),
        (b"speed\n1\n2\n", "must hold at least two columns"),
        (b"speed,speed,torque\n1,1,1\n", "column 'speed' occurs 2 times"),
        (b"velocity,torque\n1,1\n", "no column 'speed'"),
    ],
)
def test_a_file_that_is_no_table_is_one_clear_line(tmp_path, content, message):
    path = tmp_path / "theirs.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_friction_data(path, FOREIGN)
    assert path.read_bytes() == content


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_friction_data(tmp_path / "none.csv")
    with pytest.raises(DataError, match="is a folder"):
        read_friction_data(tmp_path)


def test_a_sweep_that_a_spreadsheet_saved_as_utf_16_is_not_cut_off(tmp_path):
    path = write_sweep(tmp_path, rows())
    path.write_bytes(path.read_text().replace("\n", "\r\n").encode("utf-16"))
    assert read_friction_data(path).velocity_radps == pytest.approx(SPEEDS)


def test_a_sweep_cut_off_within_its_last_number_is_refused(tmp_path):
    path = write_sweep(tmp_path, rows())
    path.write_text(path.read_text()[:-1])
    with pytest.raises(DataError, match="the last line has no end"):
        read_friction_data(path)
    foreign = write_foreign(tmp_path, "speed,torque\n" + "\n".join(f"{v},{math.copysign(1, v)}" for v in SPEEDS))
    read_friction_data(foreign, FOREIGN)


@pytest.mark.parametrize(
    ("sidecar", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "must be a JSON object"),
        ({"reduction_ratio": 121.0}, r"torque_constant_NmpA \(=None\)"),
        ({"reduction_ratio": 0.99, "torque_constant_NmpA": 0.1}, r"reduction_ratio \(=0.99\) must be a number in"),
        ({"reduction_ratio": True, "torque_constant_NmpA": 0.1}, r"reduction_ratio \(=True\)"),
        (sidecar_contents(RATIO, CONSTANT * 1.03), r"motor_torque_Nm is 0.1 times current_A"),
    ],
)
def test_a_bad_sidecar_is_one_clear_line(tmp_path, sidecar, message):
    with pytest.raises(DataError, match=message):
        read_friction_data(write_sweep(tmp_path, rows(), sidecar))


def test_a_torque_constant_within_two_percent_passes(tmp_path):
    read_friction_data(write_sweep(tmp_path, rows(), sidecar_contents(RATIO, CONSTANT * 1.015)))


def test_a_missing_sidecar_is_told_and_the_ratio_can_be_given(tmp_path):
    path = write_sweep(tmp_path, rows())
    path.with_suffix(".json").unlink()
    with pytest.raises(DataError, match=r"sweep\.json: missing"):
        read_friction_data(path)
    assert read_friction_data(path, ForeignFormat(ratio=50.0)).reduction_ratio == 50.0


@pytest.mark.parametrize(
    ("unit", "side", "factor"),
    [("rad/s", "joint", 1.0), ("deg/s", "joint", math.pi / 180.0), ("r/min", "motor", math.tau / 60.0 / RATIO)],
)
@pytest.mark.parametrize(("torque_side", "scale"), [("motor", 1.0), ("joint", 1.0 / RATIO)])
def test_units_and_sides_of_other_peoples_data(tmp_path, unit, side, factor, torque_side, scale):
    text = "torque;speed\n" + "".join(f"{math.copysign(2.0, v)};{float(v) / factor!r}\n" for v in SPEEDS)
    told = ForeignFormat(velocity_column="Speed", torque_column="1", velocity_unit=unit, side=side,
                         torque_side=torque_side, ratio=RATIO)  # fmt: skip
    data = read_friction_data(write_foreign(tmp_path, text), told)
    assert data.velocity_radps == pytest.approx(SPEEDS)
    assert np.abs(data.motor_torque_Nm) == pytest.approx(2.0 * scale)


@pytest.mark.parametrize(
    ("delimiter", "line"),
    [(",", "{:.3f},{:.3f}"), ("\t", "{:.3f}\t{:.3f}"), (" ", "{:.3f}   {:.3f}"), (";", "{:.3f};{:.3f}")],
)
def test_delimiters_are_found(tmp_path, delimiter, line):
    text = f"speed{delimiter}torque\n" + "".join(line.format(v, math.copysign(1, v)) + "\n" for v in SPEEDS)
    assert read_friction_data(write_foreign(tmp_path, text), FOREIGN).velocity_radps == pytest.approx(SPEEDS)


def test_decimal_commas_byte_order_mark_and_no_header(tmp_path):
    body = "".join(f"{v:.2f};{math.copysign(0.25, v):.2f}\n".replace(".", ",") for v in SPEEDS)
    data = read_friction_data(write_foreign(tmp_path, "\ufeffspeed;torque\n" + body), FOREIGN)
    assert data.velocity_radps == pytest.approx(SPEEDS)
    told = replace(FOREIGN, velocity_column="1", torque_column="2")
    assert len(read_friction_data(write_foreign(tmp_path, body), told).velocity_radps) == len(SPEEDS)


def test_current_becomes_torque(tmp_path):
    text = "speed,amps\n" + "".join(f"{v},{math.copysign(3.0, v)}\n" for v in SPEEDS)
    told = ForeignFormat(velocity_column="speed", current_column="amps", velocity_unit="rad/s", side="joint",
                         ratio=RATIO, torque_constant_NmpA=0.2)  # fmt: skip
    assert np.abs(read_friction_data(write_foreign(tmp_path, text), told).motor_torque_Nm) == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity_unit": None}, "--velocity-unit is missing"),
        ({"velocity_unit": "rpm"}, r"--velocity-unit \(=rpm\) must be one of deg/s, rad/s, r/min"),
        ({"side": None}, "--side is missing"), ({"side": "both"}, r"--side \(=both\) must be one of joint, motor"),
        ({"torque_side": None}, "--torque-side is missing"), ({"ratio": None}, "--ratio is missing"),
        ({"ratio": 0.999}, r"--ratio \(=0.999\) must be in \[1..1000\]"), ({"ratio": 1001.0}, r"--ratio \(=1001\)"),
        ({"torque_constant_NmpA": 0.0}, r"--torque-constant \(=0\)"),
        ({"torque_column": None}, "--torque-column or --current-column is missing"),
        ({"velocity_column": None}, "--velocity-column is missing"),
        ({"current_column": "torque"}, "give one of them"),
        ({"torque_column": None, "current_column": "torque"}, "--torque-constant is missing"),
        ({"delimiter": "bar"}, r"--delimiter \(=bar\)"),
    ],
)  # fmt: skip
def test_nothing_is_guessed_about_other_peoples_data(tmp_path, change, message):
    text = "speed,torque\n" + "".join(f"{v},{math.copysign(1, v)}\n" for v in SPEEDS)
    path = write_foreign(tmp_path, text)
    read_friction_data(path, FOREIGN)
    with pytest.raises(UsageError, match=message):
        read_friction_data(path, replace(FOREIGN, **change))


def test_a_table_without_mapping_lists_its_columns(tmp_path):
    path = write_foreign(tmp_path, "speed,torque\n1,1\n")
    with pytest.raises(DataError, match="it has speed, torque"):
        read_friction_data(path)


def test_unit_flags_do_not_go_with_a_sweep_file(tmp_path):
    for change, flag in (
        ({"velocity_unit": "deg/s"}, "--velocity-unit"),
        ({"where": ("pass=0",)}, "--where"),
        ({"torque_unit": "mNm"}, "--torque-unit"),
        ({"reverse": ("torque",)}, "--reverse"),
        ({"counts_per_turn": 4096.0}, "--counts-per-turn"),
    ):
        with pytest.raises(UsageError, match=f"{flag} does not apply to a sweep file"):
            read_friction_data(write_sweep(tmp_path, rows()), ForeignFormat(**change))
    read_friction_data(write_sweep(tmp_path, rows()), ForeignFormat(velocity_column=None, time_unit="s"))


def test_a_run_log_is_no_table_of_plateaus(tmp_path):
    with pytest.raises(UsageError, match=r"run\.mcap: is a run log") as caught:
        read_friction_data(tmp_path / "run.mcap")
    assert "sweep" in caught.value.hint


@pytest.mark.parametrize(
    ("change", "flag"),
    [
        ({"position_column": "speed"}, "--position-column"),
        ({"position_unit": "deg"}, "--position-unit"),
        ({"load_column": "speed"}, "--load-column"),
        ({"temperature_unit": "K"}, "--temperature-unit"),
        ({"motion_column": "speed"}, "--motion-column"),
        ({"current_unit": "mA"}, "--current-unit"),
        ({"counts_per_turn": 4096.0}, "--counts-per-turn"),
        ({"reverse": ("load",)}, "--reverse"),
        ({"time_unit": "ms"}, "--time-unit"),
    ],
)
def test_what_a_table_of_plateaus_has_no_column_for_is_refused(tmp_path, change, flag):
    path = write_foreign(tmp_path, "speed,torque\n" + "".join(f"{0.1 * k},{k}\n" for k in range(-20, 21) if k))
    read_friction_data(path, FOREIGN)
    with pytest.raises(UsageError, match=f"{flag} does not apply to plateaus"):
        read_friction_data(path, replace(FOREIGN, **change))


# --- Torques next to zero, and numbers beyond all measure, in a table of friction: a result or one line ---
FEW_SPEEDS = [0.1 * k for k in range(-10, 11) if k]


def table(folder: Path, *, first: str, others: float = 0.2) -> Path:
    path = folder / "sweep.csv"
    torques = [first, *(repr(math.copysign(others, speed)) for speed in FEW_SPEEDS[1:])]
    lines = [f"{speed!r},{torque}" for speed, torque in zip(FEW_SPEEDS, torques, strict=True)]
    path.write_text("\n".join(["velocity_radps,motor_torque_Nm", *lines, ""]))
    path.with_suffix(".json").write_text('{"reduction_ratio": 121, "torque_constant_NmpA": 0.1}')
    return path


@pytest.mark.parametrize(
    ("first", "others"),
    [
        *((first, {}) for first in ("-1e-320", "-5e-324", "0.0", "-1e-308", "-1e-13", "-0.2")),
        ("-1e-320", {"others": 1e-320}),
    ],
)
def test_a_torque_next_to_zero_is_validated(tmp_path: Path, first: str, others: dict[str, float]) -> None:
    out = io.StringIO()
    path = table(tmp_path, first=first, **others)
    assert validate(CONFIGS / "virtual.toml", path, Output(json=True, stdout=out, stderr=io.StringIO())) == 0
    share = json.loads(out.getvalue())["relative_rmse"]
    assert share is None if others else 0.0 < share < 10.0
    assert path.with_suffix(".validation.png").stat().st_size > 10_000


@pytest.mark.parametrize("text", ["1_0", "nan", "inf", "1e101", "-1e308", "٣", ""])
def test_what_is_no_number_of_a_table(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError, match=r"line 2: motor_torque_Nm \(=.*\) must be a finite number"):
        read_friction_data(table(tmp_path, first=text))


def test_the_share_from_which_on_an_error_is_one() -> None:
    measured = np.array([1.0, 1.001 * LEAST_SHARE, 0.999 * LEAST_SHARE, -1.0])
    found = relative_errors(np.full(4, 0.5), measured)
    assert np.isfinite(found).tolist() == [True, True, False, True]
    assert relative_figures(np.full(2, 0.5), np.array([1.0, -2.0])) == pytest.approx((math.sqrt(0.15625), 0.5, 0.125))

"""The arithmetic and the report of the benchmarks, and that what they compare is the same; nothing measures time."""

from __future__ import annotations

import io
import json
import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError, UsageError
from jointctl.firmware_py.arm_model import newton_euler
from jointctl.firmware_py.states import ControllerKind
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from tests.arms import arm_of, random_links, set_motion
from tests.bench import c_programs, speed
from tests.bench.c_programs import (
    FAST_MATH,
    FIRST_WEIGHT,
    OPTIMISED,
    NoCompilerError,
    law_doubles,
    law_library,
    link_doubles,
    state_doubles,
)
from tests.bench.exchange_speed import (
    LOADS,
    busy_core,
    cores,
    load,
    on_core,
    run_cyclictest,
    times_from_ns,
)
from tests.bench.law_speed import (
    SAME_NUMBERS,
    NumpyLaw,
    Ticks,
    allocations,
    c_function,
    difference,
    kernel_ticks,
    law_rows,
    sine_inputs,
)
from tests.bench.paired import Row, compared, interleaved, measured, outcome_data, outcome_table, skipped, write_outcome
from tests.places import ROOT
from tests.sessions import constants_of


@pytest.fixture(scope="module")
def constants():
    return constants_of(load_config(shipped_config("virtual")))


def test_the_ratio_is_the_median_of_the_pairs_and_not_the_ratio_of_the_medians():
    row = compared("g", "w", [1.0, 10.0, 300.0], [2.0, 10.0, 100.0], "us", "C")
    assert row.ratio == 1.0  # of 0.5, 1, 3
    assert (row.low, row.high) == (0.75, 2.0)
    assert (row.ours, row.other, row.pairs) == (10.0, 10.0, 3)


@pytest.mark.parametrize(("ours", "other"), [([], []), ([1.0], [1.0, 2.0])])
def test_values_that_are_no_pairs_are_refused(ours, other):
    with pytest.raises(ValueError, match="equal in number"):
        compared("g", "w", ours, other, "us", "C")


@pytest.mark.parametrize(
    ("ours", "reached"),
    [(1.19, True), (1.2, True), (np.nextafter(1.2, 2.0), False), (1.21, False)],
)
def test_a_goal_is_met_up_to_and_including_its_value(ours, reached):
    assert compared("g", "w", [ours], [1.0], "us", "C", goal=1.2).reached is reached
    assert measured("g", "w", [ours], "s", goal=1.2).reached is reached


def test_nothing_measured_reaches_no_goal_and_misses_none():
    assert skipped("g", "w", "no compiler").reached is None
    assert Row("g", "w", math.nan, "s", goal=1.0, goal_is_value=True).reached is None
    assert compared("g", "w", [1.0], [1.0], "us", "C").reached is None


def test_pairs_are_measured_in_turn_and_the_order_turns_round():
    calls: list[str] = []

    def note(name: str) -> float:
        calls.append(name)
        return float(len(calls))

    first, second = interleaved(3, lambda: note("a"), lambda: note("b"))
    assert "".join(calls) == "abbaab"
    assert first == [1.0, 4.0, 5.0]
    assert second == [2.0, 3.0, 6.0]


OTHER_LAWS: dict[str, Callable[[Any, Path], Ticks]] = {
    "numpy": lambda constants, _: NumpyLaw(constants[0]).ticks,
    "C": lambda constants, folder: c_function(law_library(folder, OPTIMISED), "run_ticks", constants),
    "C, fast": lambda constants, folder: c_function(law_library(folder, FAST_MATH), "run_ticks", constants),
}


@pytest.mark.parametrize("name", OTHER_LAWS)
def test_every_law_gives_the_numbers_of_the_kernel_and_with_another_gain_others(constants, tmp_path, name):
    inputs = sine_inputs(constants[0], 3000)
    other = constants.copy()
    other[0].law.network.learning_rate *= 1.0 + 1e-6
    try:
        same, different = (OTHER_LAWS[name](of, tmp_path) for of in (constants, other))
    except NoCompilerError as error:
        pytest.skip(error.message)
    assert difference(kernel_ticks(constants), same, inputs) <= SAME_NUMBERS
    assert difference(kernel_ticks(constants), different, inputs) > SAME_NUMBERS


@pytest.mark.parametrize("joints", [1, 3, 7])
def test_the_arm_in_c_gives_the_torques_of_the_model(tmp_path, joints):
    random = np.random.default_rng(joints)
    arm = arm_of(random_links(random, joints))
    motions = np.zeros((joints, 4))
    motions[:, :3] = random.normal(size=(joints, 3))
    set_motion(arm, *motions[:, :3].T)
    newton_euler(arm)
    try:
        library = law_library(tmp_path, OPTIMISED)
    except NoCompilerError as error:
        pytest.skip(error.message)
    links = link_doubles(arm.links)
    assert library.link_doubles() == links.shape[1]
    library.arm_torques(links.ctypes.data, arm.constants[0].gravity_mps2.ctypes.data, motions.ctypes.data, joints)
    assert motions[:, 3] == pytest.approx(arm.motion.torque_Nm[:joints], rel=1e-9, abs=1e-9)


def test_nothing_is_allocated_per_tick(constants):
    assert allocations(constants) == 0


def test_the_flat_memory_holds_the_law_in_the_order_of_the_c_structure(constants):
    law = constants[0].law
    values = law_doubles(constants[0])
    assert len(values) == 17 + 2 + 2 * 10 + 30 + 15
    assert values[0] == law.period_s
    assert list(values[17:19]) == list(law.network.p_b)
    assert values[19] == law.friction.positive.coulomb_Nm
    assert values[-1] == law.network.inverse_width[14]
    state = state_doubles(constants[0])
    assert np.all(state[FIRST_WEIGHT : FIRST_WEIGHT + 15] == law.network.initial_weight)
    assert np.count_nonzero(state) == 15


def test_a_law_that_the_c_source_does_not_know_is_refused(constants):
    other = constants.copy()
    other[0].law.kind = ControllerKind.PID
    with pytest.raises(ConfigurationError, match="computed_torque_rbf"):
        law_doubles(other[0])


@pytest.mark.parametrize("missing", ["compiler", "sources"])
def test_without_compiler_or_sources_the_comparison_is_skipped_with_a_word(constants, tmp_path, monkeypatch, missing):
    if missing == "compiler":
        monkeypatch.setenv("PATH", str(tmp_path))
    else:
        monkeypatch.setattr(c_programs, "SOURCES", tmp_path / "none")
    with pytest.raises(NoCompilerError):
        law_library(tmp_path, OPTIMISED)
    rows = list(law_rows(constants, tmp_path, pairs=1))
    assert rows[0].note.startswith("skipped: ")
    assert math.isnan(rows[0].ratio)
    assert rows[-1].other_name == "numpy"  # the rest goes on
    assert rows[-1].ratio > 0.0


def test_a_cycle_without_a_sample_has_no_round_trip():
    times = times_from_ns(np.array([[1000, 2000, 3000], [4000, -1, 5000], [6000, 0, 7000]], np.int64))
    assert list(times.wake_us) == [1.0, 4.0, 6.0]
    assert list(times.round_trip_us) == [2.0]
    assert times.quantile("work", 0.5) == 5.0
    assert math.isnan(times_from_ns(np.zeros((0, 3), np.int64)).quantile("wake", 0.5))


def test_the_histogram_of_cyclictest_is_read(tmp_path):
    program = tmp_path / "cyclictest"
    program.write_text(
        "#!/bin/sh\necho '# /dev/cpu_dma_latency set to 0us'\necho '000007 000003'\necho '000009 000001'\n"
    )
    program.chmod(0o755)
    times = run_cyclictest(str(program), load_config(shipped_config("virtual")), 0.004, "idle")
    assert sorted(times.wake_us) == [7.0, 7.0, 7.0, 9.0]


def test_every_load_ends_with_its_block():
    before = threading.active_count()
    for name in LOADS:
        with load(name):
            pass
    assert threading.active_count() == before
    with pytest.raises(ValueError, match="load"), load("nothing"):
        pass


@pytest.mark.skipif(len(cores()) < 2, reason="needs two cores")
def test_a_load_keeps_to_the_first_core_and_nothing_else_does():
    before = os.sched_getaffinity(0)
    with load("Python thread"):
        thread = next(thread for thread in threading.enumerate() if thread.name == "load")
        end_s = time.monotonic() + 10.0
        while len(os.sched_getaffinity(thread.native_id)) > 1 and time.monotonic() < end_s:
            time.sleep(0.001)
        assert os.sched_getaffinity(thread.native_id) == {min(before)}
        assert os.sched_getaffinity(0) == before
    with busy_core() as pid:
        assert os.sched_getaffinity(pid) == {min(before)}
        assert os.sched_getaffinity(0) == before
    with on_core(max(before)):
        assert os.sched_getaffinity(0) == {max(before)}
    with on_core(None):
        assert os.sched_getaffinity(0) == before
    assert os.sched_getaffinity(0) == before


def test_every_verb_of_the_command_line_is_timed(monkeypatch: pytest.MonkeyPatch):
    asked: dict[str, Any] = {}
    monkeypatch.setattr(speed, "bench", lambda _, **options: asked.update(options) or 0)
    assert speed.main([]) == 0
    assert {"run", "hil", "check", "identify", "fault-campaign"} <= set(asked["verbs"])


ROWS = [
    compared("loop", "wake-up p99", [10.0, 12.0], [10.0, 10.0], "us", "C loop", goal=1.2, note="a [remark]"),
    measured("start", "run until enabled", [4.0], "s", goal=3.0),
    skipped("loop", "against cyclictest", "not installed"),
]


def test_the_report_is_a_table_json_and_a_picture(tmp_path: Path):
    data = outcome_data(ROWS, {"cores": 2})
    out, err = io.StringIO(), io.StringIO()
    Output(stdout=out, stderr=err).result(outcome_table(ROWS), data)
    text = " ".join(out.getvalue().split())
    assert "yes (<= 1.2)" in text
    assert "NO (<= 3 s)" in text
    assert "a [remark]" in text
    json_path, picture = write_outcome(tmp_path / "new", ROWS, data)
    read = json.loads(json_path.read_text())
    assert read["conditions"] == {"cores": 2}
    assert [row["reached"] for row in read["rows"]] == [True, False, None]
    assert read["rows"][2]["ratio"] is None
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_part_that_does_not_exist_is_named():
    with pytest.raises(UsageError, match=r"only \(=lop\) must be one of law, arm, loop, lockstep,"):
        speed.bench(Output(quiet=True), only=["lop"])


def test_an_error_is_one_line_and_an_exit_code(capsys: pytest.CaptureFixture[str]):
    assert speed.main(["--only", "lop"]) == UsageError.exit_code
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "only (=lop)" in shown.err
    assert "Traceback" not in shown.err


def test_the_page_has_one_table_of_twelve_rows_and_each_figure_is_in_the_data():
    page = (ROOT / "docs" / "benchmarks.md").read_text().splitlines()
    data = json.loads((ROOT / "docs" / "benchmarks.json").read_text())
    measured_ones = {f"{row['ours']:.3g} {row['unit']}".strip() for row in data["rows"] if row["ours"] is not None}
    ratios = {
        f"{row['ratio']:.3g} ({row['low']:.3g}..{row['high']:.3g})" for row in data["rows"] if row["ratio"] is not None
    }
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in page if line.startswith("| ")][1:]
    assert len(table) == 12
    assert len(page) <= 80
    assert [row for row in table if row[1] not in measured_ones] == []
    assert [row for row in table if row[4] and row[4] not in ratios] == []
    goals = [row["reached"] for row in data["rows"] if row["goal"] is not None]
    assert f"{sum(goals)} of {len(goals)} met in that run" in "\n".join(page)
    for other in data["others"]:
        assert other["what"]
        assert other["conditions"]
        assert other["rows"]

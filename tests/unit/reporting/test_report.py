"""Reports, their tables and drawings: self-contained, escaped, well-formed, in the colours of the page."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.table import Table
from rich.text import Text

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault
from jointctl.tools.drawing import BLUE, COLOURS, canvas, png, save_figure, save_png
from jointctl.tools.experiments.campaign import MANY, campaign_figure, rows_by_kind, table
from jointctl.tools.experiments.controller_study import PlantResult, StudyResult, study_figure
from jointctl.tools.experiments.judge import Verdict
from jointctl.tools.experiments.scenarios import ErrorFigures
from jointctl.tools.output import Output
from jointctl.tools.recording.report_figures import aligned, at_times, binned, friction_points, run_figures, what_ran
from jointctl.tools.recording.report_page import (
    Details,
    Figure,
    Paragraph,
    Section,
    draw,
    from_terminal,
    page,
    remarks,
    svg_figure,
    write_page,
    write_verb_page,
)
from jointctl.tools.recording.report_page import Table as PageTable
from jointctl.tools.recording.run_log import INFO, RunLogWriter
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.recording.run_summary import summarise
from jointctl.tools.verbs.report import MOST_LOGS, log_names, report, verdict
from tests.page_figures import foreign_colours, svgs
from tests.sessions import output

pytestmark = pytest.mark.usefixtures("undrawn")


# --- One style for files and pages: PNG on white, SVG in the colours of the page ---
def a_verdict(number: int) -> Verdict:
    """Harmful, harmless and a violation in turn, of three kinds."""
    violations = ("late",) if number % 5 == 0 else ()
    return Verdict(number, f"kind_{number % 3}", number % 2 == 0, "NONE", "none", "", violations, 0.1 * number, 0.0,
                   0.1, 0.01 if number % 4 else None)  # fmt: skip


def small() -> Any:
    with canvas(2.0, "title") as figure:
        axes = figure.subplots()
        axes.plot([0.0, 1.0], [0.0, 1.0], color=BLUE, label="line")
        axes.set_ylabel("torque [Nm]")
        axes.legend()
        return figure


@pytest.mark.draws
def test_one_figure_is_a_png_on_white_and_an_svg_in_the_colours_of_the_page(tmp_path: Path) -> None:
    import matplotlib.image

    figure = small()
    corner = matplotlib.image.imread(io.BytesIO(png(figure)))[0, 0]
    assert corner.tolist() == [1.0, 1.0, 1.0, 1.0]
    svg = svg_figure(figure, "a line").svg
    assert svgs(svg) == [svg.strip()]
    assert foreign_colours(svg) == set()
    assert "stroke: var(--blue)" in svg
    assert "torque [Nm]</text>" in svg
    assert save_png(figure, tmp_path / "new" / "a.png").read_bytes() == png(figure)


@pytest.mark.draws
def test_powers_of_ten_are_letters_and_a_name_with_dollars_is_no_formula() -> None:
    with canvas(3.0, "joint $a_1$") as figure:
        wide, narrow = figure.subplots(1, 2)
        wide.loglog([0.1, 500.0], [1e-4, 3e6])
        narrow.loglog([3.0, 6.0], [2e-5, 4e-5])
        wide.legend([], title="$x$ and \\times")
    text = io.StringIO()
    save_figure(figure, text, format="svg")
    found = re.findall(r"<text[^>]*>([^<]*)</text>", text.getvalue())
    assert {
        "joint $a_1$",
        "$x$ and \\times",
        "10⁻¹",
        "10⁶",
        "3",
        "2\N{MULTIPLICATION SIGN}10⁻⁵",
    } <= set(found)
    assert not [words for words in found if "mathdefault" in words]


@pytest.mark.draws
def test_a_colour_of_its_own_or_black_text_would_be_found() -> None:
    figure = small()
    figure.axes[0].set_xlabel("here", color="#000000")
    figure.axes[0].axhline(0.5, color="#123456")
    found = foreign_colours(svg_figure(figure, "a line").svg)
    assert "#123456" in found
    assert len(found) == 2


def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"a\.png: cannot be written"):
        save_png(small(), tmp_path / "file" / "a.png")


@pytest.mark.draws
@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (3.0, 40.0, ["5", "10", "20"]),
        (1.2, 6.0, ["2", "5"]),
        (3e-6, 3e-5, ["5\N{MULTIPLICATION SIGN}10⁻⁶", "10⁻⁵", "2\N{MULTIPLICATION SIGN}10⁻⁵"]),
        (1.25, 1.55, ["1.25", "1.3", "1.35", "1.4", "1.45", "1.5", "1.55"]),
        (0.0075, 0.0172, ["0.008", "0.01", "0.012", "0.014", "0.016"]),
        (0.02, 30.0, ["10⁻¹", "10⁰", "10¹"]),
    ],
)
def test_a_logarithmic_axis_has_labels_that_do_not_overlap(low: float, high: float, labels: list[str]) -> None:
    with canvas(3.0) as figure:
        axes = figure.subplots()
        axes.loglog([low, high], [low, high])
    png(figure)
    figure.draw_without_rendering()
    for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
        shown = {tick.get_loc(): tick.label1.get_text() for tick in ticks}
        within = [text for at, text in sorted(shown.items()) if limits[0] * 0.999 <= at <= limits[1] * 1.001 and text]
        assert within == labels


@pytest.mark.draws
def test_the_boxes_of_a_study_follow_the_page() -> None:
    plants = tuple(
        PlantResult(i, "lugre", 19, tuple(ErrorFigures("", *(0.1 * (i + k + 1),) * 8) for k in range(2)))
        for i in range(8)
    )
    figure = study_figure(StudyResult(("paper", "precise"), plants, False), "eight plants")
    assert foreign_colours(svg_figure(figure, "boxes").svg) == set()


@pytest.mark.draws
@pytest.mark.parametrize("count", [12, MANY + 1])
def test_the_points_of_a_campaign_follow_the_page_or_are_legible_on_it(count: int) -> None:
    found = [a_verdict(number) for number in range(count)]
    svg = svg_figure(campaign_figure(found, 1.0), "points").svg
    assert foreign_colours(svg) == set()
    assert ("data:image/png" in svg) is (count > MANY)


@pytest.mark.draws
def test_a_campaign_in_which_no_drive_was_switched_off_has_a_picture() -> None:
    assert png(campaign_figure([replace(a_verdict(1), off_s=None)], 1.0))


def test_the_heading_of_a_campaigns_table_keeps_its_units() -> None:
    shown = io.StringIO()
    Output(stdout=shown).result(table(rows_by_kind([a_verdict(1)])))
    for heading in ("speed [rad/s]", "beyond limit [rad]", "allowed [rad]", "off after [s]"):
        assert heading in shown.getvalue()
    assert "no fault 1" in shown.getvalue()


# --- Tables of the terminal on a page: the same words, without styles ---
def test_a_table_of_the_terminal_keeps_its_words() -> None:
    table = Table(title="errors [mrad]", caption="after 5 s")
    table.add_column("name")
    table.add_column("peak [mrad]", justify="right")
    table.add_row(Text.assemble("a ", ("red", "red"), " one"), "1.5", style="red")
    table.add_section()
    table.add_row("[b]", Text("<2>"))
    found = from_terminal(table)
    assert list(found.headings) == ["name", "peak [mrad]"]
    assert [tuple(row) for row in found.rows] == [("a red one", "1.5"), ("[b]", "<2>")]
    assert found.caption == "errors [mrad]. after 5 s"


def test_a_table_without_rows_or_header_is_one_as_well() -> None:
    table = Table(show_header=False)
    table.add_column("hidden")
    assert list(from_terminal(table).headings) == [""]
    assert list(from_terminal(table).rows) == []


def test_a_column_that_says_nothing_is_left_out_and_ranges_stay_in_one_piece() -> None:
    table = Table("name", "range", "weak", "pair")
    table.add_row("a", "1 .. 2", "", "(-0.1, 0.2) 0.3")
    table.add_row("b", "", "", "least, greatest")
    found = from_terminal(table)
    assert list(found.headings) == ["name", "range", "pair"]
    space = "\N{NO-BREAK SPACE}"
    assert found.rows[0] == ("a", f"1{space}..{space}2", f"(-0.1,{space}0.2) 0.3")
    assert found.rows[1] == ("b", "", "least, greatest")


def test_sections_without_content_are_left_out_and_text_is_escaped(tmp_path: Path) -> None:
    err, path = io.StringIO(), tmp_path / "a.html"
    sections = [Section("Full", remarks(["<b>"])), Section("Empty", [])]
    write_verb_page(path, "T", sections, Output(stderr=err), subtitle="what")
    html = path.read_text()
    assert "&lt;b&gt;" in html
    assert "Empty" not in html
    assert err.getvalue() == f"written: {path}\n"


# --- Reports: self-contained, escaped, well-formed; two runs are compared at the same trajectory time ---
VOID = {"meta", "img", "br", "link", "input", "hr"}


class Checker(HTMLParser):
    """Collects ids, addresses and tags that were not closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.ids += [value or "" for name, value in attrs if name == "id"]
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def check(html: str) -> Checker:
    """The page is well-formed, fetches nothing and runs nothing."""
    checker = Checker()
    checker.feed(html)
    checker.close()
    assert checker.open == []
    assert len(checker.ids) == len(set(checker.ids))
    targets = set(checker.ids)
    for address in checker.addresses:
        assert address.startswith("data:image/png;base64,") or address[1:] in targets, address
    assert "script" not in checker.tags
    assert not re.search(r"@import|url\(\s*['\"]?(?!#)", html)
    for mark in re.findall(r"url\(#([^)]*)\)", html):
        assert mark in targets
    return checker


def run_records(count: int = 3000, rate_Hz: float = 1000.0, from_s: float = 0.0) -> Any:
    """TRACKING 0.3 sin(2 t) with an error of sin(5 t) mrad and a Coulomb friction of 15 Nm."""
    records = new(LogRecord, count)
    time_s = from_s + np.arange(count) / rate_Hz
    records.cycle = np.arange(count)
    records.time_ns = 10**12 + np.arange(count) * round(1e9 / rate_Hz)
    records.trajectory_s = time_s
    records.phase, records.drive_state, records.status_word = AxisPhase.TRACKING, DriveState.ENABLED, 0x1237
    records.error_rad = 1e-3 * np.sin(5.0 * time_s)
    records.desired_position_rad = 0.3 * np.sin(2.0 * time_s)
    records.position_rad = records.desired_position_rad + records.error_rad
    records.desired_velocity_radps = 0.6 * np.cos(2.0 * time_s)
    records.velocity_radps = records.desired_velocity_radps
    records.inertia_torque_Nm = -2.1 * 1.2 * np.sin(2.0 * time_s)
    records.friction_torque_Nm = 14.0 * np.sign(records.desired_velocity_radps)
    records.measured_torque_Nm = records.inertia_torque_Nm + 15.0 * np.sign(records.desired_velocity_radps)
    records.command_torque_Nm = records.measured_torque_Nm
    records.wake_late_ns, records.round_trip_ns, records.work_ns = 20_000, 90_000, 15_000
    return records


def write_log(
    path: Path,
    records: Any,
    configuration: str = "[control]\nkind = 'pid'\nkp = 1.0\n",
    arm: dict[str, str] | None = None,
) -> Path:
    metadata = {"run": {"configuration": configuration, "path": "joint.toml"}, **({"arm": arm} if arm else {})}
    with RunLogWriter(path, metadata) as log:
        log.write_records(records)
        log.write_event(INFO, "loop", "tracking <b>", int(records.time_ns[0]))
    return path


def made(paths: list[Path], out: Path | None = None) -> str:
    told, said, _ = output(json=True)
    assert report(paths, told, out) == 0
    return Path(json.loads(said.getvalue())["report"]).read_text()


@pytest.mark.draws
def test_a_report_of_one_log_needs_nothing_else(tmp_path: Path) -> None:
    html = made([write_log(tmp_path / "run.mcap", run_records())])
    checker = check(html)
    assert checker.tags.count("svg") == len(run_figures(run_records())) == 5
    for text in ("error, RMSE [mrad]", "0.7", "wake-up late, p99 [us]", "joint.toml", "pid", "without a fault"):
        assert text in html
    assert "tracking &lt;b&gt;" in html
    assert (tmp_path / "run.html").exists()


def test_names_and_configurations_are_text_whatever_they_hold(tmp_path: Path) -> None:
    evil = "</pre><script>alert(1)</script><img src=x onerror=y>"
    path = write_log(tmp_path / "<i>&.mcap", run_records(), f'[control]\nkind = "{evil}"\n')
    html = made([path])
    check(html)
    assert "<script" not in html
    assert "&lt;script&gt;" in html


@pytest.mark.parametrize(
    ("drive", "controller"),
    [
        ("", ("pid", "3.5, 1.0", "measured")),
        ("[drive.cascade]\ntorque_offset = true\n", ("the drive's, pid fed forward", None, "measured")),
        ("[drive.cascade]\ntorque_offset = false\n", ("the drive's alone", None, "none")),
    ],
)
def test_the_controller_of_a_drive_that_closes_its_loops_is_the_drives(
    tmp_path: Path, drive: str, controller: tuple[str | None, ...]
) -> None:
    law = "[control]\nkind = 'pid'\nkp = 3.5\nkv = 1.0\nfeed_forward = 'measured'\n"
    log = read_run_log(write_log(tmp_path / "run.mcap", run_records(), drive + law))
    rows: dict[Any, Any] = dict(what_ran(["run"], [log]).rows)
    names = ("controller", "kp [1/s²], kv [1/s]", "friction feed-forward")
    assert tuple(rows.get(name) for name in names) == controller


def test_a_fault_is_the_first_thing_said(tmp_path: Path) -> None:
    records = run_records()
    records.fault[2000:] = Fault.FOLLOWING_ERROR
    html = made([write_log(tmp_path / "run.mcap", records)])
    assert "ended by the fault FOLLOWING_ERROR" in html
    assert "FOLLOWING_ERROR at 2.000 s" in html
    assert "ended by the fault" not in verdict("run", summarise(run_records()))


def test_only_what_was_used_is_drawn() -> None:
    def drawn(records: Any) -> str:
        return " ".join(figure.alt for figure in run_figures(records))

    records = run_records()
    assert "Network" not in drawn(records)
    assert "Observer" not in drawn(records)
    records.network_torque_Nm = 1.0
    records.observer_torque_Nm = 2.0
    assert "Network" in drawn(records)
    assert "Observer" in drawn(records)
    records.desired_velocity_radps = 0.0
    assert "over velocity" not in drawn(records)


@pytest.mark.draws
def test_a_run_that_never_tracked_is_reported_too(tmp_path: Path) -> None:
    records = run_records()
    records.phase = AxisPhase.WAITING
    html = made([write_log(tmp_path / "run.mcap", records)])
    check(html)
    assert "never tracked" in html


@pytest.mark.draws
def test_colours_follow_the_page(tmp_path: Path) -> None:
    records = run_records()
    records.network_torque_Nm, records.observer_torque_Nm = 1.0, 2.0
    html = made([write_log(tmp_path / "run.mcap", records)])
    body = html[html.index("<svg") :]
    assert "var(--blue)" in body
    assert not [colour for colour in COLOURS.values() if colour in body]
    for name in COLOURS:
        assert html.count(f"--{name}: ") == 3  # light, dark, print


@pytest.mark.draws
def test_two_runs_are_compared_at_the_same_trajectory_time(tmp_path: Path) -> None:
    first, second = run_records(), run_records(900, rate_Hz=500.0, from_s=0.5)
    second.time_ns += 77_000_000_000  # another day: only trajectory time counts
    rows, chosen = aligned(first, second)
    assert rows.trajectory_s[0] == pytest.approx(0.5)
    assert rows.trajectory_s[-1] == pytest.approx(0.5 + 899 / 500.0)
    difference = at_times(second, chosen, "error_rad", rows.trajectory_s) - rows.error_rad
    assert np.max(np.abs(difference)) < 2e-8  # of a straight line between samples: (5 * 0.002)**2 / 8 * 1e-3
    paths = [write_log(tmp_path / "a.mcap", first), write_log(tmp_path / "b.mcap", second)]
    html = made(paths)
    check(html)
    assert "difference" in html
    assert "b less a" in html
    assert "different motions" not in html
    assert (tmp_path / "a.comparison.html").exists()


def arm_logs(folder: Path, joints: int, arms: int = 1) -> list[Path]:
    paths = []
    for i in range(joints):
        arm = {"configuration": f"arm {i % arms}", "joint": f"quite_a_long_name_of_axis{i}"}
        records = run_records()
        for name in ("desired_position_rad", "position_rad", "error_rad", "command_torque_Nm", "measured_torque_Nm"):
            records[name] += 0.1 * i
        records.wake_late_ns += 1000 * i  # a picture that is there twice would have its ids twice
        paths.append(write_log(folder / f"arm-1.{arm['joint']}.mcap", records, arm=arm))
    return paths


@pytest.fixture
def side_by_side_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures of each run by itself."""
    monkeypatch.setattr("jointctl.tools.recording.report_figures.run_figures", lambda _: [])


@pytest.mark.draws
@pytest.mark.usefixtures("side_by_side_alone")
def test_joints_of_one_arm_are_shown_together_without_differences(tmp_path: Path) -> None:
    html = made(arm_logs(tmp_path, MOST_LOGS))  # a legend that leaves no room for axes is a warning, which fails
    check(html)
    names = [f"quite_a_long_name_of_axis{i}" for i in range(MOST_LOGS)]
    assert f"<h1>arm-1: {', '.join(names)}</h1>" in html
    assert html.count("Tracking error of each joint.") == 1
    assert f"less {names[0]}" not in html
    assert "different motions" not in html


def test_two_joints_of_one_arm_are_not_taken_from_each_other(tmp_path: Path) -> None:
    html = made(arm_logs(tmp_path, 2))
    assert "Tracking error of each joint." in html
    assert ">difference<" not in html
    assert ">difference<" in made([write_log(tmp_path / f"{i}.mcap", run_records()) for i in range(2)])


@pytest.mark.draws
@pytest.mark.usefixtures("side_by_side_alone")
def test_joints_of_two_arms_are_compared(tmp_path: Path) -> None:
    html = made(arm_logs(tmp_path, 2, arms=2))
    assert "axis1 less arm-1." in html
    assert "different motions" in html


def test_runs_are_compared_until_one_of_them_changed_its_motion() -> None:
    first, second = run_records(), run_records()
    second.trajectory_s[2000:] = -1.0 + np.arange(len(second) - 2000) * 1e-3
    until_s = float(second.trajectory_s[1999])
    rows, chosen = aligned(first, second)
    assert float(rows["trajectory_s"][-1]) <= until_s
    assert np.flatnonzero(chosen)[-1] == 1999


def test_runs_that_cannot_be_compared_say_so(tmp_path: Path) -> None:
    later, other = run_records(from_s=100.0), run_records()
    other.desired_position_rad += 2e-3
    first = write_log(tmp_path / "a.mcap", run_records())
    assert "no trajectory time in common" in made([first, write_log(tmp_path / "b.mcap", later)])
    assert "different motions" in made([first, write_log(tmp_path / "c.mcap", other)])


@pytest.mark.parametrize("friction_Nm", [0.0, 15.0, -15.0])
def test_the_friction_map_shows_what_is_left_of_the_torque(friction_Nm: float) -> None:
    records = run_records()
    records.gravity_torque_Nm = 3.0
    push = friction_Nm * np.sign(records.desired_velocity_radps)
    records.measured_torque_Nm = records.inertia_torque_Nm + 3.0 + push
    directions = binned(*friction_points(records))
    assert len(directions) == 2
    for sign, rows in zip((-1.0, 1.0), directions, strict=True):
        assert np.all(sign * rows[:, 0] > 0.0)
        np.testing.assert_allclose(rows[:, 2], sign * friction_Nm, atol=1e-9)


@pytest.mark.parametrize("count", [0, MOST_LOGS + 1])
def test_the_number_of_logs_is_limited(tmp_path: Path, count: int) -> None:
    with pytest.raises(DataError, match=rf"number of logs \(={count}\) must be in \[1\.\.{MOST_LOGS}\]"):
        report([tmp_path / "a.mcap"] * count, Output())


@pytest.mark.parametrize("count", [0, 1])
def test_a_log_without_a_run_is_refused(tmp_path: Path, count: int) -> None:
    path = tmp_path / "run.mcap"
    with RunLogWriter(path, {}) as log:
        log.write_records(run_records(2)[:count])
    with pytest.raises(DataError, match=f"has {count} records"):
        report([path], Output())
    assert not (tmp_path / "run.html").exists()


def test_a_report_never_overwrites_a_log(tmp_path: Path) -> None:
    path = write_log(tmp_path / "run.html", run_records())
    before = path.read_bytes()
    with pytest.raises(DataError, match="is an input"):
        report([path], Output())
    with pytest.raises(DataError, match=r"must end in \.html"):
        report([path], Output(), tmp_path / "run.txt")
    with pytest.raises(DataError, match="no folder"):
        report([path], Output(), tmp_path / "none" / "run.html")
    assert path.read_bytes() == before


def test_logs_of_one_name_are_told_apart() -> None:
    assert log_names([Path("a/run.mcap"), Path("b/run.mcap"), Path("c.mcap")]) == ["run (1)", "run (2)", "c"]


@pytest.mark.draws
def test_the_page_takes_every_block(tmp_path: Path) -> None:
    table = PageTable(["<name>", "value"], [["a", "1.5"], ["b", "-2 %"]], "caption", {1: "error"})
    picture = Figure("a dot", '<svg><circle r="1"/></svg>')
    blocks = [Paragraph("5 < 6"), table, picture, Details("more", "<x>"), draw(1.0, lambda f: f.subplots(), "axes")]
    html = page("T & T", [Section("One", blocks), Section("Two", [draw(1.0, lambda f: f.subplots(), "again")])])
    check(html)
    for text in ("T &amp; T", "5 &lt; 6", "&lt;name&gt;", 'class="error"', '<svg><circle r="1"/></svg>', "&lt;x&gt;"):
        assert text in html
    assert write_page(tmp_path / "p.html", html).read_text() == html


@pytest.mark.parametrize(
    ("cells", "number"),
    [(["1", "-2.5"], True), (["1e-3", "-"], True), (["5 %"], True), (["-"], False), (["1", "a"], False), ([], False)],
)
def test_columns_of_numbers_stand_right(cells: list[str], number: bool) -> None:
    assert PageTable(["x"], [[cell] for cell in cells]).is_number(0) is number

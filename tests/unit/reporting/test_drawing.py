"""One style for files and pages: PNG on white, SVG in the colours of the page."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import DataError
from jointctl.tools.campaign.campaign import MANY, campaign_figure, rows_by_kind, table
from jointctl.tools.campaign.judge import Verdict
from jointctl.tools.drawing import BLUE, canvas, png, save_png
from jointctl.tools.experiments.controller_study import PlantResult, StudyResult, study_figure
from jointctl.tools.experiments.scenarios import ErrorFigures
from jointctl.tools.output import Output
from jointctl.tools.reporting.page import svg_figure
from tests.page_figures import foreign_colours, svgs


def verdict(number: int) -> Verdict:
    """Harmful, harmless and a violation in turn, of three kinds."""
    violations = ("late",) if number % 5 == 0 else ()
    return Verdict(number, f"kind_{number % 3}", number % 2 == 0, "NONE", "none", violations, 0.1 * number, 0.0, 0.1,
                   0.01 if number % 4 else None)  # fmt: skip


def small() -> Any:
    with canvas(2.0, "title") as figure:
        axes = figure.subplots()
        axes.plot([0.0, 1.0], [0.0, 1.0], color=BLUE, label="line")
        axes.set_ylabel("torque [Nm]")
        axes.legend()
        return figure


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


def test_the_boxes_of_a_study_follow_the_page() -> None:
    plants = tuple(
        PlantResult(i, "lugre", 19, tuple(ErrorFigures("", *(0.1 * (i + k + 1),) * 8) for k in range(2)))
        for i in range(8)
    )
    figure = study_figure(StudyResult(("paper", "precise"), plants, False), "eight plants")
    assert foreign_colours(svg_figure(figure, "boxes").svg) == set()


@pytest.mark.parametrize("count", [12, MANY + 1])
def test_the_points_of_a_campaign_follow_the_page_or_are_legible_on_it(count: int) -> None:
    found = [verdict(number) for number in range(count)]
    svg = svg_figure(campaign_figure(found, 1.0), "points").svg
    assert foreign_colours(svg) == set()
    assert ("data:image/png" in svg) is (count > MANY)


def test_the_heading_of_a_campaigns_table_keeps_its_units() -> None:
    shown = io.StringIO()
    Output(stdout=shown).result(table(rows_by_kind([verdict(1)])))
    for heading in ("speed [rad/s]", "beyond limit [rad]", "allowed [rad]", "off after [s]"):
        assert heading in shown.getvalue()
    assert "no fault 1" in shown.getvalue()

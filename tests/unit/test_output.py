"""What reaches a terminal, however narrow."""

from __future__ import annotations

import io
import re

import pytest
from rich.table import Table

from tools.output import Output

NUMBERS = ["0.0949 .. 0.358", "0.00788 .. 0.0162", "0.00762 .. 0.00944"]
PATH = "runs/a_joint_with_a_long_name-20260101-120000.mcap"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_a_table_in_a_narrow_terminal_loses_nothing(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    table = Table("file", "peak", "RMSE", "true RMSE")
    table.add_row(PATH, *NUMBERS)
    out = Terminal()
    Output(stdout=out, stderr=io.StringIO()).result(table)
    shown = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).splitlines()
    lines = [line.split("│")[1:-1] for line in shown if line.startswith("│")]
    assert max(len(line) for line in shown) <= columns
    read = ["".join(cells) for cells in zip(*lines, strict=True)]
    assert [re.sub(r"\s", "", cell) for cell in read] == [re.sub(r"\s", "", text) for text in (PATH, *NUMBERS)]


def test_what_a_terminal_wraps_of_a_fact_goes_below_its_text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    text = "motion     -0.477 .. +0.650 rad, back and forth, about 7 min"
    terminal, pipe = Terminal(), io.StringIO()
    Output(stdout=io.StringIO(), stderr=terminal).fact(text)
    Output(stdout=io.StringIO(), stderr=pipe).fact(text)
    assert terminal.getvalue().splitlines() == [
        "motion     -0.477 .. +0.650 rad, back", "           and forth, about 7 min",
    ]  # fmt: skip
    assert pipe.getvalue() == text + "\n"  # a line of a file is not broken

"""Each fault of the loop and each watcher in docs/safety.md has a test that trips and a twin just inside the limit.

These tests say so themselves, by the marks `trips` and `stays`: of a fault, or of a row `watcher: watches`, and which
words of the test (its parameters as they are written there) are the case.  That the marks and the words are there is
checked here; that the cases do what is said of them is what those tests check.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from typing import NamedTuple

import pytest

from jointctl.firmware_py.states import Fault
from tests.places import ROOT

TEXT = (ROOT / "docs" / "safety.md").read_text()
FAULTS = [fault for fault in Fault if fault is not Fault.NONE]


class Case(NamedTuple):
    place: str  # file::test
    words: str  # of the test that make it the case
    source: str  # decorators included, but for the marks themselves


@cache
def cases() -> dict[tuple[str, str], list[Case]]:
    """(trips or stays, `Fault.NAME` or row) -> the tests that say so."""
    found: dict[tuple[str, str], list[Case]] = {}
    for file in sorted((ROOT / "tests").rglob("test_*.py")):
        text = file.read_text()
        if "pytest.mark.trips(" not in text and "pytest.mark.stays(" not in text:
            continue
        lines = text.splitlines()
        for test in (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)):
            marks = [d for d in test.decorator_list if re.match(r"pytest\.mark\.(trips|stays)\(", ast.unparse(d))]
            kept = [d for d in test.decorator_list if d not in marks]
            spans = [(d.lineno, d.end_lineno) for d in kept] + [(test.lineno, test.end_lineno)]
            source = " ".join(" ".join(" ".join(lines[first - 1 : last]) for first, last in spans).split())
            for mark in marks:
                assert isinstance(mark, ast.Call)
                subject, *words = mark.args
                of = subject.value if isinstance(subject, ast.Constant) else ast.unparse(subject)
                key = (ast.unparse(mark.func).removeprefix("pytest.mark."), str(of))
                case = Case(f"{file.name}::{test.name}", " ".join(ast.literal_eval(w) for w in words), source)
                found.setdefault(key, []).append(case)
    return found


def watchers(heading: str, following: str) -> list[list[str]]:
    """Cells of each row of the first table between two headings of docs/safety.md."""
    table = re.search(r"(?:^\|.*\n)+", TEXT[TEXT.index(heading) : TEXT.index(following)], re.MULTILINE)
    assert table
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table[0].splitlines()[2:]]


ON_CAN = watchers("## Who watches whom", "## Reactions")
ON_SERIAL = watchers("## On a serial line", "How long the drive keeps")
ROWS = [f"{row[0]}: {row[1]}" for row in ON_CAN if not row[4]] + [f"serial {row[0]}: {row[1]}" for row in ON_SERIAL]


def test_each_fault_stands_in_one_row_of_the_watchers() -> None:
    assert sorted(name for row in ON_CAN for name in row[4].split(", ") if name) == sorted(f.name for f in FAULTS)


def test_each_mark_is_of_a_fault_or_of_a_row() -> None:
    assert {subject for _, subject in cases()} == {f"Fault.{fault.name}" for fault in FAULTS} | set(ROWS)


@pytest.mark.parametrize("subject", [f"Fault.{fault.name}" for fault in FAULTS] + ROWS)
def test_each_fault_and_each_watcher_has_a_test_that_trips_and_a_twin(subject: str) -> None:
    trips, stays = cases()["trips", subject], cases()["stays", subject]
    for case in trips + stays:
        assert " ".join(case.words.split()) in case.source, case.place
    assert not {case[:2] for case in trips} & {case[:2] for case in stays}
    if subject.startswith("Fault."):
        assert all(subject in case.source for case in trips)
        assert all("Fault.NONE" in case.source or "assert_well(" in case.source for case in stays)

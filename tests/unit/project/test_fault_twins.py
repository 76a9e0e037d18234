"""Each fault of the loop and each watcher in docs/safety.md has a test that trips and a twin just inside the limit.

`twin_places` says where.  That the words are there is checked here; that the cases do what is said of them is
what those tests check.
"""

from __future__ import annotations

import ast
import re
from functools import cache

import pytest

from jointctl.firmware_py.states import Fault
from tests.places import ROOT
from tests.unit.project.twin_places import CAN, FAULTS, SERIAL

PLACE = re.compile(r"((?:\w+/)+\w+\.py)::(\w+)(?: \| (.+))?")


@cache
def functions(file: str) -> dict[str, str]:
    """Name -> source, decorators included, of each test of a file."""
    text = (ROOT / "tests" / file).read_text()
    lines, found = text.splitlines(), {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
            found[node.name] = " ".join(" ".join(lines[first - 1 : node.end_lineno]).split())
    return found


def source_of(place: str) -> str:
    """The test's source; fails unless it is there and has the words."""
    match = PLACE.fullmatch(place)
    assert match, place
    file, name, words = match.groups()
    assert name in functions(file), place
    assert words is None or " ".join(words.split()) in functions(file)[name], place
    return functions(file)[name]


def watchers(heading: str, following: str) -> list[tuple[str, str]]:
    """(watcher, watches) of each row of the first table between two headings of docs/safety.md."""
    text = (ROOT / "docs" / "safety.md").read_text()
    text = text[text.index(heading) : text.index(following)]
    table = re.search(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert table
    rows = [[cell.strip() for cell in line.split("|")[1:3]] for line in table[0].splitlines()[2:]]
    return [(first, second) for first, second in rows]


def test_no_fault_is_without_its_twin() -> None:
    assert set(FAULTS) == set(Fault) - {Fault.NONE}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_has_a_test_that_trips_and_a_twin(fault: Fault) -> None:
    trip, twin = FAULTS[fault]
    assert trip != twin
    assert f"Fault.{fault.name}" in source_of(trip)
    source = source_of(twin)
    assert "Fault.NONE" in source or "assert_well(" in source


@pytest.mark.parametrize(
    ("table", "heading", "following"),
    [(CAN, "## Who watches whom", "## Reactions"), (SERIAL, "## On a serial line", "How long the drive keeps")],
    ids=["CAN", "serial"],
)
def test_every_watcher_has_a_test_that_trips_and_a_twin(
    table: dict[tuple[str, str], tuple[str, str] | tuple[Fault, ...]], heading: str, following: str
) -> None:
    rows = watchers(heading, following)
    assert sorted(rows) == sorted(table)
    for place in table.values():
        if isinstance(place[0], Fault):
            assert all(fault in FAULTS for fault in place)
            continue
        trip, twin = (str(text) for text in place)
        assert trip != twin
        assert source_of(trip)
        assert source_of(twin)

"""docs/safety.md names a test behind each statement; every one of them exists."""

from __future__ import annotations

import re

from tests.places import ROOT

NAMED = re.compile(r"`((?:\w+/)+\w+\.py)::(\w+)`")


def test_every_test_that_the_document_names_exists() -> None:
    named = NAMED.findall((ROOT / "docs" / "safety.md").read_text())
    assert len(named) > 30
    for file, name in named:
        assert re.search(rf"^ *def {name}\(", (ROOT / "tests" / file).read_text(), re.MULTILINE), f"{file}::{name}"


def test_every_row_of_the_watchers_names_one() -> None:
    text = (ROOT / "docs" / "safety.md").read_text()
    table = text[text.index("## Who watches whom") : text.index("## Reactions")]
    rows = [line for line in table.splitlines() if line.startswith("|")][2:]
    assert len(rows) >= 12
    for row in rows:
        assert NAMED.search(row), row

"""docs/safety.md names a test behind each statement, the mutation run those of a module; every one of them exists."""

from __future__ import annotations

import re

import pytest

from tests.bench import mutation_run
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


@pytest.mark.parametrize("module", mutation_run.TESTS)
def test_the_mutation_run_finds_its_tests(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(mutation_run.files_of_tests(module)) >= len(mutation_run.TESTS[module])
    monkeypatch.setitem(mutation_run.TESTS, module, ("firmware_py/test_that_was_moved_*",))
    with pytest.raises(ValueError, match="test_that_was_moved"):
        mutation_run.files_of_tests(module)

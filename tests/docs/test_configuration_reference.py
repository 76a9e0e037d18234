"""docs/configuration.md is what the models say now, and leaves nothing out."""

from __future__ import annotations

import tomllib

import pytest

from docs.reference import reference, rows_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.sections import Limits
from tests.places import ROOT


@pytest.fixture(scope="module")
def page() -> str:
    return reference()


def test_the_page_is_up_to_date(page: str) -> None:
    told = "is stale: python docs/reference.py docs/configuration.md"
    assert (ROOT / "docs" / "configuration.md").read_text() == page, told


def test_every_key_has_a_meaning(page: str) -> None:
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    assert len(rows) > 150
    assert [row for row in rows if row.endswith("|  |")] == []


def test_a_row_tells_what_the_model_checks_with() -> None:
    rows = {row[0]: row[1:] for row in rows_of(Limits)}
    assert rows["`torque_max_Nm`"][:4] == ("Nm", "number", "(0..100000]", "required")


def test_every_section_and_key_of_a_shipped_configuration_is_in_it(page: str) -> None:
    for file in sorted((ROOT / "configs").glob("*.toml")):
        for name, section in tomllib.loads(file.read_text()).items():
            assert f"## [{name}]" in page, file
            assert all(f"| `{key}` |" in page for key, value in section.items() if not isinstance(value, dict)), file
    assert all(f"## [{name}]" in page for name in Config.model_fields)

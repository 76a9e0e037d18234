"""The pages on exit codes and file formats name what the program has."""

from __future__ import annotations

import re

from jointctl.drivers.errors import DECLINED, INTERRUPTED, JointctlError
from jointctl.tools.configuration.config import Config
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS
from jointctl.tools.verbs.fault_campaign import EXIT_VIOLATIONS
from jointctl.tools.verbs.params import DIFFERENT
from tests.places import ROOT

DOCS = ROOT / "docs"
NO_CLASS = {0, EXIT_VIOLATIONS, DIFFERENT, DECLINED, INTERRUPTED}


def classes_of(root: type[JointctlError]) -> set[type[JointctlError]]:
    return {root}.union(*(classes_of(each) for each in root.__subclasses__()))


def test_every_exit_code_has_its_row() -> None:
    rows = {int(code) for code in re.findall(r"^\| (\d+) \|", (DOCS / "exit-codes.md").read_text(), re.MULTILINE)}
    assert rows == {each.exit_code for each in classes_of(JointctlError)} | NO_CLASS


def test_every_section_column_and_topic_is_named() -> None:
    page = (DOCS / "formats.md").read_text()
    sections = re.findall(r"\[(\w+)\]", page[page.index("## Configuration") : page.index("; [configuration]")])
    assert sections
    assert set(sections) == set(Config.model_fields)
    for name in (*SWEEP_COLUMNS, RECORD_TOPIC, EVENT_TOPIC, CAN_TOPIC):
        assert f"`{name}`" in page, name

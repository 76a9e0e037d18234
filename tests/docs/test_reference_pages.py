"""The pages on exit codes and file formats name what the program has."""

from __future__ import annotations

import re

from docs.reference import UNITS
from jointctl.drivers.errors import DECLINED, INTERRUPTED, JointctlError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Notice
from jointctl.tools.configuration.config import Config
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS
from jointctl.tools.recording.ros_messages import (
    CAN_TOPIC,
    EVENT_TOPIC,
    JOINT_STATE_TOPIC,
    RECORD_TOPIC,
    TEMPERATURE_TOPIC,
    Topic,
)
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


def test_every_section_and_column_is_named() -> None:
    page = (DOCS / "formats.md").read_text()
    sections = re.findall(r"\[(\w+)\]", page[page.index("## Configuration") : page.index("; [configuration]")])
    assert sections
    assert set(sections) == set(Config.model_fields)
    for name in SWEEP_COLUMNS:
        assert f"`{name}`" in page, name


# --- Run logs: tables and messages name the same ---
TOPICS = [RECORD_TOPIC, JOINT_STATE_TOPIC, EVENT_TOPIC, TEMPERATURE_TOPIC, CAN_TOPIC]
ENUMERATIONS = {"phase": AxisPhase, "request": DriveRequest, "drive_state": DriveState, "notices": Notice}
LOG_UNITS = UNITS | {"ns": "ns"}


def table(head: str) -> list[list[str]]:
    """The cells of the rows below the one table of docs/formats.md whose first line begins like this."""
    (_, rest) = (DOCS / "formats.md").read_text().split(f"\n| {head} |")
    lines = rest.splitlines()[2:]
    count = next(i for i, line in enumerate(lines) if not line.startswith("|"))
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines[:count]]


def defined(topic: Topic) -> list[tuple[str, str]]:
    """(name, type) of the fields of a message, without its constants and the messages in it."""
    lines = topic.definition.partition("=====")[0].splitlines()
    return [(name, kind) for kind, name in map(str.split, lines) if "=" not in name]


def test_every_topic_of_a_log_is_named_with_its_message() -> None:
    rows = table("topic | message")
    assert [(name, schema) for name, schema, _ in rows] == [(topic.name, topic.schema) for topic in TOPICS]


def test_every_field_of_a_log_is_named_with_type_and_unit() -> None:
    records, others = table("field | type"), table("topic | field")
    assert [name for name, *_ in records] == list(dtype_of(LogRecord).names or ())
    assert [(name.lower(), kind) for name, kind, *_ in records] == defined(RECORD_TOPIC)
    for topic in TOPICS[1:]:
        found = [(name.lower(), kind) for at, name, kind, *_ in others if at == topic.name]
        assert found == defined(topic), topic.name
    assert {at for at, *_ in others} == {topic.name for topic in TOPICS[1:]}
    for name, _, unit, meaning in (*records, *(row[1:] for row in others)):
        assert meaning, name
        if (ending := name.rpartition("_")[2]) in LOG_UNITS and "_" in name:
            assert unit == LOG_UNITS[ending], name


def test_every_value_of_an_enumeration_is_named() -> None:
    assert table("enumeration") == [
        [name, ", ".join(f"{each.value} {each.name}" for each in kind)] for name, kind in ENUMERATIONS.items()
    ]
    enumerated = {name for name, _, unit, _ in table("field | type") if unit in ("enumeration", "bits")}
    assert enumerated == set(ENUMERATIONS)

"""Files with anything in them: a result, or the one documented exception with a readable message; nothing else."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.hil.canopen.dictionary import ObjectDictionary
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, table_from_csv
from jointctl.tools.identification.friction_data import read_friction_data
from jointctl.tools.recording.run_log import RunLogWriter
from jointctl.tools.recording.run_log_reader import read_run_log
from tests.places import CONFIGS

TOML = (CONFIGS / "virtual.toml").read_text()
EDS = (CONFIGS / "virtual_joint.eds").read_text()
quick = settings(max_examples=150)
slow = settings(max_examples=25)
numbers = st.one_of(st.floats().map(str), st.integers().map(str), st.sampled_from(["", "x", "1e999", "-", "0x10"]))


def one_line(message: str, *words: str) -> None:
    """A message that can be shown: not empty, and it names one of these words (if any are given)."""
    assert message.strip()
    assert not words or any(word in message for word in words), message


@st.composite
def damaged(draw: Any, text: str) -> bytes:
    """A good text with a few bytes cut out, doubled, replaced or inserted."""
    data = bytearray(text.encode())
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data) - 1))
        size = draw(st.integers(0, 30))
        new = draw(st.one_of(st.binary(max_size=12), st.text(max_size=12).map(str.encode)))
        data[at : at + size] = new
    return bytes(data)


@quick
@given(content=st.one_of(damaged(TOML), st.binary(max_size=200), st.text(max_size=200).map(str.encode)))
def test_any_configuration_file(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "joint.toml"
    path.write_bytes(content)
    try:
        assert isinstance(load_config(path), Config)
    except ConfigurationError as error:
        one_line(error.message, str(path))


ODD_VALUES = [
    "nan", "inf", "-1e308", "0", "-1", "1e9", "true", '"text"', "[]", "[1, 2]", "{}", "2020-01-01", '""', "9" * 20,
]  # fmt: skip
VALUES = re.compile(r"(?m)^([a-z_A-Z0-9]+) = [^#\n]+")


@quick
@given(number=st.integers(0, 10_000), value=st.sampled_from(ODD_VALUES))
def test_any_value_for_any_key(tmp_path: Path, number: int, value: str) -> None:
    found = list(VALUES.finditer(TOML))
    chosen = found[number % len(found)]
    path = tmp_path / "joint.toml"
    path.write_text(f"{TOML[: chosen.start()]}{chosen[1]} = {value}{TOML[chosen.end() :]}")
    try:
        load_config(path)
    except ConfigurationError as error:
        one_line(error.message, str(path))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # how the library itself logs
@slow
@given(content=st.one_of(damaged(EDS), st.binary(max_size=200)))
def test_any_eds_text_for_the_virtual_drive(tmp_path: Path, content: bytes) -> None:
    from jointctl.tools.virtual_joint import new_device

    path = tmp_path / "virtual_joint.eds"
    path.write_bytes(content)
    joint = tmp_path / "joint.toml"
    joint.write_text(TOML)
    try:
        device = new_device(load_config(joint))
        assert isinstance(device.objects, ObjectDictionary)
    except ConfigurationError as error:
        one_line(error.message)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # how the library itself logs
@slow
@given(content=st.one_of(damaged(EDS), st.binary(max_size=200)))
def test_any_eds_text_for_the_driver(tmp_path: Path, content: bytes, settings_of_virtual_joint: Any) -> None:
    import dataclasses

    import can

    from jointctl.drivers.canopen.drive import CanopenDrive

    path = tmp_path / "drive.eds"
    path.write_bytes(content)
    bus = can.Bus(interface="virtual", channel="fuzz eds")
    try:
        CanopenDrive(bus, dataclasses.replace(settings_of_virtual_joint, eds_path=path)).close()
    except ConfigurationError as error:
        one_line(error.message, "not a readable EDS file")
    finally:
        bus.shutdown()


rows = st.lists(st.lists(numbers, max_size=6).map(",".join), max_size=12).map("\n".join)


@quick
@given(head=st.sampled_from(["time_s,position_rad", "time_s", "", "position_rad,time_s", "# x"]), body=rows)
def test_any_trajectory_table(tmp_path: Path, head: str, body: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"{head}\n{body}\n")
    try:
        table = table_from_csv(path)
    except ValueError as error:
        one_line(str(error))
    else:
        assert np.isfinite(table).all()
        assert table.shape[1] == 5


@quick
@given(content=st.one_of(st.binary(max_size=300), rows.map(str.encode)))
def test_any_friction_data(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "sweep.csv"
    path.write_bytes(content)
    try:
        read_friction_data(path)
    except DataError as error:
        one_line(error.message)


@pytest.fixture(scope="module")
def good_log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("log") / "good.mcap"
    with RunLogWriter(path, {"run": {"a": "b"}}) as log:
        log.write_records(np.zeros(300, dtype_of(LogRecord)))
        log.write_event(20, "test", "event")
    return path.read_bytes()


@settings(max_examples=200)
@given(data=st.data())
def test_any_mcap_bytes(tmp_path: Path, good_log: bytes, data: Any) -> None:
    content = bytearray(good_log)
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=40))
    cut = data.draw(st.integers(0, len(content)))
    path = tmp_path / "run.mcap"
    path.write_bytes(bytes(content[:cut]))
    try:
        log = read_run_log(path)
    except DataError as error:
        one_line(error.message, str(path))
    else:
        assert len(log.records) <= 300

"""Subject and output of the verb params, and a DCF that is changed."""

from __future__ import annotations

import io
import re
import struct
from pathlib import Path
from typing import Any

from jointctl.tools.configuration.load import shipped_config
from jointctl.tools.inspection.parameters import ParameterSet, read_parameters
from jointctl.tools.inspection.subject import SdoReader, Subject, canopen_network
from jointctl.tools.output import Output

OLDER_DUMP = Path(__file__).with_name("older_dump.toml")
EDS = shipped_config("virtual").with_name("virtual_joint.eds")


def subject(device: Any) -> Subject:
    return Subject("virtual", device.channel, None, 1, EDS)


def output(**how: Any) -> tuple[Output, io.StringIO]:
    out = io.StringIO()
    return Output(stdout=out, stderr=io.StringIO(), **how), out


def read(device: Any) -> ParameterSet:
    with canopen_network(subject(device)) as network:
        return read_parameters(SdoReader(network, 1, subject(device).objects()))


def writes(device: Any) -> list[tuple[int, int]]:
    """(index, sub-index) of every SDO download."""
    return [struct.unpack_from("<HB", data, 1) for identifier, data in device.requests
            if identifier == 0x601 and data[0] >> 5 == 1]  # fmt: skip


def change(file: Path, **values: str) -> None:
    """Replace the values of objects in a DCF, `o6072="500"`, `o1018_2="9"`."""
    text = file.read_text()
    for name, value in values.items():
        index, _, sub = name.removeprefix("o").partition("_")
        section = rf"\[{index}(?:sub{sub})?\]\n" if sub in ("", "0") else rf"\[{index}sub{sub}\]\n"
        pattern = rf"({section}(?:[^\[\n].*\n)*?ParameterValue=).*"
        if sub == "" and not re.search(pattern, text):
            pattern = pattern.replace(section, rf"\[{index}sub0\]\n")
        text, count = re.subn(pattern, rf"\g<1>{value}", text)
        assert count == 1, f"{name}: {count} times"
    file.write_text(text)

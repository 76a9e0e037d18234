"""Subject and output of the verb params, and a parameter file that is changed."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

from jointctl.tools.configuration.load import shipped_config
from jointctl.tools.inspection.parameters import ParameterSet, read_parameters
from jointctl.tools.inspection.subject import SdoReader, Subject, canopen_network
from jointctl.tools.output import Output

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
    """Replace the values of objects, `o6072="500"`."""
    lines = file.read_text().splitlines()
    for name, value in values.items():
        key = name.removeprefix("o").replace("_", ":")
        (at,) = [i for i, line in enumerate(lines) if line.startswith((f"{key} = ", f'"{key}" = '))]
        lines[at] = f'"{key}" = {value}'
    file.write_text("\n".join(lines) + "\n")

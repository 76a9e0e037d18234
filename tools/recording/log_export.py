"""A run log in the formats of other programs: CSV, NPZ, Parquet for the records, candump's for the raw frames.

Columns have the names and units of `LogRecord`; an array field becomes one column an element (`weights_0` ...).  The
drive's temperature, if the log has it, is a column as well: in each line the newest reading, nan before the first one.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.can.frames import ERROR_FLAG
from jointctl.drivers.errors import DataError
from jointctl.tools.recording.ros_messages import SECOND_NS, stamps_ns
from jointctl.tools.recording.run_log import calendar_offset_ns
from jointctl.tools.recording.run_log_reader import RunLog

_ROWS = 10_000  # turned into Python numbers at once


def columns(records: np.ndarray) -> dict[str, np.ndarray]:
    """Name -> values, shape (N,), of every field of a record array."""
    found: dict[str, np.ndarray] = {}
    for name in records.dtype.names or ():
        values = np.asarray(records[name])
        if values.ndim == 1:
            found[name] = values
        else:
            found |= {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
    return found


def table_columns(log: RunLog) -> dict[str, np.ndarray]:
    """`columns` of the records, and the temperature where there is one."""
    found = columns(log.records)
    if len(log.temperatures):
        newest = np.searchsorted(log.temperatures["time_ns"], found["time_ns"], side="right") - 1
        read = log.temperatures["temperature_degC"][np.maximum(newest, 0)]
        found["temperature_degC"] = np.where(newest >= 0, read, np.nan)
    return found


def csv_bytes(log: RunLog, path: Path) -> bytes:
    """Comma, point, one header line; floats with all their digits."""
    found = table_columns(log)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(found)
    for begin in range(0, len(log.records), _ROWS):
        writer.writerows(zip(*(values[begin : begin + _ROWS].tolist() for values in found.values()), strict=True))
    return text.getvalue().encode()


def npz_bytes(log: RunLog, path: Path) -> bytes:
    """One array a field, `weights` of shape (N, 15); events and temperatures as arrays of their own."""
    data = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(log.records[name]) for name in log.records.dtype.names}
    arrays["temperature_time_ns"] = log.temperatures["time_ns"]
    arrays["temperature_degC"] = log.temperatures["temperature_degC"]
    arrays["event_time_ns"] = np.array([event.time_ns for event in log.events], np.int64)
    arrays["event_level"] = np.array([event.level for event in log.events], np.int32)
    arrays["event_text"] = np.array([f"{event.source}: {event.text}" for event in log.events], np.str_)
    np.savez_compressed(data, allow_pickle=False, **arrays)
    return data.getvalue()


def parquet_bytes(log: RunLog, path: Path) -> bytes:
    """A table of all columns, the metadata of the log as the table's."""
    try:
        pyarrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        raise DataError(
            f"{path}: Parquet needs the package pyarrow, which is not installed",
            "install the extra `parquet`, or export to npz or csv",
        ) from None
    table = pyarrow.table({name: pyarrow.array(values) for name, values in table_columns(log).items()})
    metadata = {f"{name}.{key}": value for name, values in log.metadata.items() for key, value in values.items()}
    data = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata(metadata), data)
    return data.getvalue()


def candump_lines(frames: np.ndarray, offset_ns: int, channel: str) -> Iterator[str]:
    """`(1436509053.249713) can0 181#2F0100`, as `candump -L` writes; `offset_ns` from the log's clock to the calendar.

    Eight hexadecimal digits mark an extended identifier; an error frame has the error flag in its identifier.
    """
    for time_ns, row in zip((stamps_ns(frames) + offset_ns).tolist(), frames, strict=True):
        seconds, rest_ns = divmod(time_ns, SECOND_NS)
        identifier = int(row["id"])
        if row["is_error"]:
            name = f"{identifier | ERROR_FLAG:08X}"
        else:
            name = f"{identifier:08X}" if row["is_extended"] else f"{identifier:03X}"
        size = int(row["dlc"])
        data = f"R{size}" if row["is_rtr"] else bytes(row["data"][:size]).hex().upper()
        yield f"({seconds}.{rest_ns // 1000:06d}) {channel} {name}#{data}\n"


def candump_bytes(log: RunLog, path: Path) -> bytes:
    """The raw frames in calendar time, for canplayer, cantools, Wireshark and the like."""
    if not len(log.frames):
        raise DataError(f"{path}: holds no CAN frames", "set log.frames = true in the configuration and run again")
    offset_ns = calendar_offset_ns(log.metadata.get("clock", {}))
    return "".join(candump_lines(log.frames, offset_ns, "can0")).encode()


# format -> (ending of the file, its maker)
FORMATS: dict[str, tuple[str, Callable[[RunLog, Path], bytes]]] = {
    "csv": (".csv", csv_bytes),
    "npz": (".npz", npz_bytes),
    "parquet": (".parquet", parquet_bytes),
    "candump": (".candump.log", candump_bytes),
}

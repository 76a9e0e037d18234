"""The files of a sweep: rows are written as they are measured, so that an interrupted sweep keeps them.

Beside the CSV (format: `tools.identification.friction_data`) lies its JSON sidecar; it also holds the plan's hash and
which of the plan's points the rows are, so that a sweep can be resumed.  The row is written first: rows beyond the
sidecar's list were cut off by a crash, and are measured again.  A busy disk can take longer to confirm a row than the
loop goes without its supervisor, so a thread waits for it.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table as TerminalTable

from jointctl.drivers.drive import DriveIdentity
from jointctl.drivers.errors import DataError
from jointctl.firmware_py.input_file import LARGEST_TABLE_BYTES, parse_json, read_input
from jointctl.tools.drawing import BLUE, ORANGE, RED
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS, sidecar_contents
from jointctl.tools.output import Output
from jointctl.tools.recording.report_page import (
    Block,
    Details,
    Figure,
    Section,
    Table,
    draw,
    from_terminal,
    write_verb_page,
)
from jointctl.tools.sweeping.carry_out import MeasuredPoint
from jointctl.tools.written_file import replace_file, writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

HEADING = ",".join(SWEEP_COLUMNS) + "\n"
LOAD_COLUMN = "load_Nm"  # of a sweep under known loads


def _heading(sidecar: dict[str, Any]) -> str:
    return HEADING.replace("\n", f",{LOAD_COLUMN}\n") if sidecar.get("loaded") else HEADING


def _shows_progress(sidecar: dict[str, Any]) -> bool:
    """Whether it says, as this module writes it, what was measured until when, and what of it did not settle."""
    measured, unsettled, elapsed_s = (sidecar.get(key) for key in ("measured", "unsettled", "elapsed_s"))
    return (
        isinstance(measured, list) and all(type(index) is int and index >= 0 for index in measured)
        and isinstance(unsettled, dict) and all(index.isdecimal() for index in unsettled)
        and isinstance(elapsed_s, (int, float)) and 0.0 <= elapsed_s < math.inf
    )  # fmt: skip


def _replace(path: Path, text: str) -> None:
    replace_file(path, text.encode())


class SweepFile:
    """CSV and sidecar of one sweep, open for appending; `done` are the indices of the points in the file."""

    def __init__(self, path: Path, sidecar: dict[str, Any], torque_constant_NmpA: float) -> None:
        self.path = path
        self._sidecar = sidecar
        self._torque_constant_NmpA = torque_constant_NmpA
        self._stream = path.open("a", encoding="ascii", newline="")
        self._to_disk = ThreadPoolExecutor(1, "sweep-file")
        self._last: Future[None] | None = None

    @property
    def done(self) -> set[int]:
        return set(self._sidecar["measured"])

    @property
    def visits(self) -> Counter[int]:
        """How many rows each point has."""
        return Counter(self._sidecar["measured"])

    @property
    def unsettled(self) -> dict[int, str]:
        """Points whose last row did not settle."""
        return {int(index): problem for index, problem in self._sidecar["unsettled"].items()}

    @property
    def elapsed_s(self) -> float:
        """Time column of the last row before this session, so that time goes on."""
        return float(self._sidecar["elapsed_s"])

    @property
    def drives(self) -> list[str]:
        """On which drive it was measured, as `StopSignals.drives`; none where the sidecar does not say."""
        drive = self._sidecar.get("drive")
        if not isinstance(drive, dict):
            return []
        return [DriveIdentity(*(str(drive.get(key, "")) for key in ("vendor", "product", "revision", "serial"))).text]

    @classmethod
    def create(
        cls, path: Path, reduction_ratio: float, torque_constant_NmpA: float, plan: str, more: dict[str, Any]
    ) -> SweepFile:
        """New files; existing ones are never overwritten."""
        for file in (path, path.with_suffix(".json")):
            if file.exists():
                raise DataError(f"{file}: exists already", "--resume goes on with it, -o gives another name")
        sidecar = sidecar_contents(
            reduction_ratio, torque_constant_NmpA, plan=plan, measured=[], elapsed_s=0.0, unsettled={}, **more
        )
        _replace(path, _heading(sidecar))
        try:
            _replace(path.with_suffix(".json"), json.dumps(sidecar, indent=1))
        except DataError:
            path.unlink()
            raise
        return cls(path, sidecar, torque_constant_NmpA)

    @classmethod
    def resume(cls, path: Path, torque_constant_NmpA: float, plan: str) -> SweepFile:
        """The files of an interrupted sweep of the same plan."""
        beside = path.with_suffix(".json")
        try:
            sidecar = parse_json(read_input(beside).decode("utf-8"))
            lines = read_input(path, LARGEST_TABLE_BYTES).decode("ascii").splitlines(keepends=True)
        except OSError as error:
            raise DataError(
                f"{error.filename}: cannot be read: {error.strerror or error}", "--resume needs it"
            ) from None
        except ValueError:
            raise DataError(
                f"{path}: the sweep or its sidecar {beside.name} is damaged: it cannot be resumed"
            ) from None
        if not isinstance(sidecar, dict) or "plan" not in sidecar or not _shows_progress(sidecar):
            raise DataError(f"{beside}: is not the sidecar of a sweep")
        if sidecar["plan"] != plan:
            raise DataError(
                f"{beside}: was measured with another plan ({sidecar['plan']}, now {plan})",
                "give the options and the configuration of the first time, or another -o",
            )
        rows = len(sidecar["measured"])
        if lines[:1] != [_heading(sidecar)]:
            raise DataError(
                f"{path}: line 1 is not the heading that the sweep wrote, with its line end",
                "another program has saved it: `identify` may read it, --resume needs it as it was",
            )
        whole = sum(line.endswith("\n") for line in lines) - 1
        if whole < rows:
            raise DataError(f"{path}: holds {whole} whole rows, its sidecar counts {rows}")
        if len(lines) > rows + 1:
            _replace(path, "".join(lines[: rows + 1]))
        return cls(path, sidecar, torque_constant_NmpA)

    def add(self, measured: MeasuredPoint) -> None:
        """One row, in the hands of the operating system when this returns, and soon on the disk.

        `DataError` if it or the one before could not be written.
        """
        if self._last is not None and self._last.done():
            self._settle(self._last)
        point, result = measured.point, measured.result
        current, temperature_degC = 1.0 / self._torque_constant_NmpA, measured.temperature_degC
        values = (
            f"{result.velocity_radps:.9g}", f"{result.motor_torque_Nm * current:.9g}", f"{result.motor_torque_Nm:.9g}",
            f"{result.velocity_std_radps:.6g}", f"{result.motor_torque_std_Nm * current:.6g}", result.samples,
            int(result.settled), f"{result.position_min_rad:.7g}", f"{result.position_max_rad:.7g}",
            f"{measured.time_s:.3f}", "" if temperature_degC is None else f"{temperature_degC:.1f}", point.direction,
            point.pass_number, *([f"{measured.load_Nm:.9g}"] if self._sidecar.get("loaded") else []),
        )  # fmt: skip
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(values)
        with writing(self.path):
            self._stream.write(line.getvalue())
            self._stream.flush()
        self._sidecar["measured"].append(point.index)
        self._sidecar["elapsed_s"] = round(measured.time_s, 3)
        if result.problem:
            self._sidecar["unsettled"][str(point.index)] = result.problem
        else:
            self._sidecar["unsettled"].pop(str(point.index), None)
        self._last = self._to_disk.submit(self._keep, json.dumps(self._sidecar, indent=1))

    def _keep(self, sidecar: str) -> None:
        os.fsync(self._stream.fileno())
        _replace(self.path.with_suffix(".json"), sidecar)

    def _settle(self, kept: Future[None]) -> None:
        with writing(self.path):
            kept.result()

    def close(self) -> None:
        """Files without one row are removed: nothing was measured, and they would be in the way of the next try."""
        self._to_disk.shutdown()
        with suppress(OSError):  # a full disk, which `add` has reported
            self._stream.close()
        if not self._sidecar["measured"]:
            self.path.unlink(missing_ok=True)
            self.path.with_suffix(".json").unlink(missing_ok=True)
        if self._last is not None:
            self._settle(self._last)


def measured_before(path: Path, plan: str) -> bool:
    """Whether these files are an interrupted sweep of this plan."""
    try:
        SweepFile.resume(path, 1.0, plan).close()
    except DataError:
        return False
    return path.exists()


# --- The page of a sweep: what was measured, drawn and listed, from the files that the sweep has written ---


def write_sweep_page(path: Path, data: Path, summary: TerminalTable, output: Output) -> None:
    """`summary` is the table that the terminal shows; the points come from the CSV file `data`, its JSON beside it."""
    rows = list(csv.DictReader(read_input(data, LARGEST_TABLE_BYTES).decode("ascii").splitlines()))
    beside = data.with_suffix(".json")
    about = parse_json(read_input(beside).decode("utf-8"))
    blocks: list[Block] = [_figure(rows)] if rows else []
    tones = {i: "warning" for i, row in enumerate(rows) if row["settled"] == "0"}
    warm = any(row["temperature_degC"] for row in rows)
    listed = Table(
        ["velocity [rad/s]", "motor torque [Nm]", "deviation of velocity [rad/s]", "samples", "settled", "time [s]",
         *(["temperature [°C]"] if warm else [])],
        [
            (
                f"{float(row['velocity_radps']):.5f}", f"{float(row['motor_torque_Nm']):.5f}",
                f"{float(row['velocity_std_radps']):.4f}", row["samples"], "yes" if row["settled"] == "1" else "no",
                f"{float(row['time_s']):.1f}", *([row["temperature_degC"] or "-"] if warm else []),
            )
            for row in rows
        ],
        tones=tones,
    )  # fmt: skip
    sections = [
        Section("What was measured", [from_terminal(summary)]),
        Section("Friction", blocks),
        Section("Points", [listed]),
        Section("Configuration", [Details("Configuration", str(about.get("configuration", "")))]),
    ]
    write_verb_page(path, f"Friction sweep: {data.stem}", sections, output, subtitle=str(data), inputs=(data, beside))


def _figure(rows: list[dict[str, Any]]) -> Figure:
    velocity, torque = (np.array([float(row[key]) for row in rows]) for key in ("velocity_radps", "motor_torque_Nm"))
    settled = np.array([row["settled"] == "1" for row in rows])

    def paint(figure: MatplotlibFigure) -> None:
        whole, near = figure.subplots(1, 2, width_ratios=(3, 2))
        for axis in (whole, near):
            for mask, colour, label in ((settled & (velocity > 0), BLUE, "positive"),
                                        (settled & (velocity < 0), ORANGE, "negative"),
                                        (~settled, RED, "not settled")):  # fmt: skip
                if np.any(mask):
                    axis.plot(np.abs(velocity[mask]), np.abs(torque[mask]), ".", color=colour, label=label)
            axis.set_xlabel("speed of the joint [rad/s]")
            axis.margins(x=0.03)
        whole.set_ylabel("size of the motor torque [Nm]")
        whole.legend()
        near.set_xscale("log")
        near.set_title("the same, slow speeds spread")

    return draw(4.2, paint, "Motor torque over the speed of the joint, both directions", "Each point is one plateau.")

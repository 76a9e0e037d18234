"""The page of a sweep: what was measured, drawn and listed, from the files that the sweep has written."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table as TerminalTable

from jointctl.firmware_py.input_file import LARGEST_TABLE_BYTES, parse_json, read_input
from jointctl.tools.drawing import BLUE, ORANGE, RED
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

    def paint(figure: Any) -> None:
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

"""`jointctl doctor`: what this computer, its CAN adapter and the configuration allow, with a cure for what is amiss.

Reads and measures only: nothing moves, no object of the drive is written; the one thing sent on the bus is the SDO
request to read object 1000h (device type).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

from rich.table import Table
from rich.text import Text

from jointctl.firmware_py.kernel import cache_folder
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.health import (
    NOTE,
    OK,
    PROBLEM,
    Finding,
    adapters,
    bus_budget,
    drive_finding,
    interface_state,
    kernel_cache,
    kernel_findings,
    scheduling,
    software,
    wake_up,
)
from jointctl.tools.inspection.serial_health import serial_findings
from jointctl.tools.output import Output


def findings(config: Config, *, cold: bool = False, wake_cycles: int | None = None) -> Iterator[Finding]:
    """All of them, each as soon as it is known; the wake-up is measured for a second each."""
    yield from software()
    yield from kernel_findings()
    yield from scheduling()
    yield from wake_up(config, wake_cycles or max(1, round(config.loop.rate_Hz)))
    yield from kernel_cache(cache_folder, cold)
    if config.is_serial:
        yield from serial_findings(config)
        return
    yield from adapters(config)
    yield bus_budget(config)
    yield drive_finding(config)
    yield from interface_state(config)  # last: a bus on which nobody acknowledges shows once something was sent


def doctor(config: Config, output: Output, *, cold: bool = False) -> int:
    """Examine and report; 0, or 1 if a run would fail.  `cold` also measures a start with an empty cache (a minute)."""
    found = []
    for finding in findings(config, cold=cold):
        output.note(f"  {finding.topic}")
        found.append(finding)
    return report_findings(found, output, "Doctor")


def report_findings(found: list[Finding], output: Output, title: str) -> int:
    """The table, and 0 or 1 as for `doctor`."""
    table = Table(title=title, title_justify="left")
    for column in ("", "finding", "cure"):
        table.add_column(column)
    colours = {OK: "green", NOTE: "yellow", PROBLEM: "red"}
    for finding in found:
        topic = Text.assemble((finding.status, colours[finding.status]), " ", finding.topic)
        table.add_row(topic, finding.text, finding.cure)
    bad = any(finding.status == PROBLEM for finding in found)
    output.result(table, {"healthy": not bad, "findings": [asdict(finding) for finding in found]})
    return 1 if bad else 0

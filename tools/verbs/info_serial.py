"""`jointctl info` of a serial drive: every answer as it came, and what it means at the joint.  Reads only."""

from __future__ import annotations

from dataclasses import asdict

from rich.table import Table

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo_settings import elmo_section
from jointctl.tools.inspection.serial_health import inspected_drive
from jointctl.tools.output import Output


def info_serial(config: Config, output: Output) -> int:
    """Identity, state, fault and limits of the drive on the port of the configuration."""
    section = elmo_section(config)
    place = f"{section.port} at {section.baud_rate_bitps} baud"
    output.note(f"reading the drive on {place}")
    with inspected_drive(config) as (drive, identity):
        facts = drive.facts()
    table = Table(title=f"{identity.name} on {place}", title_justify="left", show_header=False, box=None)
    for column in ("name", "label", "value", "meaning"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for fact in facts:
        table.add_row(fact.name, fact.label, fact.value, fact.meaning)
    data = {"port": section.port, "baud_rate_bitps": section.baud_rate_bitps, "version": identity.name}
    output.result(table, {**data, "facts": [asdict(fact) for fact in facts]})
    return 0

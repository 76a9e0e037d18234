"""`jointctl info`: what a drive tells about itself.  Reads only, and may be used beside a run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.table import Column, Table
from rich.text import Text

from jointctl.tools.output import Output
from jointctl.tools.verbs.bench_drive import AskedDrive, bench_of
from jointctl.tools.verbs.verb_options import VerbOutput

if TYPE_CHECKING:
    from jointctl.tools.inspection.subject import Subject

_TITLES = {
    "identity": "Identity", "errors": "Errors", "state": "State", "ratings": "Ratings", "limits": "Limits",
    "present": "Present values", "supervision": "Supervision", "pdos": "PDOs",
}  # fmt: skip


def info(asked: AskedDrive, output: VerbOutput) -> int:
    """What a drive tells about itself: identity, state, errors by name, limits, ratings, PDO mapping.  Reads only."""
    return bench_of(asked.config).info(asked, output)


def node_info(subject: Subject, output: Output) -> int:
    """Of the CANopen node that `subject` names."""
    from jointctl.tools.inspection.drive_info import drive_info
    from jointctl.tools.inspection.subject import SdoReader, canopen_network

    node = subject.required_node()
    objects = subject.objects()
    with canopen_network(subject) as network:
        output.note(f"reading node {node} on {subject.place}")
        found = drive_info(SdoReader(network, node, objects))
    output.result(info_table(found), found)
    return 0


def info_table(found: dict[str, Any]) -> Table:
    """One table for all sections; sections are dicts or lists of dicts."""
    table = Table(Column(style="bold"), "", "", show_header=False, box=None, pad_edge=False)
    for section, content in found.items():
        if not content:
            continue
        table.add_row(Text(_TITLES.get(section, section), "cyan"), "", "")
        rows = _dict_rows(content) if isinstance(content, dict) else _list_rows(content)
        for cells in rows:
            table.add_row(*cells)
    return table


def _dict_rows(content: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    for key, value in content.items():
        if value is None or value == []:
            continue
        stem, _, unit = key.rpartition("_")
        known = unit in ("A", "Nm", "NmpA", "ms", "s")
        name = (stem if known else key).replace("_", " ")
        if isinstance(value, list):
            for number, item in enumerate(value):
                yield ("  " + name if number == 0 else "", _plain_text(item), "")
        else:
            yield ("  " + name, _plain_text(value), unit.replace("NmpA", "Nm/A") if known else "")


def _list_rows(content: list[dict[str, Any]]) -> Iterator[tuple[str, str, str]]:
    for row in content:
        if "pdo" in row:
            how = f"{row['cob_id']} {'on' if row['enabled'] else 'off'}, {row['transmission']}"
            yield f"  {row['pdo']}", how, "; ".join(row["objects"]) or "nothing mapped"
        else:
            yield f"  {row['object']} {row['name']}", str(row["value"]), row["unit"]


def _plain_text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{item} ms" if key == "ms" else f"{key} {item}" for key, item in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)

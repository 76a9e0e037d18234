"""docs/troubleshooting.md quotes messages as the program prints them, and docs/safety.md has every fault's."""

from __future__ import annotations

import ast
import re

from jointctl.tools.session.fault_words import FAULT_TEXTS
from tests.places import ROOT

PAGE = (ROOT / "docs" / "troubleshooting.md").read_text()
FAULTS = (ROOT / "docs" / "safety.md").read_text()
GAP = "…"


def printed_texts() -> list[str]:
    """Every text in the sources, with a gap where a value goes."""
    found = []
    for folder in ("drivers", "firmware_py", "hil", "interface", "tools"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.JoinedStr):
                    found.append("".join(p.value if isinstance(p, ast.Constant) else GAP for p in node.values))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found.append(re.sub(r"{[^}]*}", GAP, node.value))
    return found


def test_every_quoted_message_is_in_the_sources() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| `")]
    messages = [line.split("`")[1] for line in rows]
    everything = "\n".join(printed_texts())
    assert len(messages) > 35
    unknown = [
        message for message in messages if not all(piece.strip(" :") in everything for piece in message.split(GAP))
    ]
    assert unknown == []


def test_every_fault_is_there_in_the_words_of_the_program() -> None:
    for fault, text in FAULT_TEXTS.items():
        happened = re.sub("{[^}]*}", GAP, text.happened)
        row = f"| {fault.name} ({fault.value}) | `{happened}` | {text.cause} | {text.next_step} |"
        assert row in FAULTS

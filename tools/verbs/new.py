"""`jointctl new FILE`: a shipped configuration as a file of one's own, to fill in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jointctl.drivers.errors import DataError
from jointctl.tools.verbs.verb_options import ProgressOutput


def new(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="configuration to write (TOML)")],
    output: ProgressOutput,
    *,
    shipped: Annotated[str, typer.Option("--from", help="name of the shipped configuration")] = "elmo_gold_can",
) -> int:
    """Write a configuration of your own, a copy of a shipped one to fill in."""
    from jointctl.tools.configuration.load import read_text, shipped_config

    source = shipped_config(shipped)
    text = read_text(source)
    if path.suffix != ".toml":
        raise DataError(f"{path}: the name of a configuration must end in .toml")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise DataError(f"{path}: exists already, a configuration is never overwritten") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    output.note(f"written: {path}, a copy of {source.name}")
    marked = text.count("FILL IN: ")
    if marked:
        output.note(f"next: fill in the {marked} values marked FILL IN, then jointctl doctor {path}")
    return 0

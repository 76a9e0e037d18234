"""`jointctl new FILE`: a shipped configuration as a file of one's own, to fill in."""

from __future__ import annotations

from pathlib import Path

from jointctl.drivers.errors import DataError
from jointctl.tools.configuration.load import read_text, shipped_config
from jointctl.tools.output import Output


def new(path: Path, output: Output, *, shipped: str) -> int:
    """Copy the shipped configuration `shipped` to `path`, which must not exist."""
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

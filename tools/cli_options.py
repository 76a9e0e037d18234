"""Options and arguments that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Interface = Annotated[str | None, typer.Option("-i", "--interface", help="python-can interface [env CAN_INTERFACE]")]
Channel = Annotated[str | None, typer.Option("-c", "--channel", help="bus channel [env CAN_CHANNEL]")]
Bitrate = Annotated[int | None, typer.Option("-b", "--bitrate", help="bit/s [env CAN_BITRATE]")]
Json = Annotated[bool, typer.Option("--json", help="result as one JSON document on stdout")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no progress on stderr")]
ConfigPath = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="configuration file (TOML), or the name of a shipped one")
]
Yes = Annotated[bool, typer.Option("-y", "--yes", help="move without asking")]


def config_path(path: Path) -> Path:
    """The file itself, or a shipped configuration of that name."""
    from tools.config import shipped_config

    shipped = shipped_config(str(path))
    return shipped if not path.exists() and shipped.exists() else path

"""Options and arguments that several verbs share."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config

Interface = Annotated[str | None, typer.Option("-i", "--interface", help="python-can interface (env CAN_INTERFACE)")]
Channel = Annotated[
    str | None,
    typer.Option("-c", "--channel", help="bus channel, with options: can0,host=...,port=... (env CAN_CHANNEL)"),
]
Bitrate = Annotated[int | None, typer.Option("-b", "--bitrate", help="bit/s (env CAN_BITRATE)")]
Port = Annotated[str | None, typer.Option("-p", "--port", help="serial port of an elmo_serial drive")]
Target = Annotated[
    int | None, typer.Option("-t", "--target", help="CANopen node instead of drive.node", min=1, max=127)
]


@dataclass(frozen=True)
class CanOptions:
    """Which CAN bus and node; None = as configured."""

    interface: Interface = None
    channel: Channel = None
    bitrate: Bitrate = None
    target: Target = None


@dataclass(frozen=True)
class BusOptions(CanOptions):
    """Which bus or port, and which node; None = as configured."""

    port: Port = None


Json = Annotated[bool, typer.Option("--json", help="result as one JSON document on stdout")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no progress on stderr")]
Report = Annotated[
    Path | None, typer.Option("--report", metavar="FILE.html", help="the result as one self-contained page as well")
]
ConfigPath = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="configuration file (TOML), or the name of a shipped one")
]
Yes = Annotated[bool, typer.Option("-y", "--yes", help="move without asking")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="commission, show the motion envelope, move nothing")]
AllowLowMargin = Annotated[
    bool, typer.Option("--allow-low-margin", help="run a stable loop below the wanted phase margin")
]
Workers = Annotated[int | None, typer.Option("--workers", help="processes; default: one a core")]


# headings of `jointctl --help`, in this order
BEGIN, MOVE, INSPECT, FRICTION = "Begin", "Move a joint", "Look at a bus and a drive", "Friction"
LOOK, COMPARE = "Look at a run", "Compare and measure"


def config_path(path: Path) -> Path:
    """The file itself, or a shipped configuration of that name."""
    from jointctl.tools.configuration.load import shipped_config

    shipped = shipped_config(str(path))
    return shipped if not os.path.exists(path) and os.path.exists(shipped) else path


def loaded(path: Path, bus: CanOptions | None = None) -> Config:
    """The configuration with what the command line and the environment say about bus, port and node."""
    from jointctl.tools.configuration.elmo_settings import with_port_override
    from jointctl.tools.configuration.load import load_config, with_bus_overrides

    bus = BusOptions() if bus is None else bus
    config = with_port_override(load_config(config_path(path)), bus.port if isinstance(bus, BusOptions) else None)
    config = with_bus_overrides(config, bus.interface, bus.channel, bus.bitrate)
    if bus.target is None:
        return config
    return config.model_copy(update={"drive": config.canopen.model_copy(update={"node": bus.target})})

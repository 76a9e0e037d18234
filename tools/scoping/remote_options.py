"""The options of Foxglove and ROS 2 beside a run, and what they mean; `--help` loads this."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Annotated

import typer

from jointctl.drivers.errors import UsageError

FOXGLOVE_PORT = 8765
FOXGLOVE_AT = f"127.0.0.1:{FOXGLOVE_PORT}"
HIGHEST_DOMAIN = 232
LISTEN_AT = "tcp/127.0.0.1:0"
DOMAIN = "ROS_DOMAIN_ID"  # in the environment, as for every ROS 2 node
_ADDRESS = re.compile(r"(\[(?P<six>[0-9a-fA-F:]+)\]|(?P<host>[^:/\s\[\]]*)):(?P<port>\d{1,5})")


@dataclass(frozen=True)
class ObserveOptions:
    """Who may look on; the values behind --foxglove and --ros2 can be left out (`with_values`)."""

    foxglove: Annotated[
        str | None,
        typer.Option("--foxglove", metavar="[HOST:PORT]", help=f"serve Foxglove (extra foxglove) at {FOXGLOVE_AT}"),
    ] = None
    ros2: Annotated[
        int | None,
        typer.Option(
            "--ros2", metavar="[DOMAIN]", min=0, max=HIGHEST_DOMAIN, help=f"be a ROS 2 node (extra ros2; env {DOMAIN})"
        ),
    ] = None
    ros2_listen: Annotated[
        str | None, typer.Option("--ros2-listen", metavar="ENDPOINT", help=f"of zenoh, instead of {LISTEN_AT}")
    ] = None


@dataclass(frozen=True)
class RemoteOptions(ObserveOptions):
    """And what they may do besides STOP."""

    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="set-points, gains and enable from Foxglove and ROS 2")
    ] = False
    hold: Annotated[
        bool, typer.Option("--hold", help="hold where the joint stands instead of the configured trajectory")
    ] = False


NOBODY = ObserveOptions()
NOBODY_REMOTE = RemoteOptions()


def with_values(words: Sequence[str]) -> list[str]:
    """The command line with the value behind --foxglove and --ros2 where it is left out."""
    usual = {"--foxglove": (FOXGLOVE_AT, _ADDRESS), "--ros2": (os.environ.get(DOMAIN) or "0", re.compile(r"-?\d+"))}
    found: list[str] = []
    for number, word in enumerate(words, 1):
        found.append(word)
        if word in usual and not usual[word][1].fullmatch("".join(words[number : number + 1])):
            found.append(usual[word][0])
    return found


def usual_domain() -> int:
    """That of the environment, or 0; `UsageError` for what is none."""
    text = os.environ.get(DOMAIN) or "0"
    if not text.isascii() or not text.isdecimal() or int(text) > HIGHEST_DOMAIN:
        raise UsageError(f"{DOMAIN} (={text[:40]}) must be in [0..{HIGHEST_DOMAIN}]")
    return int(text)


def foxglove_place(text: str) -> tuple[str, int]:
    """Host and port; `UsageError` for what is no address of this computer alone."""
    found = _ADDRESS.fullmatch(text)
    if found is None or not 1 <= int(found["port"]) <= 65535:
        raise UsageError(f"--foxglove (={text[:80]}) must be HOST:PORT, such as {FOXGLOVE_AT}")
    host = found["six"] or found["host"] or "127.0.0.1"
    try:
        local = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        local = False
    if not local:
        raise UsageError(
            f"--foxglove (={text[:80]}) must be on the loopback address (127.0.0.1, localhost, [::1]): its protocol "
            "has no password",
            f"from elsewhere by a tunnel: ssh -L {FOXGLOVE_PORT}:{FOXGLOVE_AT} USER@CONTROLLER",
        )
    return host, int(found["port"])


def check_remote(options: ObserveOptions) -> None:
    """`UsageError` for what does not go together."""
    if options.foxglove is not None:
        foxglove_place(options.foxglove)
    if options.ros2 is not None and not 0 <= options.ros2 <= HIGHEST_DOMAIN:
        raise UsageError(f"--ros2 (={options.ros2}) must be in [0..{HIGHEST_DOMAIN}]")
    if options.ros2_listen is not None:
        if options.ros2 is None:
            raise UsageError("--ros2-listen goes with --ros2")
        if not re.fullmatch(r"(tcp|udp|quic|tls|unixsock-stream)/\S+", options.ros2_listen):
            raise UsageError(f"--ros2-listen (={options.ros2_listen[:80]}) must be an endpoint such as {LISTEN_AT}")
    served = options.foxglove is not None or options.ros2 is not None
    if isinstance(options, RemoteOptions) and options.allow_remote and not served:
        raise UsageError("--allow-remote goes with --foxglove or --ros2")

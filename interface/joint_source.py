"""Which joint is meant: a file, a shipped configuration, a virtual joint of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.scoping.remote_options import FOXGLOVE_AT, RemoteOptions, usual_domain

_NUMBERS = count(1)
Place = tuple[str | None, str | None, int | None, str | None, int | None]  # interface, channel, bitrate, port, node


@dataclass(frozen=True)
class JointSource:
    """A configuration, and whether its virtual joint is to be started."""

    config: Config
    own_virtual: bool

    @contextmanager
    def served(self) -> Iterator[None]:
        """With the virtual joint running, in a process of its own, where it is one's own."""
        from jointctl.tools.virtual_joint import own_virtual_joint

        if not self.own_virtual:
            yield
            return
        with own_virtual_joint(self.config.path, self.config.bus.channel):
            yield


def observers(foxglove: bool | str, ros2: bool | int, *, allow_remote: bool) -> RemoteOptions:
    """Who may look on, as the options of `jointctl run` say it."""
    at = FOXGLOVE_AT if foxglove is True else foxglove or None
    domain = usual_domain() if ros2 is True else None if ros2 is False else ros2
    return RemoteOptions(at, domain, allow_remote=allow_remote)


def joint_source(given: str | Path | Config, place: Place, *, virtual: bool) -> JointSource:
    """`ConfigurationError` for what cannot be read, or has no virtual joint although one is asked for."""
    from jointctl.tools.configuration.drive_section import GivenPlace, require_simulated
    from jointctl.tools.configuration.load import load_config, moved
    from jointctl.tools.verbs.demo import with_patience
    from jointctl.tools.verbs.verb_options import config_path

    if isinstance(given, Config):
        config, shipped = given, False
    else:
        path = config_path(Path(given))
        config, shipped = load_config(path), not os.path.exists(given)
    own = virtual or (shipped and config.virtual is not None and not any(place))
    if not own:
        return JointSource(moved(config, GivenPlace(*place)), False)
    require_simulated(config, "a virtual joint")
    if config.virtual is None:
        raise ConfigurationError(f"{config.path}: has no [virtual] section, so there is no virtual joint to start")
    channel = f"python-{os.getpid()}-{next(_NUMBERS)}"
    return JointSource(with_patience(moved(config, GivenPlace("jointctl", channel), {})), True)

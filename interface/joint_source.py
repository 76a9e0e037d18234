"""Which joint or arm is meant: a file, a shipped configuration, virtual drives of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING

from jointctl.drivers.errors import ConfigurationError, UsageError
from jointctl.tools.configuration.config import Config
from jointctl.tools.scoping.remote_options import FOXGLOVE_AT, RemoteOptions, usual_domain

if TYPE_CHECKING:
    from jointctl.tools.child_process import OwnVirtualJoint
    from jointctl.tools.configuration.arm import ArmConfig

_NUMBERS = count(1)
SHIPPED_NAME = "virtual"  # what `Arm` calls the shipped arm
_WORDS = {"Joint": "a joint", "Arm": "an arm"}
Place = tuple[str | None, str | None, int | None, str | None, int | None]  # interface, channel, bitrate, port, node


@dataclass(frozen=True)
class Wanted:
    """What a program asks for, as the arguments of `Joint`; `place`: instead of the configuration's."""

    place: Place = (None,) * 5
    virtual: bool = False
    allow_low_margin: bool = False
    foxglove: bool | str = False
    ros2: bool | int = False
    allow_remote: bool = False


@dataclass(frozen=True)
class Source:
    """A configuration, and whether its virtual drives are to be started."""

    config: Config | ArmConfig
    own_virtual: bool

    @contextmanager
    def served(self) -> Iterator[OwnVirtualJoint | None]:
        """With the virtual drives starting, in a process of their own, where they are one's own."""
        from jointctl.tools.child_process import own_virtual_joint

        if not self.own_virtual:
            yield None
            return
        first = self.config if isinstance(self.config, Config) else self.config.joints[0]
        with own_virtual_joint(self.config.path, first.bus.channel) as own:
            yield own


def observers(foxglove: bool | str, ros2: bool | int, *, allow_remote: bool) -> RemoteOptions:
    """Who may look on, as the options of `jointctl run` say it; `UsageError` for what they cannot be."""
    if not isinstance(foxglove, (bool, str)):
        raise UsageError(f"foxglove (={foxglove}) must be True, False or HOST:PORT")
    if not isinstance(ros2, Integral):
        raise UsageError(f"ros2 (={ros2}) must be True, False or the number of a domain")
    at = FOXGLOVE_AT if foxglove is True else foxglove or None
    domain = usual_domain() if ros2 is True else None if ros2 is False else ros2
    return RemoteOptions(at, domain, allow_remote=allow_remote)


def wanted_source(given: str | Path | Config | ArmConfig, kind: str, wanted: Wanted) -> tuple[Source, RemoteOptions]:
    """For a "Joint" or an "Arm" (`kind`); `ConfigurationError` for what cannot be read, or is of the other one.

    Also where virtual drives are asked for and the configuration has none.
    """
    from jointctl.tools.configuration.drive_section import GivenPlace, require_simulated
    from jointctl.tools.configuration.load import moved
    from jointctl.tools.verbs.demo import with_patience
    from jointctl.tools.verbs.verb_options import arm_on_bus

    options = observers(wanted.foxglove, wanted.ros2, allow_remote=wanted.allow_remote)
    config, shipped = _loaded(given, kind)
    found = "Joint" if isinstance(config, Config) else "Arm"
    if found != kind:
        raise ConfigurationError(f"{config.path}: is no file of {_WORDS[kind]}", f"jointctl.{found} moves it")
    joints = (config,) if isinstance(config, Config) else config.joints
    without = [joint.path for joint in joints if joint.virtual is None]
    own = wanted.virtual or (shipped and not without and set(wanted.place) == {None})
    for joint in joints if own else ():
        require_simulated(joint, "a virtual joint")
    if own and without:
        raise ConfigurationError(f"{without[0]}: has no [virtual] section, so there is no virtual joint to start")
    place = GivenPlace("jointctl", f"python-{os.getpid()}-{next(_NUMBERS)}") if own else GivenPlace(*wanted.place)
    if isinstance(config, Config):
        config = moved(config, place, {}) if own else moved(config, place)
        return Source(with_patience(config) if own else config, own), options
    arm = arm_on_bus(config, place)
    return Source(replace(arm, joints=tuple(map(with_patience, arm.joints))) if own else arm, own), options


def _loaded(given: str | Path | Config | ArmConfig, kind: str) -> tuple[Config | ArmConfig, bool]:
    """The configuration, and whether it is a shipped one that was named."""
    from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_joint_or_arm
    from jointctl.tools.verbs.verb_options import config_path

    if isinstance(given, (Config, ArmConfig)):
        return given, False
    if not isinstance(given, (str, Path)):
        raise ConfigurationError(
            f"config (={str(given)[:40]}) must be a file, a name, or a configuration that was read"
        )
    shipped = not os.path.exists(given)
    its_own = shipped and kind == "Arm" and str(given) == SHIPPED_NAME
    return load_joint_or_arm(SHIPPED_ARM if its_own else config_path(Path(given))), shipped

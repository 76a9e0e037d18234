"""`jointctl demo`: the main job on a virtual joint in a process of its own; needs no hardware and no set-up."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import ConfigurationError, UsageError
from jointctl.tools.verbs.verb_options import VerbOutput, config_path, configurations, on_bus

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.config import Config

LONGEST_S = 86_400.0
PATIENCE_S = 0.15  # a shared computer may stand still for so long; here only simulated metal waits for it


def demo(
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", help="configuration with a virtual joint", show_default="virtual", autocompletion=configurations
        ),
    ] = None,
    *,
    arm: Annotated[bool, typer.Option("--arm", help="the shipped arm of three joints instead of one joint")] = False,
    duration_s: Annotated[float | None, typer.Option("--duration", help="seconds of the trajectory", min=0.1)] = None,
    output: VerbOutput,
) -> int:
    """Track a trajectory on the virtual joint, or with a virtual arm: no hardware, no set-up."""
    from jointctl.tools.child_process import own_virtual_joint
    from jointctl.tools.configuration.drive_section import GivenPlace
    from jointctl.tools.verbs.run import tracked

    if arm and config is not None:
        raise UsageError(f"--config (={config}) is for one joint: --arm is the shipped arm")
    given = _arm() if arm else _joint(config_path(config or Path("virtual")))
    channel = f"demo-{os.getpid()}"
    moving = on_bus(given, GivenPlace("jointctl", channel), {})
    if duration_s is not None:
        moving = each_joint(moving, partial(_with_duration, duration_s=duration_s))
    output.note(f"starting the virtual {'arm' if arm else 'joint'}")
    with own_virtual_joint(given.path, channel, output.note) as own:
        return tracked(each_joint(moving, with_patience), output, assume_yes=True, own=own)


def _arm() -> ArmConfig:
    from jointctl.tools.configuration.arm import SHIPPED_ARM, load_arm

    return load_arm(SHIPPED_ARM)


def _joint(path: Path) -> Config:
    from jointctl.tools.configuration.drive_section import require_simulated
    from jointctl.tools.configuration.load import load_config

    joint = load_config(path)
    require_simulated(joint, "demo")
    if joint.virtual is None:
        raise ConfigurationError(f"{joint.path}: has no [virtual] section, so there is no virtual joint to move")
    return joint


def each_joint(given: Config | ArmConfig, changed: Callable[[Config], Config]) -> Config | ArmConfig:
    """A joint, or an arm of joints, that were changed."""
    from jointctl.tools.configuration.config import Config

    return changed(given) if isinstance(given, Config) else replace(given, joints=tuple(map(changed, given.joints)))


def with_patience(config: Config) -> Config:
    """With limits on late samples and skipped periods that a busy computer keeps; less than the drive's own watch."""
    from jointctl.tools.configuration.canopen import canopen_section

    longest_s = min(PATIENCE_S, 0.75 * canopen_section(config).heartbeat_s)
    patient = {key: max(getattr(config.limits, key), longest_s) for key in ("sample_age_max_s", "skipped_max_s")}
    return config.changed(limits=patient)


def _with_duration(config: Config, duration_s: float) -> Config:
    if not duration_s <= LONGEST_S:
        raise ConfigurationError(f"--duration (={duration_s:g}) must be in [0.1..{LONGEST_S:g}] s")
    return config.changed(trajectory__duration_s=duration_s)

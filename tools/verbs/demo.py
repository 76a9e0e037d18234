"""`jointctl demo`: the main job on a virtual joint in a process of its own; needs no hardware and no set-up."""

from __future__ import annotations

import os
from pathlib import Path

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo_settings import refuse_serial
from jointctl.tools.configuration.load import load_config, with_bus_overrides
from jointctl.tools.output import Output
from jointctl.tools.simulation.virtual_joint import separate_virtual_joint
from jointctl.tools.verbs.run import run

LONGEST_S = 86_400.0
PATIENCE_S = 0.15  # a shared computer may stand still for so long; here only simulated metal waits for it


def demo(config_path: Path, output: Output, *, duration_s: float | None = None) -> int:
    """Start the virtual joint on a private bus, run the configuration on it, end it."""
    config = load_config(config_path)
    refuse_serial(config, "demo")
    if config.virtual is None:
        raise ConfigurationError(f"{config.path}: has no [virtual] section, so there is no virtual joint to move")
    channel = f"demo-{os.getpid()}"
    config = with_bus_overrides(config, interface="jointctl", channel=channel, environ={})
    if duration_s is not None:
        config = _with_duration(config, duration_s)
    config = with_patience(config)
    output.note("starting the virtual joint")
    with separate_virtual_joint(config_path, channel, output.note):
        return run(config, output, assume_yes=True)


def with_patience(config: Config) -> Config:
    """With limits on late samples and skipped periods that a busy computer keeps; less than the drive's own watch."""
    longest_s = min(PATIENCE_S, 0.75 * config.canopen.heartbeat_s)
    limits = config.limits
    update = {key: max(getattr(limits, key), longest_s) for key in ("sample_age_max_s", "skipped_max_s")}
    return config.model_copy(update={"limits": limits.model_copy(update=update)})


def _with_duration(config: Config, duration_s: float) -> Config:
    if not duration_s <= LONGEST_S:
        raise ConfigurationError(f"--duration (={duration_s:g}) must be in [0.1..{LONGEST_S:g}] s")
    trajectory = config.trajectory.model_copy(update={"duration_s": duration_s})
    return config.model_copy(update={"trajectory": trajectory})

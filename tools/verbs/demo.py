"""`jointctl demo`: the main job on a virtual joint in a process of its own; needs no hardware and no set-up."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import ConfigurationError, JointctlError
from jointctl.tools.verbs.verb_options import VerbOutput, config_path

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config

LONGEST_S = 86_400.0
POLL_S = 0.02
PATIENCE_S = 0.15  # a shared computer may stand still for so long; here only simulated metal waits for it


def demo(
    config: Annotated[Path, typer.Option("--config", help="configuration with a virtual joint")] = Path("virtual"),
    *,
    duration_s: Annotated[float | None, typer.Option("--duration", help="seconds of the trajectory", min=0.1)] = None,
    output: VerbOutput,
) -> int:
    """Track a trajectory on the virtual joint: no hardware, no set-up."""
    from jointctl.tools.configuration.drive_section import GivenPlace, require_simulated
    from jointctl.tools.configuration.load import load_config, moved
    from jointctl.tools.verbs.run import run
    from jointctl.tools.virtual_joint import separate_virtual_joint

    path = config_path(config)
    joint = load_config(path)
    require_simulated(joint, "demo")
    if joint.virtual is None:
        raise ConfigurationError(f"{joint.path}: has no [virtual] section, so there is no virtual joint to move")
    channel = f"demo-{os.getpid()}"
    joint = moved(joint, GivenPlace("jointctl", channel), {})
    if duration_s is not None:
        joint = _with_duration(joint, duration_s)
    joint = with_patience(joint)
    output.note("starting the virtual joint")
    with _compiling_beside(output.note) as loop_compiled, separate_virtual_joint(path, channel, output.note):
        loop_compiled()
        return run(joint, output, assume_yes=True)


def with_patience(config: Config) -> Config:
    """With limits on late samples and skipped periods that a busy computer keeps; less than the drive's own watch."""
    from jointctl.tools.configuration.canopen import canopen_section

    longest_s = min(PATIENCE_S, 0.75 * canopen_section(config).heartbeat_s)
    limits = config.limits
    update = {key: max(getattr(limits, key), longest_s) for key in ("sample_age_max_s", "skipped_max_s")}
    return config.model_copy(update={"limits": limits.model_copy(update=update)})


def _with_duration(config: Config, duration_s: float) -> Config:
    if not duration_s <= LONGEST_S:
        raise ConfigurationError(f"--duration (={duration_s:g}) must be in [0.1..{LONGEST_S:g}] s")
    trajectory = config.trajectory.model_copy(update={"duration_s": duration_s})
    return config.model_copy(update={"trajectory": trajectory})


@contextmanager
def _compiling_beside(tell: Callable[[str], None]) -> Iterator[Callable[[], None]]:
    """Where the loop is not compiled yet, a process does that beside what the block does; what this gives waits for it.

    Whatever becomes of it: the loop compiles by itself what it does not find.
    """
    from jointctl.firmware_py.kernel import cache_folder
    from jointctl.tools.child_process import Starting

    if cache_folder is None or any(cache_folder.rglob("realtime.run_loop-*.nbi")):
        yield lambda: None
        return
    tell("compiling, which only the first start does")
    command = [sys.executable, "-P", "-m", "jointctl.tools.session.loops"]
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent, start_new_session=True)

    def wait() -> None:
        starting = Starting("the loop", process, tell)
        with contextlib.suppress(JointctlError):
            while process.poll() is None:
                starting.check()
                time.sleep(POLL_S)

    try:
        yield wait
    finally:
        process.kill()
        process.wait()

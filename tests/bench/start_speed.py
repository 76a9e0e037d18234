"""How long a command takes to start: `--help` of every verb, and `run` until the drive is enabled.

Warm: compiled kernels are in the cache.  Cold: the cache is an empty folder, as after an installation or an edit of
a kernel; the bytecode of the libraries is there in both cases.
"""

from __future__ import annotations

import math
import os
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from jointctl.drivers.errors import JointctlError
from jointctl.tools.configuration.config import Config
from tests.bench.paired import Row, compared, interleaved, measured, separate_virtual_joint

GROUP = "start"
HELP_GOAL_S = 0.3
ENABLED_GOAL_S = 3.0
LONGEST_S = 240.0  # a cold start compiles everything
END_S = 10.0
ENABLED = ("approach", "tracking")  # the first phase with the drive enabled, as `run` names it on stderr


def _environment(cache: Path | None = None) -> dict[str, str]:
    environment = dict(os.environ)
    if cache is not None:
        environment["JOINTCTL_CACHE_DIR"] = str(cache)
    return environment


def command_s(*arguments: str) -> float:
    """Seconds that Python takes with these arguments, from start to end."""
    command = [sys.executable, "-P", *arguments]
    begin_s = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=_environment())
    limit = threading.Timer(LONGEST_S, process.kill)  # wait(timeout) would look every 50 ms only
    limit.start()
    try:
        code = process.wait()
    finally:
        limit.cancel()
    seconds = time.perf_counter() - begin_s
    if code != 0:
        raise subprocess.CalledProcessError(code, command)
    return seconds


def until_enabled_s(config_path: Path, channel: str, cache: Path | None = None) -> float:
    """Seconds from the start of `run` to its first phase with the drive enabled; the run is stopped then."""
    command = [sys.executable, "-P", "-m", "jointctl.tools.verbs", "run", str(config_path.resolve()), "-y"]
    # a busy computer may delay a few of the first cycles so that the margin gate refuses: not what is measured here
    command += ["--allow-low-margin"]
    command += ["--interface", "jointctl", "--channel", channel]
    with tempfile.TemporaryDirectory() as folder:
        begin_s = time.perf_counter()
        process = subprocess.Popen(
            command, cwd=folder, env=_environment(cache), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            elapsed_s = _wait_for(process, ENABLED, begin_s)
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=END_S)
            except subprocess.TimeoutExpired:
                process.terminate()
                process.communicate()
    return elapsed_s


def _wait_for(process: subprocess.Popen[bytes], words: tuple[str, ...], begin_s: float) -> float:
    """Seconds since `begin_s` when a line of stderr is one of `words`."""
    fd, text = process.stderr.fileno(), ""
    while (left_s := begin_s + LONGEST_S - time.perf_counter()) > 0.0:
        ready, _, _ = select.select([fd], [], [], left_s)
        part = os.read(fd, 4096).decode(errors="replace") if ready else ""
        if not part:
            break
        text += part
        if any(line.strip() in words for line in text.splitlines()):
            return time.perf_counter() - begin_s
    last = (text.strip().splitlines() or ["it said nothing"])[-1]
    raise JointctlError(f"`run` did not enable the drive: {last}")


def start_rows(config: Config, *, runs: int, cold: bool, verbs: Sequence[str]) -> Iterator[Row]:
    """The start of `verbs`, and of `run` until the drive is enabled, on a virtual joint of its own."""
    command_s("-m", "jointctl.tools.verbs", "--help")
    cli, bare = interleaved(
        runs, lambda: command_s("-m", "jointctl.tools.verbs", "--help"), lambda: command_s("-c", "pass")
    )
    yield measured(GROUP, "jointctl --help", cli, "s", goal=HELP_GOAL_S, note=f"best {min(cli):.2f} s")
    yield compared(GROUP, "jointctl --help", cli, bare, "s", "python -c pass")
    for verb in verbs:
        taken = [command_s("-m", "jointctl.tools.verbs", verb, "--help") for _ in range(2)]
        yield measured(GROUP, f"jointctl {verb} --help", [min(taken)], "s")
    channel = f"benchstart{os.getpid()}"
    with separate_virtual_joint(config.path, channel):
        until_enabled_s(config.path, channel)  # fills the cache, if need be
        warm = [until_enabled_s(config.path, channel) for _ in range(runs)]
        note = f"best {min(warm):.2f} s; the joint is up already"
        yield measured(GROUP, "run until enabled, warm", warm, "s", goal=ENABLED_GOAL_S, note=note)
        if not cold:
            yield Row(GROUP, "run until enabled, cold", math.nan, "s", note="skipped: takes a minute, not with --quick")
            return
        with tempfile.TemporaryDirectory() as cache:
            taken_s = until_enabled_s(config.path, channel, Path(cache))
        yield measured(GROUP, "run until enabled, cold", [taken_s], "s", note="everything is compiled")

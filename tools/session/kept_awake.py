"""A computer that is kept awake while a drive moves that would hold its last command."""

from __future__ import annotations

import contextlib
import select
import subprocess
from collections.abc import Iterator

from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output

# A child under systemd-inhibit holds the lock of systemd-logind as long as its standard input is open, so it ends
# with this process, however that ends.  A lid that is closed heeds only a lock of its own (logind.conf,
# LidSwitchIgnoreInhibited).


WHAT = "sleep:handle-lid-switch"
HELD_TIMEOUT_S = 2.0
ENDED_S = 1.0
_COMMAND = (
    "systemd-inhibit", f"--what={WHAT}", "--who=jointctl", "--why=a joint is in motion", "--mode=block",
    "sh", "-c", "echo held && exec cat >/dev/null",
)  # fmt: skip


def _start() -> subprocess.Popen[bytes] | None:
    """The child, in a session of its own, where it neither asks for a password nor hears Ctrl-C; None if it fails."""
    try:
        child = subprocess.Popen(
            _COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
        )
    except OSError:
        return None
    assert child.stdout is not None
    if select.select([child.stdout], [], [], HELD_TIMEOUT_S)[0] and child.stdout.read(1):
        return child
    _end(child)
    return None


def _end(child: subprocess.Popen[bytes]) -> None:
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.close()
    try:
        child.wait(ENDED_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
    child.stdout.close()


@contextlib.contextmanager
def kept_awake(config: Config, output: Output) -> Iterator[bool]:
    """Whether the computer is kept awake; nothing is done where the drive has a watchdog of its own."""
    if not config.drive.holds_last_command:
        yield False
        return
    child = _start()
    if child is None:
        output.note(
            "systemd-inhibit does not work here: the computer is not kept from falling asleep, "
            "and the drive would hold its last command in the meantime"
        )
        yield False
        return
    output.note("the computer is kept from falling asleep until the end of the run")
    try:
        yield True
    finally:
        _end(child)

"""The first code of `jointctl`: a stop during the imports of the command line ends it with a word, and no traceback."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import sys
from types import FrameType

# verbs that control a bus; the tests compare them with what each verb does
_CONTROLLING = {"run", "sweep", "excite", "map", "response", "tune", "clear-fault", "scope", "demo"}
_CONTROLLING_WITH = {("doctor", "--motion"), ("params", "restore")}


def will_control(words: set[str]) -> bool:
    """Whether a command of these words is about to control a bus."""
    controlling = bool(words & _CONTROLLING) or any(words.issuperset(both) for both in _CONTROLLING_WITH)
    return controlling and "--lockstep" not in words


FREE_DESCRIPTORS = 32  # that must be left: a run takes about 20, a library that gets none fails or hangs where it likes


INTERRUPTED = 128 + signal.SIGINT  # as in `drivers.errors`, whose package takes its time
AGAIN_S = 0.05


def _end_at_once(number: int, _: FrameType | None) -> None:
    """Nothing is open yet that would have to be closed."""
    _say(b"interrupted; nothing was begun\n")
    os._exit(INTERRUPTED)


def _say(line: bytes) -> None:
    with contextlib.suppress(OSError):
        os.write(2, line)


class Interruption:
    """Raises KeyboardInterrupt, and remembers it: Python drops what a signal raises in a callback or in a destructor,
    such as that of an import's lock, and goes on.  There it is raised again, and what takes the signals over looks at
    `seen` of the handler before it.
    """

    def __init__(self) -> None:
        self.seen = False
        self.over = False  # the verb has ended, and said how: the next signal ends a program that does not come to it
        self._number = 0
        self._show = sys.unraisablehook

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.over:
            os._exit(INTERRUPTED)
        self.seen, self._number = True, number
        raise KeyboardInterrupt

    def on_lost(self, lost: sys.UnraisableHookArgs) -> None:
        """In the place of `sys.unraisablehook`."""
        if lost.exc_type is not KeyboardInterrupt:
            self._show(lost)
            return
        import _thread
        import threading

        again = threading.Timer(AGAIN_S, _thread.interrupt_main, [self._number])
        again.daemon = True
        again.start()


def _stop_signals() -> list[int]:
    """Those that end this program as Ctrl-C does: of a verb that moves a joint, all that are not ignored.

    A script's background job ignores Ctrl-C, and `nohup` a closed terminal.
    """
    names = ("SIGINT", "SIGTERM", "SIGHUP") if will_control(set(sys.argv[1:])) else ("SIGINT",)
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return [number for number in numbers if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL)]


def _hurry() -> None:
    """`jointctl stop` before all ordinary programs, where the system allows it: it has Python to load first.

    The lowest of the real-time priorities, below any loop's.
    """
    if sys.argv[1:2] == ["stop"] and hasattr(os, "sched_setscheduler"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def main() -> None:
    """Until the verb begins, a stop simply ends the process; from then on it is a KeyboardInterrupt."""
    _hurry()
    ours = _stop_signals()
    for number in ours:
        signal.signal(number, _end_at_once)
    _require_descriptors()
    from jointctl.tools.verbs.main import main as run

    interruption = Interruption()
    sys.unraisablehook = interruption.on_lost
    for number in ours:
        signal.signal(number, interruption)
    try:
        run()
    except KeyboardInterrupt:  # where a verb has not begun, or while its last words were written
        interruption.over = True
        _say(b"interrupted\n")
        sys.exit(INTERRUPTED)
    finally:
        interruption.over = True
        # Python would end itself by SIGINT, whatever the code, where the last `exec` of a text was interrupted
        exec("")


def _require_descriptors() -> None:
    """Ends the program where too few files can be opened; a stop is tried all the same."""
    if sys.argv[1:2] != ["stop"] and (lacking := lacking_descriptors()):
        sys.stderr.write("error: {}\nhint: {}\n".format(*lacking))
        sys.exit(1)


def lacking_descriptors() -> tuple[str, str] | None:
    """What is wrong where too few files can be opened, and what to do about it; else None."""
    opened: list[int] = []
    try:
        while len(opened) < FREE_DESCRIPTORS:
            opened.append(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):
            text = f"open files: {len(opened)} more may be opened, at least {FREE_DESCRIPTORS} are needed"
            return text, "raise the limit, such as `ulimit -n 1024`"
    finally:
        for descriptor in opened:
            os.close(descriptor)
    return None


def require_descriptors() -> None:
    """For a program: `JointctlError` where too few files can be opened."""
    if lacking := lacking_descriptors():
        from jointctl.drivers.errors import JointctlError

        raise JointctlError(*lacking)


def never_refuse_a_character() -> None:
    """What the encoding of a terminal lacks (`LANG=C`) is escaped instead of ending the program."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def occupy_standard_streams() -> None:
    """Put the null device in the place of each that is closed, for this process and its children.

    Behind a closed one the next file or socket that is opened gets its number, and what is printed, by a child as well,
    lands in it: in a CAN socket or a log.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115

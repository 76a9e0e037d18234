"""jointctl as on a system that is not Linux: for a process, and its children, with this folder in PYTHONPATH.

The modules and calls that Windows or macOS lacks are hidden from jointctl's own modules; the libraries, which do
without them elsewhere, choose by the system that they find and keep them.  Files of /proc and /sys are hidden from all.
"""

import builtins
import ctypes
import os
import signal
import socket
import sys
import time
from types import ModuleType

MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
CALLS = {
    os: (
        "uname", "memfd_create", "pidfd_open", "eventfd", "eventfd_read", "eventfd_write", "openpty", "sysconf",
        "getuid", "geteuid", "getgid", "getegid", "getgroups", "getloadavg", "setsid", "killpg", "mkfifo", "fchmod",
        "fchown", "nice", "fork", "O_CLOEXEC", "O_NONBLOCK", "O_NOCTTY", "O_NOFOLLOW", "O_DIRECTORY",
        *(name for name in dir(os) if name.startswith(("sched_", "SCHED_", "posix_", "MFD_", "EFD_"))),
    ),
    signal: ("pthread_sigmask", "pthread_kill", "pidfd_send_signal", "setitimer", "SIGHUP", "SIGKILL", "SIGUSR1",
             "SIGUSR2", "SIGSTOP", "SIGCONT", "SIGTSTP", "SIGCHLD", "SIGPIPE", "SIGALRM"),
    socket: ("AF_CAN", "CAN_RAW", "PF_CAN", "AF_UNIX", "AF_NETLINK", "SOCK_SEQPACKET", "SOCK_NONBLOCK", "SOCK_CLOEXEC"),
    time: ("clock_gettime", "clock_gettime_ns", "CLOCK_MONOTONIC", "CLOCK_MONOTONIC_RAW", "CLOCK_REALTIME"),
    ctypes: (),
}  # fmt: skip


class _Library(ctypes.CDLL):
    def __init__(self, name, *rest, **more):  # type: ignore[no-untyped-def]
        if name is None:
            raise TypeError("there is no C library of the process itself")
        super().__init__(name, *rest, **more)


def _without(module, names):  # type: ignore[no-untyped-def]
    found = ModuleType(module.__name__)
    vars(found).update({name: value for name, value in vars(module).items() if name not in names})
    return found


_LEFT = {module.__name__: _without(module, names) for module, names in CALLS.items()}
_LEFT["ctypes"].CDLL = _Library  # type: ignore[attr-defined]
_import = builtins.__import__


def _import_for(name, globals=None, locals=None, fromlist=(), level=0):  # type: ignore[no-untyped-def]
    if str((globals or {}).get("__name__")).startswith("jointctl") and level == 0:
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name in _LEFT:
            return _LEFT[name]
    return _import(name, globals, locals, fromlist, level)


def _without_files(event, arguments):  # type: ignore[no-untyped-def]
    if event in ("open", "os.listdir", "os.scandir") and str(arguments[0]).startswith(("/proc/", "/sys/")):
        raise FileNotFoundError(arguments[0])


builtins.__import__ = _import_for
sys.addaudithook(_without_files)

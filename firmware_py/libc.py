"""The C library by name, and atomic words, usable in kernels.

Functions named by `ExternalFunction` are found by the linker, so that a kernel calling them can be cached on
disk (an address taken with ctypes cannot).  Pointers are passed as integer addresses.  With the JIT disabled the
same names are ctypes functions, so that the callers stay testable in plain Python.
"""

from __future__ import annotations

import ctypes
import errno as errno_codes
from typing import Any

import numpy as np

from jointctl.firmware_py.kernel import JIT_DISABLED, OnlyInKernels, kernel

_CTYPES = {"int32": ctypes.c_int32, "int64": ctypes.c_int64, "uintp": ctypes.c_size_t, "intp": ctypes.c_ssize_t}


def external(name: str, result: str, *arguments: str) -> Any:
    """A function of the C library; types by numba's names, as in `_CTYPES`."""
    if not JIT_DISABLED:
        return OnlyInKernels(lambda compiler: compiler.type_of_external(name, result, arguments))
    function = getattr(ctypes.CDLL(None, use_errno=False), name)
    function.restype = _CTYPES[result]
    function.argtypes = [_CTYPES[argument] for argument in arguments]
    return function


clock_nanosleep = external("clock_nanosleep", "int32", "int32", "int32", "uintp", "uintp")
clock_gettime = external("clock_gettime", "int32", "int32", "uintp")
send = external("send", "intp", "int32", "uintp", "uintp", "int32")
sendmmsg = external("sendmmsg", "int32", "int32", "uintp", "int32", "int32")
recv = external("recv", "intp", "int32", "uintp", "uintp", "int32")
ppoll = external("ppoll", "int32", "uintp", "uintp", "uintp", "uintp")
accept4 = external("accept4", "int32", "int32", "uintp", "uintp", "int32")
close = external("close", "int32", "int32")
_errno_location = external("__errno_location", "uintp")

CLOCK_MONOTONIC = 1
CLOCK_BOOTTIME = 7
TIMER_ABSTIME = 1
MSG_DONTWAIT = 0x40
MSG_NOSIGNAL = 0x4000
POLLIN = 0x001
POLLERR_POLLHUP = 0x018
SOCK_NONBLOCK_CLOEXEC = 0o4000 | 0o2000000
EAGAIN = errno_codes.EAGAIN
EINTR = errno_codes.EINTR
ENOBUFS = errno_codes.ENOBUFS
NANOSECONDS = 1_000_000_000
WAIT_SCRATCH_WORDS = 3  # of `wait_readable_ns`, and of `wait_watched_ns` for one descriptor


if JIT_DISABLED:

    def _load_int32(address: int) -> int:
        return ctypes.c_int32.from_address(address).value

    def load_acquire(words: np.ndarray, index: int) -> int:
        """Read a shared int64 word."""
        return int(words[index])

    def store_release(words: np.ndarray, index: int, value: int) -> None:
        """Write a shared int64 word."""
        words[index] = value

else:

    def _intrinsic(name: str) -> Any:
        return OnlyInKernels(lambda compiler: compiler.type_of_intrinsic(getattr(compiler, name)))

    _load_int32, load_acquire, store_release = map(_intrinsic, ("load_int32", "load_acquire", "store_release"))


@kernel
def errno() -> int:
    """The C errno of the calling thread."""
    return _load_int32(_errno_location())


@kernel
def monotonic_ns(timespec: np.ndarray) -> int:
    """CLOCK_MONOTONIC [ns]; `timespec` is an int64[2] scratch array owned by the caller (no allocation)."""
    clock_gettime(np.int32(CLOCK_MONOTONIC), np.uintp(timespec.ctypes.data))
    return timespec[0] * NANOSECONDS + timespec[1]


@kernel
def boottime_ns(timespec: np.ndarray) -> int:
    """CLOCK_BOOTTIME [ns]: as CLOCK_MONOTONIC, but it goes on while the computer is suspended."""
    clock_gettime(np.int32(CLOCK_BOOTTIME), np.uintp(timespec.ctypes.data))
    return timespec[0] * NANOSECONDS + timespec[1]


@kernel
def sleep_until_ns(deadline_ns: int, timespec: np.ndarray) -> None:
    """Sleep until the absolute CLOCK_MONOTONIC time; sleeps on after a signal; `timespec` int64[2] is scratch."""
    timespec[0] = deadline_ns // NANOSECONDS
    timespec[1] = deadline_ns % NANOSECONDS
    address = np.uintp(timespec.ctypes.data)
    while clock_nanosleep(np.int32(CLOCK_MONOTONIC), np.int32(TIMER_ABSTIME), address, np.uintp(0)) == EINTR:
        pass


@kernel
def wait_readable_ns(fd: int, timeout_ns: int, scratch: np.ndarray) -> bool:
    """Sleep until something can be read from `fd`, or `timeout_ns` is over; True if a read has something to say.

    True also when the other end has gone: the next read then tells the error, and so does `poll_events`.  A negative
    time-out is taken as 0.  A signal ends the wait early with False, so a caller that must wait the whole time
    compares its own clock.  `scratch` is int64[WAIT_SCRATCH_WORDS] owned by the caller: `struct pollfd`, packed as on
    little-endian machines, and `struct timespec`.
    """
    watch(fd, 0, scratch)
    return wait_watched_ns(1, timeout_ns, scratch)


@kernel
def watch(fd: int, number: int, scratch: np.ndarray) -> None:
    """`fd` is one of those that `wait_watched_ns` waits for, `number` counts them from 0."""
    scratch[number] = (POLLIN << 32) | np.int64(fd)


@kernel
def wait_watched_ns(count: int, timeout_ns: int, scratch: np.ndarray) -> bool:
    """`wait_readable_ns` for the first `count` descriptors that are watched; `scratch` has two words more."""
    limited_ns = max(timeout_ns, 0)
    scratch[count] = limited_ns // NANOSECONDS
    scratch[count + 1] = limited_ns % NANOSECONDS
    address = scratch.ctypes.data
    timeout = np.uintp(address + 8 * count)
    return bool(ppoll(np.uintp(address), np.uintp(count), timeout, np.uintp(0)) > 0)


@kernel
def poll_events(scratch: np.ndarray) -> int:
    """What the last `wait_readable_ns` with this scratch has seen (`revents` of poll(2))."""
    return int(scratch[0] >> 48)

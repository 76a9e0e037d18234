"""The one way to compile a function, and the few things a compiled function needs from the C library.

Everything that runs between enabling and stopping a joint is compiled with `kernel`, so that one place
decides the options:

* ``nogil``: the loop must not wait for other Python threads;
* ``error_model="numpy"``: a division by zero gives inf, which the finite check catches; an exception would
  unwind the loop with torque applied;
* no reference counting: a kernel that would allocate does not compile, and no atomic count is touched in the loop
  (docs/adr/0005).  Arrays belong to the caller, who keeps them for as long as the call lasts;
* no ``fastmath``: it lets the compiler assume that NaN does not exist, and then `isfinite` is always true;
* ``cache``: on disk, in a folder named after a hash of *all* our sources.  Numba looks only at the file of the
  function itself, so that an edited callee in another file would run stale.

With ``NUMBA_DISABLE_JIT=1`` the same functions run as plain Python (coverage and debugging).
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import os
import platform
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from jointctl.firmware_py import machine_code
from jointctl.firmware_py.slow_start import compiling

if TYPE_CHECKING:
    from types import ModuleType

# In `tools` only these sources may hold kernels (a test sees to it), so that editing a verb does not recompile.
TOOLS_WITH_KERNELS = ("identification/**/*.py", "wake_up.py")
_KERNEL_SOURCES = (
    *(f"{layer}/**/*.py" for layer in ("firmware_py", "drivers", "hil")),
    *(f"tools/{pattern}" for pattern in TOOLS_WITH_KERNELS),
)
_KEPT_CACHES = 4
LONGEST_WAIT_s, _LOOK_s = 120.0, 0.05  # for another process that compiles the same, and how often is looked


def source_hash(root: Path | None = None) -> str:
    """Hash (16 hex digits) of every source that can hold a kernel or a constant of one, and of interpreter and CPU."""
    root = root or Path(__file__).resolve().parent.parent
    digest = hashlib.sha256(f"{sys.version}{platform.machine()}".encode())
    for pattern in _KERNEL_SOURCES:
        for path in sorted(root.glob(pattern)):
            digest.update(str(path.relative_to(root)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_base() -> Path:
    configured = os.environ.get("JOINTCTL_CACHE_DIR")
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jointctl"


def _prune(base: Path, keep: Path) -> None:
    """Remove the caches of older sources, but none used in the last hour: another process may run from it."""
    folders = sorted((p for p in base.glob("numba-*") if p != keep), key=lambda p: p.stat().st_mtime, reverse=True)
    for old in folders[_KEPT_CACHES - 1 :]:
        if time.time() - old.stat().st_mtime > 3600.0:
            shutil.rmtree(old, ignore_errors=True)


def prepare_cache() -> Path | None:
    """Point numba at the folder for the present sources; None (and no cache) where no folder can be written."""
    base = _cache_base()
    folder = base / f"numba-{source_hash()}"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        os.utime(folder)
        _prune(base, folder)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):  # numba would refuse to compile at all
        return None
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    return folder


cache_folder = prepare_cache()
JIT_DISABLED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")

Function = TypeVar("Function", bound=Callable[..., Any])


class _Here(threading.local):
    """Of each thread."""

    interprets = False  # within what `plain` has made


_here = _Here()
_lock = threading.RLock()
_shared: list[Callable[..., Any]] = []
_compiler_module: ModuleType | None = None


def _compiler() -> Any:
    """Numba, which takes half a second to load."""
    global _compiler_module
    if _compiler_module is None:
        from jointctl.firmware_py import compiler

        _compiler_module = compiler
        for function in _shared:
            compiler.share(function)
    return _compiler_module


@functools.cache
def _options() -> str:
    return machine_code.options()


@contextlib.contextmanager
def _one_process(lock: Path) -> Iterator[None]:
    """Others wait for who compiles already, but not for ever: it may have been halted."""
    file = None
    try:
        from fcntl import LOCK_EX, LOCK_NB, LOCK_UN, flock  # not every system has it

        file = os.open(lock, os.O_CREAT | os.O_WRONLY, 0o600)
        for _ in range(round(LONGEST_WAIT_s / _LOOK_s)):
            try:
                flock(file, LOCK_EX | LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(_LOOK_s)
    except (ImportError, OSError):  # compiling twice does no harm
        pass
    try:
        yield
    finally:
        if file is not None:
            with contextlib.suppress(OSError):
                lock.unlink(missing_ok=True)
                flock(file, LOCK_UN)  # also for a child that was forked in between
            os.close(file)


class Kernel:
    """A function that is compiled when Python calls it, unless the cache has its machine code.

    Other kernels see numba's own dispatcher for it.
    """

    def __init__(self, function: Callable[..., Any], *, forceinline: bool = False) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._forceinline = forceinline
        self._arguments, self._defaults = function.__code__.co_argcount, function.__defaults__ or ()
        self._dispatchers: dict[bool, Any] = {}
        self._entries: dict[tuple[Any, ...], machine_code.Entry] = {}

    __name__: str
    __qualname__: str

    def __reduce__(self) -> str:
        return self.__qualname__

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if _here.interprets:
            return self.py_func(*arguments, **named)
        left = self._arguments - len(arguments)
        if named or not 0 <= left <= len(self._defaults):
            bound = inspect.signature(self.py_func).bind(*arguments, **named)
            bound.apply_defaults()
            arguments = bound.args
        elif left:
            arguments += self._defaults[-left:]
        numbers: list[Any] = []
        form: list[Any] = []
        for each in arguments:
            machine_code.flatten(each, numbers, form)
        entry = self._entries.get(tuple(form)) or self._entry(tuple(form), arguments)
        return entry(numbers)

    def bound(self, *arguments: Any) -> Callable[[], Any]:
        """A call with these arguments, taken over once."""
        numbers: list[Any] = []
        form: list[Any] = []
        for each in arguments:
            machine_code.flatten(each, numbers, form)
        return self._entry(tuple(form), arguments).bound(numbers)

    def _entry(self, form: tuple[Any, ...], arguments: tuple[Any, ...]) -> machine_code.Entry:
        with _lock:
            if form not in self._entries:
                code, path = None, self._cache_path(arguments)
                if path is not None:
                    code = machine_code.read(path)
                if code is None:
                    with compiling():
                        code = self._compiled(arguments, path)
                address = machine_code.link(code, lambda: _compiler().load_helpers())
                self._entries[form] = machine_code.Entry(self.__qualname__, code, address)
            return self._entries[form]

    def _compiled(self, arguments: tuple[Any, ...], path: Path | None) -> machine_code.MachineCode:
        if path is None:
            return cast(machine_code.MachineCode, _compiler().compiled(self, arguments))
        with _one_process(path.with_suffix(".lock")):
            code = machine_code.read(path)  # of who was first
            if code is None:
                code = _compiler().compiled(self, arguments)
                with contextlib.suppress(OSError):  # a disk that takes no more costs the next start some time
                    machine_code.write(path, code)
            return code

    def _cache_path(self, arguments: tuple[Any, ...]) -> Path | None:
        if cache_folder is None or self.py_func.__closure__:
            return None
        words = "\n".join((_options(), self.entry_name, *map(machine_code.form_name, arguments)))
        return cache_folder / f"{self.__name__}-{hashlib.sha256(words.encode()).hexdigest()[:24]}.entry"

    @functools.cached_property
    def entry_name(self) -> str:
        """The same in all processes; of a kernel that is not in our sources, another one when its file is changed."""
        function = self.py_func
        name = f"{function.__module__}.{function.__qualname__}"
        if function.__module__.startswith(_OURS):
            return name
        with contextlib.suppress(OSError):
            stat = os.stat(function.__code__.co_filename)
            return f"{name}@{function.__code__.co_firstlineno}-{stat.st_mtime_ns}-{stat.st_size}"
        return f"{name}@{os.getpid()}-{id(function)}"

    def dispatcher_for(self, with_kernels: bool = False) -> Any:
        """Numba's; `with_kernels`: to be called with kernels, under whose types nothing can be kept in its cache."""
        with _lock:
            if with_kernels not in self._dispatchers:
                keep = cache_folder is not None and not with_kernels
                made = _compiler().dispatcher_of(self.py_func, cache=keep, forceinline=self._forceinline)
                self._dispatchers[with_kernels] = made
            return self._dispatchers[with_kernels]

    @property
    def loaded(self) -> int:
        """For how many forms of arguments it was loaded or compiled, for Python."""
        return len(self._entries)

    @property
    def _numba_type_(self) -> Any:
        return _compiler().type_of_kernel(self.dispatcher_for())


_OURS = ("jointctl.firmware_py.", "jointctl.drivers.", "jointctl.hil.", "jointctl.tools.")


def kernel(function: Function) -> Function:
    """Compile `function` for the control loop (nogil, cached, no allocation, no exceptions from arithmetic)."""
    return function if JIT_DISABLED else cast(Function, Kernel(function))


def inlined(function: Function) -> Function:
    """Compile a function whose machine code is copied into its callers: what it returns stays in registers."""
    return function if JIT_DISABLED else cast(Function, Kernel(function, forceinline=True))


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """A call of a kernel with these arguments, all of them, for many times: they are taken over from Python once.

    The caller keeps the arrays, whose contents may change between two calls.
    """
    return function.bound(*arguments) if isinstance(function, Kernel) else functools.partial(function, *arguments)


def plain(function: Function) -> Function:
    """A kernel, and all that it calls, as plain Python: for a few calls outside the loop, without the compiler."""
    if not isinstance(function, Kernel):
        return function

    @functools.wraps(function.py_func)
    def interpreted(*arguments: Any, **named: Any) -> Any:
        before, _here.interprets = _here.interprets, True
        try:
            return function.py_func(*arguments, **named)
        finally:
            _here.interprets = before

    return cast(Function, interpreted)


def shared(function: Function) -> Function:
    """Compile `function` into its compiled callers, and leave it plain Python for callers in Python.

    For what takes functions as arguments: kernels from the one, Python functions from the other.
    """
    if not JIT_DISABLED:
        _shared.append(function)
        if _compiler_module is not None:
            _compiler_module.share(function)
    return function


class Exchanging(Kernel):
    """A kernel that is handed to kernels, and runs as plain Python where Python calls it."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.py_func(*arguments, **named)


def exported(function: Function) -> Function:
    """Compile a function that other kernels are given as an argument.

    This is how the loop (which may not import a driver) calls the driver it was given.
    """
    return function if JIT_DISABLED else cast(Function, Exchanging(function))


class OnlyInKernels:
    """Something of numba's that kernels use by a global name, and Python does not: made when one is compiled."""

    def __init__(self, make: Callable[[Any], Any]) -> None:
        self._make = make

    @functools.cached_property
    def _numba_type_(self) -> Any:
        return self._make(_compiler())

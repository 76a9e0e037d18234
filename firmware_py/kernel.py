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
import hashlib
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

if TYPE_CHECKING:
    import numpy as np
    from numba.core.typing.templates import Signature

# In `tools` only these sources may hold kernels (a test sees to it), so that editing a verb does not recompile.
TOOLS_WITH_KERNELS = ("identification/**/*.py", "wake_up.py")
_KERNEL_SOURCES = (
    *(f"{layer}/**/*.py" for layer in ("firmware_py", "drivers", "hil")),
    *(f"tools/{pattern}" for pattern in TOOLS_WITH_KERNELS),
)
_KEPT_CACHES = 4


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

import llvmlite.binding as llvm  # noqa: E402
import numba  # noqa: E402  (NUMBA_CACHE_DIR is read while numba is imported)
from numba.core import caching, codegen, event, types  # noqa: E402
from numba.core.registry import CPUDispatcher  # noqa: E402
from numba.extending import register_jitable  # noqa: E402

_numba_config: Any = numba.config
if cache_folder is not None:
    _numba_config.CACHE_DIR = str(cache_folder)

JIT_DISABLED = bool(_numba_config.DISABLE_JIT)


_cache_file: Any = caching.IndexDataCacheFile
_save_compiled = _cache_file.save


def _save_where_there_is_room(file: caching.IndexDataCacheFile, key: object, data: object) -> None:
    """A disk that takes no more costs the next start some time, not this run."""
    with contextlib.suppress(OSError):
        _save_compiled(file, key, data)


_cache_file.save = _save_where_there_is_room
_load_index = _cache_file._load_index


def _index_that_can_be_read(file: Path) -> Any:
    """An index that is damaged, or names what this program cannot import, costs compiling, not the run."""
    try:
        return _load_index(file)
    except Exception:
        return {}


_cache_file._load_index = _index_that_can_be_read


def _no_blas() -> None:
    raise ImportError("kernels have no linear algebra")


# Numba looks for BLAS when the first function is loaded, that is it imports scipy.linalg: 0.2 s of every start.
with contextlib.suppress(ImportError):
    import numba.np.linalg as _numba_linalg

    _numba_linalg.ensure_blas = _no_blas


# Numba optimises every function together with all that it calls, and makes machine code of it: of a function ten calls
# deep ten times.  The machine code is only needed where Python or C calls: what has no wrapper for them is kept as it
# was lowered, and optimised with each function that has one.  Compiling takes half the time.
_plain_library: Any = codegen.JITCodeLibrary
_WRAPPERS = ("_ZN7cpython", "_ZN5cfunc")  # how numba's names of what Python and C call begin
_ADDRESSES = "numba.dynamic.globals"


class _Library(_plain_library):  # type: ignore[misc]
    """What numba makes of one function; `_late` while it has no machine code, which comes when an address is asked."""

    _late = False

    def finalize(self) -> None:
        self._late = not any(function.name.startswith(_WRAPPERS) for function in self._final_module.functions)
        super().finalize()

    def _optimize_final_module(self) -> None:
        # an address of this process keeps a function out of the cache: optimising tells whether it is used
        if any(variable.name.startswith(_ADDRESSES) for variable in self._final_module.global_variables):
            self._late = False
        if not self._late:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        if not self._late:
            super()._finalize_final_module()
            return
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        if self._late and any(function.name == name for function in self.get_defined_functions()):
            self._late = False
            self._optimize_final_module()
            self._finalize_final_module()
        return int(super().get_pointer_to_function(name))

    def serialize_using_object_code(self) -> tuple[str, str, object]:
        if self._late:
            return (self.name, "late", self._final_module.as_bitcode())
        serialized: tuple[str, str, object] = super().serialize_using_object_code()
        return serialized

    @classmethod
    def _unserialize(cls, owner: Any, state: tuple[str, str, Any]) -> Any:
        name, kind, data = state
        if kind != "late":
            return super()._unserialize(owner, state)
        library = owner.create_library(name)
        library._final_module = llvm.parse_bitcode(data)
        library._late = True
        library._finalize_final_module()
        return library


_jit: Any = codegen.JITCPUCodegen
_jit._library_class = _Library
_set_env = _jit.set_env


def _set_env_of_machine_code(owner: Any, name: str, env: object) -> None:
    """Only machine code has a place for numba's environment of a function, which no kernel uses."""
    if owner._engine.is_symbol_defined(name):
        _set_env(owner, name, env)


_jit.set_env = _set_env_of_machine_code


# The name of a record's type, with all its fields, is worked out some fifty thousand times: 7 % of compiling.
_record_type: Any = types.Record
_name_of_record = _record_type.__repr__


def _name_that_is_kept(record: Any) -> str:
    names: dict[str, str] = vars(record)
    if "_name_kept" not in names:
        names["_name_kept"] = _name_of_record(record)
    return names["_name_kept"]


_record_type.__repr__ = _name_that_is_kept

_NO_COUNTS: dict[str, Any] = {"_nrt": False, "cache": cache_folder is not None}
_MACHINE: dict[str, Any] = {"_nrt": False, "nogil": True, "error_model": "numpy"}
_OPTIONS: dict[str, Any] = {**_NO_COUNTS, **_MACHINE}

Function = TypeVar("Function", bound=Callable[..., Any])


# A kernel that kernels call needs none of the code that takes arguments over from Python: a quarter of the time that
# compiling takes.  So each has a twin without it, which is all that other kernels see.
_ONLY_CALLED_BY_KERNELS = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class _InnerCache(caching.FunctionCache):
    """Beside the kernel's own entries in the same files."""

    def _index_key(self, sig: object, codegen: object) -> tuple[object, ...]:
        base: Any = super()
        return (*base._index_key(sig, codegen), "inner")


class _Kernel(CPUDispatcher):
    """As numba makes it; `inner` is its twin."""

    inner: Any

    @property
    def _numba_type_(self) -> Any:
        return types.Dispatcher(self.inner)


def _compiled(function: Callable[..., Any], **more: bool) -> Any:
    compiler: Any = numba.njit
    made = compiler(**_OPTIONS, **more)(function)
    if JIT_DISABLED:
        return made
    made.__class__ = _Kernel
    made.inner = compiler(**_OPTIONS, **more, **_ONLY_CALLED_BY_KERNELS)(function)
    if cache_folder is not None:
        cache: Any = _InnerCache
        made.inner._cache = cache(function)
    return made


def kernel(function: Function) -> Function:
    """Compile `function` for the control loop (nogil, cached, no allocation, no exceptions from arithmetic)."""
    return cast(Function, _compiled(function))


@contextlib.contextmanager
def on_compiling(tell: Callable[[], object]) -> Iterator[None]:
    """`tell` is called when a kernel is compiled inside, for each; not for those that come from the cache."""

    class Listener(event.Listener):
        def on_start(self, event: object) -> None:
            tell()

        def on_end(self, event: object) -> None:
            """Of no interest."""

    with event.install_listener("numba:compile", Listener()):
        yield


def plain(function: Function) -> Function:
    """The Python function of a kernel: for a few calls outside the loop: loading the compiled one takes longer."""
    return cast(Function, getattr(function, "py_func", function))


def inlined(function: Function) -> Function:
    """Compile a function whose machine code is copied into its callers: what it returns stays in registers."""
    return cast(Function, _compiled(function, forceinline=True))


def shared(function: Function) -> Function:
    """Compile `function` into its compiled callers, and leave it plain Python for callers in Python.

    For what takes functions as arguments: C functions or kernels from the one, Python functions from the other.
    """
    return register_jitable(**_MACHINE, forceinline=True)(function)


def exported(signature: Signature) -> Callable[[Function], Any]:
    """Compile to a C function of a fixed signature, which a kernel may take as an argument and still be cached.

    This is how the loop (which may not import a driver) calls the driver it was given.
    """

    def wrap(function: Function) -> Any:
        if JIT_DISABLED:
            return function
        compile_c: Any = numba.cfunc
        return compile_c(signature, nopython=True, **_NO_COUNTS)(function)

    return wrap


def record_array_type(dtype: np.dtype) -> Any:
    """The numba type of a one-dimensional array of records, for `exported` signatures."""
    return types.Array(numba.from_dtype(dtype), 1, "C")


def memory_type(cls: type, *members: Any) -> Any:
    """The numba type of a NamedTuple of one-dimensional arrays with these dtypes, for `exported` signatures."""
    named_tuple: Any = types.NamedTuple
    return named_tuple([types.Array(numba.from_dtype(one), 1, "C") for one in members], cls)

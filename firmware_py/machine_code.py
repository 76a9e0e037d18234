"""Machine code of kernels in the cache, and calls of it from Python: without the compiler, whose import takes longer.

A kernel that Python calls has an entry for each form of its arguments: a C function of one array of 8-byte slots, first
those for what it returns, then the arguments, flat: numbers as they are, an array as its address, its shape and, unless
it is contiguous, its strides; a tuple as its members; None and kernels as nothing at all.
"""

from __future__ import annotations

import ctypes
import enum
import functools
import hashlib
import importlib
import importlib.util
import os
import pickle
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SLOT_BYTES = 8
_DIGEST_BYTES = 32

# --- The form of arguments, and their numbers ---
_ARRAY_DATA = object.__basicsize__  # where objects of numpy have the address of their data
_RECORD_DATA = object.__basicsize__ + 8


def _is_there() -> bool:
    array = np.zeros(2, [("a", "<i8"), ("b", "<i8")])
    record = array[1]
    at = [
        ctypes.c_size_t.from_address(id(array) + _ARRAY_DATA),
        ctypes.c_size_t.from_address(id(record) + _RECORD_DATA),
    ]
    return [one.value for one in at] == [array.ctypes.data, array.ctypes.data + 16]


if _is_there():  # a tenth of the time that numpy takes to say it

    def _data_of(array: np.ndarray) -> int:
        return ctypes.c_size_t.from_address(id(array) + _ARRAY_DATA).value

    def _record_data_of(record: np.void) -> int:
        return ctypes.c_size_t.from_address(id(record) + _RECORD_DATA).value

else:

    def _data_of(array: np.ndarray) -> int:
        return int(array.ctypes.data)

    def _record_data_of(record: np.void) -> int:
        return int(np.asarray(record).ctypes.data)


class Layouts:
    """A number for each data type of numpy: to compare two large records takes longer than to call a kernel."""

    def __init__(self) -> None:
        self._by_id: dict[int, tuple[int, np.dtype[Any]]] = {}  # which keeps them, so that no other gets their id
        self._numbers: dict[np.dtype[Any], int] = {}

    def number_of(self, dtype: np.dtype[Any]) -> int:
        known = self._by_id.get(id(dtype))
        if known is None:
            if len(self._by_id) > 10_000:
                self._by_id.clear()
            known = self._numbers.setdefault(dtype, len(self._numbers)), dtype
            self._by_id[id(dtype)] = known
        return known[0]


_number_of = Layouts().number_of


class NoForm(TypeError):
    """An argument that machine code cannot be given."""


def flatten(value: Any, numbers: list[Any], form: list[Any]) -> None:
    """Append its numbers, and what tells one form from another within this process."""
    kind = type(value)
    if kind is float or kind is int or kind is bool:
        numbers.append(value)
        form.append(kind)
    elif isinstance(value, np.ndarray):
        flags = value.flags
        layout = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
        numbers.append(_data_of(value))
        numbers.extend(value.shape)
        if layout == "A":
            numbers.extend(value.strides)
        form.append((_number_of(value.dtype), value.ndim, layout, flags.writeable))
    elif isinstance(value, np.void):
        numbers.append(_record_data_of(value))
        form.append((_number_of(value.dtype),))
    elif isinstance(value, tuple):
        form.append((kind, len(value)))
        for each in value:
            flatten(each, numbers, form)
    elif value is None or hasattr(value, "entry_name"):
        form.append(value)
    elif isinstance(value, enum.Enum):
        flatten(value.value, numbers, form)
    elif isinstance(value, np.generic):
        numbers.append(value.item())
        form.append(kind)
    else:
        raise NoForm(f"{kind.__name__} (={value!r})")


def _layout_name(dtype: np.dtype[Any]) -> str:
    return hashlib.sha256(repr(dtype.descr if dtype.names is None else _fields(dtype)).encode()).hexdigest()[:16]


def _fields(dtype: np.dtype[Any]) -> list[Any]:
    """All names, types and places, inner ones too."""
    fields: Any = dtype.fields
    rows: list[Any] = [dtype.itemsize, dtype.isalignedstruct]
    for name in dtype.names or ():
        inner, offset = fields[name][:2]
        rows.append((name, offset, inner.shape, _fields(inner.base) if inner.base.names else inner.base.str))
    return rows


def form_name(value: Any) -> str:
    """The same for all processes, of one argument."""
    if isinstance(value, np.ndarray):
        flags = value.flags
        layout = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
        return f"{_layout_name(value.dtype)}[{value.ndim}{layout}{'' if flags.writeable else 'r'}]"
    if isinstance(value, np.void):
        return f"record {_layout_name(value.dtype)}"
    if isinstance(value, tuple):
        kind = type(value)
        return f"{kind.__module__}.{kind.__qualname__}({', '.join(map(form_name, value))})"
    if isinstance(value, enum.Enum):
        return form_name(value.value)
    return str(getattr(value, "entry_name", "None" if value is None else type(value).__name__))


# --- Entries ---
@dataclass(frozen=True)
class Result:
    """What a kernel returns: `code` "" nothing, "(" a tuple of `members`, else that of a number for `struct`."""

    code: str
    members: tuple[Result, ...] = ()
    named: tuple[str, str] | None = None  # module and name of a named tuple, or of an enum

    @property
    def codes(self) -> str:
        """Of all slots."""
        return "".join(member.codes for member in self.members) if self.code == "(" else self.code

    def made(self, values: list[Any]) -> Any:
        """From the values of the slots, which are taken away from the front."""
        if self.code != "(":
            value = values.pop(0) if self.code else None
            return value if self.named is None else self._named(value)
        members = [member.made(values) for member in self.members]
        return tuple(members) if self.named is None else self._named(*members)

    def _named(self, *values: Any) -> Any:
        assert self.named is not None
        module, name = self.named
        cls: Any = importlib.import_module(module)
        for part in name.split("."):
            cls = getattr(cls, part)
        return cls(*values)


@dataclass(frozen=True)
class MachineCode:
    """An object file with one function `symbol`."""

    symbol: str
    argument_codes: str  # of `struct`, one a slot
    result: Result
    object_code: bytes
    alone: bool  # everything that it calls is there without the compiler


_FORMATS = {"?": "?7x"}  # a truth fills its slot with 0 or 1


class Entry:
    """A function that can be called with the numbers that `flatten` gives."""

    def __init__(self, name: str, code: MachineCode, address: int) -> None:
        self._name, self._result = name, code.result
        codes = code.result.codes
        self._size = len(codes)
        self._pack = struct.Struct("<" + "".join(_FORMATS.get(one, one) for one in code.argument_codes)).pack_into
        self._unpack = struct.Struct("<" + "".join(_FORMATS.get(one, one) for one in codes)).unpack_from
        self._slots: Any = ctypes.c_int64 * max(1, self._size + len(code.argument_codes))
        self._offset = SLOT_BYTES * self._size
        self._single = code.result.code not in ("", "(") and code.result.named is None
        self._call = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)(address)  # without the interpreter's lock

    def __call__(self, numbers: Sequence[Any]) -> Any:
        return self.bound(numbers)()

    def bound(self, numbers: Sequence[Any]) -> Callable[[], Any]:
        """A call with these numbers: what they are the addresses of must outlive it."""
        slots = self._slots()
        self._pack(slots, self._offset, *numbers)
        return functools.partial(self._carry_out, slots, ctypes.addressof(slots))

    def _carry_out(self, slots: Any, address: int) -> Any:
        if self._call(address) != 0:
            raise RuntimeError(f"{self._name} ended with an exception")
        if not self._size:
            return self._result.made([])
        values = self._unpack(slots)
        return values[0] if self._single else self._result.made(list(values))


# --- The cache ---
def _compiler_version() -> str:
    """Of numba and llvmlite, without importing them."""
    found = []
    for name in ("numba", "llvmlite"):
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        found.append(Path(spec.origin).with_name("_version.py").read_text())
    return "".join(found)


_OF_NO_INFLUENCE = ("NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "NUMBA_NRT_STATS")


def options() -> str:
    """What decides, beside the sources, which machine code the compiler makes."""
    import llvmlite.binding as llvm

    variables = sorted(
        f"{key}={value}"
        for key, value in os.environ.items()
        if key.startswith("NUMBA_") and key not in _OF_NO_INFLUENCE
    )
    words = [_compiler_version(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), *variables]
    return hashlib.sha256("\n".join(words).encode()).hexdigest()


def read(path: Path) -> MachineCode | None:
    """None where there is none, or not as it was written."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    digest, content = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        return None
    code = pickle.loads(content)
    return code if isinstance(code, MachineCode) else None


def write(path: Path, code: MachineCode) -> None:
    """Whole or not at all; `OSError` where there is no room."""
    content = pickle.dumps(code)
    other = path.with_suffix(f".{os.getpid()}")
    try:
        other.write_bytes(hashlib.sha256(content).digest() + content)
        other.replace(path)
    finally:
        other.unlink(missing_ok=True)


# --- Linking ---
_engines: list[Any] = []  # own the machine code, for as long as the process lives


def link(code: MachineCode, load_compiler: Callable[[], object]) -> int:
    """Address of its function in this process."""
    import llvmlite.binding as llvm

    if not code.alone:
        load_compiler()  # the linker finds its helpers then
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.object_code))
    engine.finalize_object()
    _engines.append(engine)
    return int(engine.get_function_address(code.symbol))


_ELF64_LITTLE = b"\x7fELF\x02\x01"
_SYMBOL_TABLE = 2
_LINKERS_OWN = "_GLOBAL_OFFSET_TABLE_"


def unresolved(object_code: bytes) -> list[str] | None:
    """Names that an ELF object takes from elsewhere; None: another kind of object."""
    if object_code[:6] != _ELF64_LITTLE:
        return None
    (sections_at,) = struct.unpack_from("<Q", object_code, 0x28)
    size, count = struct.unpack_from("<HH", object_code, 0x3A)
    sections = [struct.unpack_from("<IIQQQQIIQQ", object_code, sections_at + size * k) for k in range(count)]
    names = []
    for section in sections:
        if section[1] != _SYMBOL_TABLE:
            continue
        text_at = sections[section[6]][4]
        for at in range(section[4], section[4] + section[5], 24):
            name, _, _, place = struct.unpack_from("<IBBH", object_code, at)
            if place == 0 and name:
                begin = text_at + name
                names.append(object_code[begin : object_code.index(b"\0", begin)].decode())
    return names


def stands_alone(object_code: bytes) -> bool:
    """Whether this process has all that it calls, without the compiler."""
    names = unresolved(object_code)
    try:
        process = ctypes.CDLL(None)
    except TypeError:  # Windows
        return False
    return names is not None and all(name == _LINKERS_OWN or hasattr(process, name) for name in names)

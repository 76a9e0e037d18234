"""Numba and what is ours of it: loaded where a kernel must be compiled, which the cache saves most programs.

What comes out is an entry (`firmware_py.machine_code`).
"""

from __future__ import annotations

import contextlib
import enum
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointctl.firmware_py.machine_code import MachineCode, Result, stands_alone

if TYPE_CHECKING:
    from numba.core.base import BaseContext
    from numba.core.types import Array, Integer
    from numba.core.typing.context import BaseContext as BaseTypingContext
    from numba.core.typing.templates import Signature

    from jointctl.firmware_py.kernel import Kernel


@contextlib.contextmanager
def _without(*modules: str) -> Iterator[None]:
    """Numba imports them where they are installed, for what no kernel needs: a tenth of a second."""
    hidden: dict[str, Any] = {name: None for name in modules if name not in sys.modules}
    sys.modules.update(hidden)
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


with _without("coverage", "yaml"):
    import numba
import llvmlite.binding as llvm  # noqa: E402
from llvmlite import ir  # noqa: E402
from numba.core import caching, codegen, event  # noqa: E402
from numba.core.compiler_lock import global_compiler_lock  # noqa: E402
from numba.core.typing import typeof  # noqa: E402
from numba.extending import intrinsic, register_jitable  # noqa: E402
from numba.np import arrayobj  # noqa: E402

types: Any = numba.core.types  # half of it is typed
_typeof: Any = typeof.typeof
_populate_array: Any = arrayobj.populate_array

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


@contextlib.contextmanager
def _no_timer(_kind: str, _callback: object) -> Iterator[None]:
    yield


# A function ten calls deep has ten timers of numba's, each of which sees every entry of the compiler: 5 % of compiling.
_events: Any = event
_events.install_timer = _no_timer


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
        if not self._late:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        if not self._late:
            super()._finalize_final_module()
            return
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def optimise(self) -> None:
        """What `finalize` has left."""
        if self._late:
            super()._optimize_final_module()

    def _to_machine_code(self) -> None:
        self._late = False
        self._optimize_final_module()
        self._finalize_final_module()

    @property
    def has_dynamic_globals(self) -> bool:
        """Asked before a function is kept, which an address of this process forbids; optimising tells if it is used."""
        if self._late and self._dynamic_globals:
            self._dynamic_globals.clear()
            self._to_machine_code()
        return len(self._dynamic_globals) > 0

    def holds_addresses(self) -> bool:
        """Whether what `optimise` has left is of use in this process only."""
        return any(variable.name.startswith(_ADDRESSES) for variable in self._final_module.global_variables)

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        if self._late and any(function.name == name for function in self.get_defined_functions()):
            self._to_machine_code()
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

MACHINE: dict[str, Any] = {"_nrt": False, "nogil": True, "error_model": "numpy"}
# What takes arguments over from Python or C is the entry, of which only a kernel has one that Python calls.
OPTIONS: dict[str, Any] = {**MACHINE, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def dispatcher_of(function: Callable[..., Any], *, cache: bool, forceinline: bool) -> Any:
    """Numba's own for a function; it compiles for the types that it is called with by kernels."""
    compiler: Any = numba.njit
    made: Any = compiler(**OPTIONS, cache=cache, **({"forceinline": True} if forceinline else {}))(function)
    template = made.get_call_template

    def template_for_any_value(args: Any, named: dict[str, Any]) -> Any:
        return template(tuple(map(_for_any_value, args)), {name: _for_any_value(kind) for name, kind in named.items()})

    # numba compiles a function anew for each literal and each size of integer that callers give it: a tenth of the time
    made.get_call_template = template_for_any_value
    return made


def _for_any_value(kind: Any) -> Any:
    general = types.unliteral(kind)
    return types.int64 if isinstance(general, types.Integer) and general.signed else general


def type_of_kernel(dispatcher: Any) -> Any:
    """What a kernel is for those that call it."""
    return types.Dispatcher(dispatcher)


def share(function: Callable[..., Any]) -> None:
    """Kernels may call it, and hand it kernels."""
    register_jitable(**MACHINE, forceinline=True)(function)


def type_of_external(name: str, result: str, arguments: tuple[str, ...]) -> Any:
    """A function of the C library; types by numba's names."""
    return types.ExternalFunction(name, getattr(types, result)(*(getattr(types, one) for one in arguments)))


def _type_of(value: object) -> Any:
    """As `typeof`, but an enum is its number."""
    if isinstance(value, tuple):
        return types.BaseTuple.from_types([_type_of(each) for each in value], type(value))
    return _typeof(getattr(value, "value", value) if isinstance(value, enum.Enum) else value)


def _result_of(kind: Any) -> Result:
    if isinstance(kind, types.NoneType):
        return Result("")
    if isinstance(kind, types.BaseTuple):
        of: Any = getattr(kind, "instance_class", tuple)
        named = None if of is tuple else (of.__module__, of.__qualname__)
        return Result("(", tuple(_result_of(each) for each in kind.types), named)
    if isinstance(kind, types.EnumMember):
        of = kind.instance_class
        return Result(_result_of(kind.dtype).code, named=(of.__module__, of.__qualname__))
    if isinstance(kind, types.Boolean):
        return Result("?")
    if isinstance(kind, types.Integer):
        return Result("q" if kind.signed else "Q")
    if isinstance(kind, types.Float):
        return Result("d")
    raise TypeError(f"a kernel that Python calls cannot return {kind}")


_SLOT = ir.IntType(64)


class _Slots:
    """Code that reads arguments from the slots and writes a result to them."""

    def __init__(self, context: Any, builder: Any, slots: Any) -> None:
        self._context, self._builder, self._slots = context, builder, slots
        self._next, self.codes = 0, ""

    def _place(self) -> Any:
        place = self._builder.gep(self._slots, [_SLOT(self._next)])
        self._next += 1
        return place

    def _take(self, code: str = "q") -> Any:
        self.codes += code
        return self._builder.load(self._place())

    def argument(self, kind: Any) -> Any:
        """The value of the next argument, as kernels hold it."""
        context, builder = self._context, self._builder
        if isinstance(kind, types.BaseTuple):
            return context.make_tuple(builder, kind, [self.argument(each) for each in kind.types])
        if isinstance(kind, types.Array):
            return self._array(kind)
        if isinstance(kind, types.Record):
            return builder.inttoptr(self._take(), context.get_value_type(kind))
        if isinstance(kind, types.Boolean):
            return builder.icmp_signed("!=", self._take("?"), _SLOT(0))
        if isinstance(kind, types.Integer):
            return self._narrow(self._take("q" if kind.signed else "Q"), context.get_value_type(kind))
        if isinstance(kind, types.Float):
            number = builder.bitcast(self._take("d"), ir.DoubleType())
            return number if kind.bitwidth == 64 else builder.fptrunc(number, context.get_value_type(kind))
        if isinstance(kind, (types.NoneType, types.Dispatcher)):
            return context.get_dummy_value()
        raise TypeError(f"a kernel that Python calls cannot take {kind}")

    def _narrow(self, value: Any, wanted: Any) -> Any:
        return value if wanted == _SLOT else self._builder.trunc(value, wanted)

    def _array(self, kind: Any) -> Any:
        context, builder = self._context, self._builder
        array = context.make_array(kind)(context, builder)
        data = builder.inttoptr(self._take(), array.data.type)
        item = context.get_abi_sizeof(context.get_data_type(kind.dtype))
        shape = [self._take() for _ in range(kind.ndim)]
        if kind.layout == "A":
            strides = [self._take() for _ in range(kind.ndim)]
        else:
            strides, step = [], _SLOT(item)
            for length in reversed(shape) if kind.layout == "C" else shape:
                strides.append(step)
                step = builder.mul(step, length)
            if kind.layout == "C":
                strides.reverse()
        _populate_array(array, data=data, shape=shape, strides=strides, itemsize=item, meminfo=None)
        return array._getvalue()

    def give(self, kind: Any, value: Any) -> None:
        """The next part of the result."""
        builder = self._builder
        if isinstance(kind, types.BaseTuple):
            for index, each in enumerate(kind.types):
                self.give(each, builder.extract_value(value, index))
        elif isinstance(kind, types.EnumMember):
            self.give(kind.dtype, value)
        elif isinstance(kind, types.Boolean):
            builder.store(builder.zext(value, _SLOT), self._place())
        elif isinstance(kind, types.Integer):
            if value.type != _SLOT:
                value = builder.sext(value, _SLOT) if kind.signed else builder.zext(value, _SLOT)
            builder.store(value, self._place())
        elif isinstance(kind, types.Float):
            if value.type != ir.DoubleType():
                value = builder.fpext(value, ir.DoubleType())
            builder.store(builder.bitcast(value, _SLOT), self._place())


def compiled(kernel: Kernel, arguments: tuple[Any, ...]) -> MachineCode:
    """The entry of a kernel for arguments like these."""
    with global_compiler_lock:
        kinds = tuple(_type_of(each) for each in arguments)
        dispatcher = kernel.dispatcher_for(any(isinstance(kind, _WITH_KERNELS) for kind in _flat(kinds)))
        dispatcher.compile(kinds)
        made = dispatcher.overloads[kinds]
        context, result = dispatcher.targetctx, made.fndesc.restype
        library = context.codegen().create_library(f"{_SYMBOL}.{kernel.__qualname__}")
        module = context.create_module(_SYMBOL)
        calling = context.call_conv
        callee = ir.Function(module, calling.get_function_type(result, kinds), made.fndesc.llvm_func_name)
        entry = ir.Function(module, ir.FunctionType(ir.IntType(32), [_SLOT.as_pointer()]), _SYMBOL)
        builder = ir.IRBuilder(entry.append_basic_block("entry"))
        description = _result_of(result)
        slots = _Slots(context, builder, entry.args[0])
        slots._next = len(description.codes)
        values = [slots.argument(kind) for kind in kinds]
        status, value = calling.call_function(builder, callee, result, kinds, values)
        slots._next = 0
        with builder.if_then(builder.not_(status.is_error)):
            slots.give(result, value)
        builder.ret(builder.zext(status.is_error, ir.IntType(32)))
        library.add_ir_module(module)
        library.add_linking_library(made.library)
        library.finalize()
        library.optimise()
        if library.holds_addresses():
            raise TypeError(f"{kernel.__qualname__} holds an address of this process, and no other could run it")
        code = library._codegen._tm.emit_object(library._final_module)
    return MachineCode(_SYMBOL, slots.codes, description, code, stands_alone(code))


def load_helpers() -> None:
    """What machine code that does not stand alone takes from numba."""
    from numba.core.registry import cpu_target

    cpu_target.target_context.codegen()


_SYMBOL = "jointctl_entry"
_WITH_KERNELS = types.Dispatcher


def _flat(kinds: Any) -> Iterator[Any]:
    for kind in kinds:
        if isinstance(kind, types.BaseTuple):
            yield from _flat(kind.types)
        else:
            yield kind


# --- Reading and writing of memory that numba has no word for (`firmware_py.libc`) ---


def type_of_intrinsic(intrinsic: object) -> Any:
    from numba.core.registry import cpu_target

    cpu_target.typing_context.refresh()  # it may have been made a moment ago
    return cpu_target.typing_context.resolve_value_type(intrinsic)


@intrinsic
def load_int32(typing_context: BaseTypingContext, address: Integer) -> Any:
    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.IntType(32).as_pointer())
        return builder.load(pointer)

    return types.int32(types.uintp), generate


@intrinsic
def load_acquire(typing_context: BaseTypingContext, words: Array, index: Integer) -> Any:
    """Read a shared int64 word so that nothing after it is moved before it (a plain read is hoisted)."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])  # type: ignore[no-untyped-call]
        pointer = builder.gep(array.data, [arguments[1]])
        return builder.load_atomic(pointer, "acquire", 8)

    return types.int64(words, types.int64), generate


@intrinsic
def store_release(typing_context: BaseTypingContext, words: Array, index: Integer, value: Integer) -> Any:
    """Write a shared int64 word so that nothing before it is moved after it."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])  # type: ignore[no-untyped-call]
        pointer = builder.gep(array.data, [arguments[1]])
        builder.store_atomic(arguments[2], pointer, "release", 8)

    return types.void(words, types.int64, types.int64), generate

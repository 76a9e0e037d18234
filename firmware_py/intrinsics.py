"""Reading and writing of memory that numba has no word for; imported when a kernel that uses it is compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numba.core.base import BaseContext
    from numba.core.typing.context import BaseContext as BaseTypingContext
    from numba.core.typing.templates import Signature


@intrinsic
def load_int32(typing_context: BaseTypingContext, address: types.Integer) -> Any:
    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.IntType(32).as_pointer())
        return builder.load(pointer)

    return types.int32(types.uintp), generate


@intrinsic
def load_acquire(typing_context: BaseTypingContext, words: types.Array, index: types.Integer) -> Any:
    """Read a shared int64 word so that nothing after it is moved before it (a plain read is hoisted)."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])  # type: ignore[no-untyped-call]
        pointer = builder.gep(array.data, [arguments[1]])
        return builder.load_atomic(pointer, "acquire", 8)

    return types.int64(words, types.int64), generate


@intrinsic
def store_release(
    typing_context: BaseTypingContext, words: types.Array, index: types.Integer, value: types.Integer
) -> Any:
    """Write a shared int64 word so that nothing before it is moved after it."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Sequence[ir.Value]
    ) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])  # type: ignore[no-untyped-call]
        pointer = builder.gep(array.data, [arguments[1]])
        builder.store_atomic(arguments[2], pointer, "release", 8)

    return types.void(words, types.int64, types.int64), generate

"""Records: a class declares the fields once, the numpy dtype is derived from it.

    @record
    class Sample:
        position_rad: f8
        weights: Vector15

mypy checks the field names wherever a kernel parameter is annotated with the class; numba and the log see the
aligned little-endian dtype.  Without padding at its end that is a valid CDR message body as well, which the run log
relies on.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeVar, get_type_hints

import numpy as np

f8 = Annotated[float, np.dtype("<f8")]
i8 = Annotated[int, np.dtype("<i8")]
i4 = Annotated[int, np.dtype("<i4")]
u4 = Annotated[int, np.dtype("<u4")]
i2 = Annotated[int, np.dtype("<i2")]
u2 = Annotated[int, np.dtype("<u2")]
i1 = Annotated[int, np.dtype("i1")]
u1 = Annotated[int, np.dtype("u1")]
INT32_MAX = 2_147_483_647  # what an i4 holds at most: saturate before writing to it

_DTYPES: dict[type, np.dtype[Any]] = {}
_HINTS: dict[type, dict[str, Any]] = {}
Class = TypeVar("Class", bound=type)
Mark = TypeVar("Mark")


def _field_dtype(hint: object) -> Any:
    if isinstance(hint, type) and hint in _DTYPES:
        return _DTYPES[hint]
    for item in getattr(hint, "__metadata__", ()):
        if isinstance(item, (np.dtype, tuple)):
            return item
    raise TypeError(f"{hint!r} is not a record field type: use f8, i4, ..., array_of(...) or another record")


def array_of(element: object, *shape: int) -> Any:
    """Field type of a fixed-size array inside a record: ``Annotated[np.ndarray, array_of(f8, 15)]``."""
    return (_field_dtype(element), shape)


def record(cls: Class) -> Class:
    """Class decorator: derive and remember the aligned dtype of the annotated fields."""
    hints = _HINTS[cls] = get_type_hints(cls, include_extras=True)
    fields = []
    for name, hint in hints.items():
        if hasattr(np.record, name) or hasattr(np.recarray, name):
            # plain Python would silently find numpy's attribute instead of the field
            raise TypeError(f"{cls.__name__}.{name}: numpy records have an attribute of that name, choose another")
        dtype = _field_dtype(hint)
        fields.append((name, *dtype) if isinstance(dtype, tuple) else (name, dtype))
    _DTYPES[cls] = np.dtype(fields, align=True)
    return cls


def dtype_of(cls: type) -> np.dtype[Any]:
    """The dtype of a record class."""
    return _DTYPES[cls]


def marks_of(cls: type, mark: type[Mark]) -> dict[str, Mark]:
    """Name -> what stands of that type in the annotation of a field, behind the field's own type."""
    return {
        name: item
        for name, hint in _HINTS[cls].items()
        for item in getattr(hint, "__metadata__", ())
        if isinstance(item, mark)
    }


def new(cls: type, count: int = 1) -> Any:
    """A zeroed record array of shape (count,); ``new(Sample)[0]`` is a mutable view of its first record."""
    return np.zeros(count, dtype_of(cls)).view(np.recarray)

"""Fields of records where kernels run as plain Python: as numpy gives them, in a fraction of the time.

`np.record` looks for a name among everything else before its fields, and makes a record of a part of a record by a view
whose safety it proves anew: most of the time of the tests that run the kernels without the compiler.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_NO_FIELDS = frozenset(dir(np.void))
_numpys_attribute, _numpys_store = np.record.__getattribute__, np.record.__setattr__
_of_void, _field, _store, _part = np.void.__getattribute__, np.void.__getitem__, np.void.__setitem__, np.void.getfield
# id of a type -> its parts that are records, with type and place; and the type, so that it stays that one's id
_parts: dict[int, tuple[dict[str, tuple[Any, int]], Any]] = {}


def _parts_of(dtype: Any) -> tuple[dict[str, tuple[Any, int]], Any]:
    places = [(name, *place[:2]) for name, place in dtype.fields.items()]
    parts = {name: (np.dtype((np.record, part)), at) for name, part, at in places if part.names is not None}
    return _parts.setdefault(id(dtype), (parts, dtype))


def attribute(record: np.record, name: str) -> Any:
    """`record.name`"""
    if name in _NO_FIELDS:
        return _of_void(record, name)
    dtype = _of_void(record, "dtype")
    part = (_parts.get(id(dtype)) or _parts_of(dtype))[0].get(name)
    if part is not None:
        return _part(record, *part)
    try:
        return _field(record, name)
    except (KeyError, ValueError):
        return _numpys_attribute(record, name)


def set_attribute(record: np.record, name: str, value: Any) -> None:
    """`record.name = value`"""
    if name in _NO_FIELDS:
        _numpys_store(record, name, value)
        return
    try:
        _store(record, name, value)
    except (KeyError, ValueError):
        _numpys_store(record, name, value)


def use() -> None:
    """For all records of this process."""
    np.record.__getattribute__ = attribute  # type: ignore[assignment]
    np.record.__setattr__ = set_attribute  # type: ignore[assignment]

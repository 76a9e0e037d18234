"""Fields of records where kernels run as plain Python: as numpy gives them, in a fraction of the time.

`np.record` looks for a name among everything else before its fields, and makes a record of a part of a record by a view
whose safety it proves anew; members of an enum are looked for by Python code before 3.12.  Each is a function that
coverage sees called: most of the time of the tests that run the kernels without the compiler.
"""

from __future__ import annotations

import enum
from typing import Any

import numpy as np

from jointctl.firmware_py import schema

numpys_attribute = np.record.__getattribute__


class _OfRecords(dict[type, np.dtype[Any]]):
    """The layout of each class, whose parts are records as they are read."""

    def __setitem__(self, cls: type, dtype: np.dtype[Any]) -> None:
        super().__setitem__(cls, np.dtype((np.record, dtype)))


def _member(cls: Any, name: str) -> Any:
    """Of an enum; from then on an attribute like any other."""
    if name.startswith("_"):  # numpy asks each member for __array_ufunc__
        raise AttributeError(name)
    member = cls._member_map_.get(name)
    if member is None:
        raise AttributeError(name)
    type.__setattr__(cls, name, member)
    return member


def use() -> None:
    """For all records of this process, before any is declared; a name that is no field is a `KeyError` then."""
    assert not schema._DTYPES
    schema._DTYPES = _OfRecords()
    record: Any = np.record
    record.__getattribute__, record.__getattr__ = np.void.__getattribute__, np.void.__getitem__
    record.__setattr__ = np.void.__setitem__
    of_enums: Any = enum.EnumType
    if "__getattr__" in vars(of_enums):
        of_enums.__getattr__ = _member

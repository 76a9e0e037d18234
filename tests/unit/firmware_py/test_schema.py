"""Records: declared once as a class, aligned like C, the same in kernels and in plain Python."""

from __future__ import annotations

import ctypes
from enum import IntEnum
from typing import Annotated

import numpy as np
import pytest

from jointctl.firmware_py import records
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.schema import array_of, dtype_of, f8, i1, i2, i4, i8, new, record, u1, u2, u4
from tests import plain_records


@record
class Inner:
    flag: u1
    value_rad: f8


@record
class Outer:
    small: u1
    wide: i8
    inner: Inner
    pairs: Annotated[np.ndarray, array_of(f8, 2, 3)]
    inners: Annotated[np.ndarray, array_of(Inner, 2)]
    last: i2


def test_layout_is_that_of_a_c_structure() -> None:
    class CInner(ctypes.Structure):
        _fields_ = (("flag", ctypes.c_uint8), ("value_rad", ctypes.c_double))

    class COuter(ctypes.Structure):
        _fields_ = (
            ("small", ctypes.c_uint8), ("wide", ctypes.c_int64), ("inner", CInner), ("pairs", ctypes.c_double * 6),
            ("inners", CInner * 2), ("last", ctypes.c_int16),
        )  # fmt: skip

    dtype = dtype_of(Outer)
    assert dtype.itemsize == ctypes.sizeof(COuter)
    assert dtype.fields is not None
    for name, *_ in COuter._fields_:
        assert dtype.fields[name][1] == getattr(COuter, name).offset
    assert dtype.isalignedstruct


def test_every_number_type() -> None:
    @record
    class Numbers:
        a: f8
        b: i8
        c: i4
        d: u4
        e: i2
        f: u2
        g: i1
        h: u1

    assert [Numbers and dtype_of(Numbers)[k].str for k in range(8)] == [
        "<f8", "<i8", "<i4", "<u4", "<i2", "<u2", "|i1", "|u1",
    ]  # fmt: skip


@kernel
def change(outer: Outer) -> float:
    outer.small = 7
    outer.inner.value_rad = 2.5
    outer.pairs[1, 2] = 3.5
    outer.inners[1].value_rad = 4.5
    return outer.inner.value_rad + outer.pairs[1, 2] + outer.inners[1].value_rad


def test_a_kernel_changes_the_record_that_it_was_given() -> None:
    array = new(Outer, 3)
    assert change(array[1]) == 10.5
    assert (array[1].small, array[1].inner.value_rad, array[1].pairs[1, 2]) == (7, 2.5, 3.5)
    assert array[1].inners[1].value_rad == 4.5
    assert bytes(array[0].tobytes()) == bytes(array[2].tobytes()) == bytes(dtype_of(Outer).itemsize)


def test_new_is_zero() -> None:
    assert not any(new(Outer)[0].tobytes())


@pytest.mark.parametrize("name", ["data", "size", "repeat", "shape", "copy", "field"])
def test_a_field_that_numpy_would_hide_is_refused(name: str) -> None:
    cls = type("Hidden", (), {"__annotations__": {name: f8}})
    with pytest.raises(TypeError, match=rf"Hidden\.{name}: numpy records have an attribute of that name"):
        record(cls)


@pytest.mark.parametrize("hint", [float, int, list, Annotated[float, "rad"]])
def test_a_type_without_a_layout_is_refused(hint: object) -> None:
    with pytest.raises(TypeError, match="is not a record field type"):
        record(type("Vague", (), {"__annotations__": {"value": hint}}))


OWN = [c for c in vars(records).values() if isinstance(c, type) and c.__module__ == records.__name__]


@pytest.mark.parametrize("cls", [c for c in OWN if not issubclass(c, IntEnum)])
def test_every_record_of_the_controller_is_aligned_and_little_endian(cls: type) -> None:
    dtype = dtype_of(cls)
    assert dtype.isalignedstruct
    assert dtype.newbyteorder("<") == dtype
    assert dtype.itemsize % dtype.alignment == 0


def test_a_log_record_has_no_holes_before_its_end() -> None:
    """It is written to the run log as a CDR body, where only alignment may leave gaps."""
    dtype = dtype_of(records.LogRecord)
    assert dtype.fields is not None
    at = 0
    for name in dtype.names or ():
        field, offset = dtype.fields[name][:2]
        assert offset == at
        at += field.itemsize
    assert dtype.itemsize - at < 8


@pytest.mark.parametrize("cls", [Outer, records.AxisState, records.AxisConstants], ids=lambda cls: cls.__name__)
def test_the_fields_of_plain_records_are_numpys(cls: type) -> None:
    """In plain Python, what `tests.plain_records` puts in their place: values, memory, parts of parts, and errors."""
    array = new(cls)
    array.view(np.uint8)[:] = np.arange(array.nbytes) % 64

    def compare(whole: np.record) -> None:
        for name in whole.dtype.names:
            own, numpys = getattr(whole, name), plain_records.numpys_attribute(whole, name)
            assert type(own) is type(numpys)
            np.testing.assert_array_equal(own, numpys)
            if isinstance(own, np.record):
                assert own.dtype == numpys.dtype
                compare(own)
            elif isinstance(own, np.ndarray):
                assert np.shares_memory(own, numpys)
            else:
                setattr(whole, name, 5)
                assert getattr(whole, name) == plain_records.numpys_attribute(whole, name) == 5

    compare(array[0])
    for access in (getattr, lambda whole, name: setattr(whole, name, 1)):
        with pytest.raises((AttributeError, KeyError, ValueError)):
            access(array[0], "not_there")
    assert array[0].dtype is plain_records.numpys_attribute(array[0], "dtype")

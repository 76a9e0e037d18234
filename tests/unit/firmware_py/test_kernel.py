"""The one decorator: options that matter for safety, the key of the cache, and the same results without the JIT."""

from __future__ import annotations

import errno
import json
import math
import os
import pickle
import shutil
import struct
import subprocess
import sys
import time
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core import caching
from numba.core.errors import NumbaError, NumbaWarning

from jointctl.firmware_py import compiler, machine_code
from jointctl.firmware_py import kernel as kernel_module
from jointctl.firmware_py.kernel import Kernel, kernel, plain, source_hash
from jointctl.firmware_py.machine_code import MachineCode, Result
from jointctl.firmware_py.schema import array_of, f8, i4, new, record
from tests.places import ROOT
from tests.python_process import run_python

PACKAGES = ("firmware_py", "drivers", "hil", "tools")


@kernel
def divide(a: float, b: float) -> float:
    return a / b


@kernel
def is_finite(a: float) -> bool:
    return math.isfinite(a)


@pytest.mark.parametrize(("value", "finite"), [(1e308, True), (math.nan, False), (math.inf, False), (-math.inf, False)])
def test_the_finite_check_is_not_optimised_away(value: float, finite: bool) -> None:
    assert is_finite(value) is finite


def test_a_division_by_zero_does_not_unwind_the_loop() -> None:
    assert divide(1.0, 0.0) == math.inf
    assert math.isnan(divide(0.0, 0.0))


@kernel
def _shifted(value: int, by: int, doubled: bool) -> int:
    return 2 * (value + by) if doubled else value + by


@kernel
def _shifted_often(values: np.ndarray) -> int:
    return _shifted(values[0], 1, True) + _shifted(values[1], 2, False) + _shifted(values[0], values[1], True)


@pytest.mark.skipif(kernel_module.JIT_DISABLED, reason="nothing is compiled")
def test_a_kernel_is_compiled_once_for_all_literals_and_integers_of_its_callers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kernel_module, "cache_folder", None)  # from which it would not be compiled at all
    assert _shifted_often(np.array([3, 4], np.int32)) == 8 + 6 + 14
    assert isinstance(_shifted, Kernel)
    (signature,) = _shifted.dispatcher_for().overloads
    assert [str(kind) for kind in signature] == ["int64", "int64", "bool"]


@kernel
def _half(value: float) -> float:
    return 0.5 * value


@kernel
def _quarter(value: float) -> float:
    return _half(_half(value))


def test_a_plain_kernel_is_compiled_nowhere_within_and_afterwards_as_ever() -> None:
    assert plain(_quarter)(6.0) == 1.5
    if not kernel_module.JIT_DISABLED:
        assert (_quarter.loaded, _half.loaded) == (0, 0)
        with pytest.raises(TypeError):
            plain(_quarter)("not a number")
        assert _quarter(6.0) == 1.5
        assert (_quarter.loaded, _half.loaded) == (1, 0)


_LARGE = np.arange(400_000.0)  # numba takes a constant so large by its address


@kernel
def _of_large(index: int) -> float:
    return _LARGE[index]


@pytest.mark.skipif(kernel_module.JIT_DISABLED, reason="nothing is compiled")
def test_machine_code_with_an_address_of_this_process_is_never_kept() -> None:
    with (
        pytest.warns(NumbaWarning, match="dynamic globals"),
        pytest.raises(TypeError, match="holds an address of this"),
    ):
        _of_large(3)


def test_options() -> None:
    assert compiler.OPTIONS["nogil"] is True
    assert compiler.OPTIONS["error_model"] == "numpy"
    assert "fastmath" not in compiler.OPTIONS


@pytest.mark.parametrize("of", [(caching.IndexDataCacheFile, "_save_index"), (machine_code, "write")])
def test_a_cache_that_takes_nothing_more_does_not_cost_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, of: tuple[Any, str]
) -> None:
    refused = []

    def full(*_: object) -> None:
        refused.append(1)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(*of, full)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))  # nothing of an earlier run
    monkeypatch.setattr(Kernel, "_cache_path", lambda *_: tmp_path / "twice.entry")

    @kernel
    def twice(a: float) -> float:
        return 2.0 * a

    assert twice(3.0) == 6.0
    assert refused


def test_a_folder_that_cannot_be_written_is_no_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JOINTCTL_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "as before")
    assert (folder := kernel_module.prepare_cache()) is not None
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "as before")
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    assert kernel_module.prepare_cache() is None
    assert os.environ["NUMBA_CACHE_DIR"] == "as before"


@pytest.mark.skipif(kernel_module.JIT_DISABLED, reason="plain Python allocates")
def test_what_allocates_does_not_compile() -> None:
    @kernel
    def allocating(count: int) -> float:
        return float(np.zeros(count)[0])

    with pytest.raises(NumbaError, match="zeros"):
        allocating(3)


# --- machine code is made where it is needed, and loaded without the compiler ---
ONE_KERNEL = """
from jointctl.firmware_py.kernel import kernel

@kernel
def doubled(a: float) -> float:
    return 2.0 * a

@kernel
def called(a: float) -> float:
    return doubled(a) + 1.0
"""
CALLS_IT = """
import sys
from one_kernel import called, doubled

print(called(3.0), called.loaded, doubled.loaded, "numba" in sys.modules)
"""
COMPILES_WITH_IT = """
import numba
from one_kernel import doubled

again = numba.njit(lambda a: doubled(a) + 2.0)  # kept nowhere, so that it needs what it calls
print(again(3.0))
for compiled in doubled.dispatcher_for().overloads.values():
    library = compiled.library
    print(library._late, library.get_pointer_to_function(compiled.fndesc.mangled_name) > 0, library._late)
    print(library.get_pointer_to_function("not_there"))
print(sum(doubled.dispatcher_for().stats.cache_hits.values()))
"""


@pytest.mark.skipif(kernel_module.JIT_DISABLED, reason="nothing is compiled")
def test_what_only_kernels_call_has_no_machine_code_and_comes_from_the_cache(tmp_path: Path) -> None:
    (tmp_path / "one_kernel.py").write_text(ONE_KERNEL)

    def run(code: str) -> list[str]:
        begin = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        return run_python(begin + code, JOINTCTL_CACHE_DIR=str(tmp_path / "cache")).split()

    assert run(CALLS_IT) == ["7.0", "1", "0", "True"]
    assert run(CALLS_IT) == ["7.0", "1", "0", "False"]
    assert run(COMPILES_WITH_IT) == ["8.0", "True", "True", "False", "0", "1"]
    (tmp_path / "one_kernel.py").write_text(ONE_KERNEL.replace("2.0 * a", "4.0 * a"))
    assert run(CALLS_IT) == ["13.0", "1", "0", "True"]  # never run stale


class Colour(IntEnum):
    RED = 1
    BLUE = 2


class Both(NamedTuple):
    first: Any
    second: Any


@record
class Inner:
    a: i4
    b: f8


@record
class Outer:
    x: f8
    inner: Inner
    many: Annotated[np.ndarray, array_of(f8, 3)]


@kernel
def total(array: np.ndarray) -> float:
    """Weighted by place, so that a wrong stride shows."""
    result = 0.0
    if array.ndim == 1:
        for i in range(array.shape[0]):
            result += (i + 1) * array[i]
    return result


@kernel
def total2(array: np.ndarray) -> float:
    result = 0.0
    for i in range(array.shape[0]):
        for k in range(array.shape[1]):
            result += (10 * i + k + 1) * array[i, k]
    return result


GRID = np.arange(24.0).reshape(4, 6)


@pytest.mark.parametrize(
    "array", [np.arange(6.0), GRID[1], GRID[:, 2], GRID[::-1, 3], np.arange(5, dtype=np.int32), np.zeros(0)]
)
def test_an_array_of_any_layout_is_handed_over(array: np.ndarray) -> None:
    assert total(array) == sum((i + 1) * float(value) for i, value in enumerate(array))


@pytest.mark.parametrize("array", [GRID, GRID.T, GRID[::2, 1:4], GRID.T[1:3, ::2], np.asfortranarray(GRID), GRID[:0]])
def test_one_of_two_dimensions_too(array: np.ndarray) -> None:
    expected = sum((10 * i + k + 1) * float(array[i, k]) for i in range(array.shape[0]) for k in range(array.shape[1]))
    assert total2(array) == expected


@kernel
def fill(outer: Outer, row: Any, value: float) -> None:
    outer.x = value
    outer.inner.a = 7
    outer.many[1] = 2.0 * value
    row.b = -value


def test_records_and_arrays_are_written_where_they_are() -> None:
    outers, inners = new(Outer, 3), new(Inner, 2)
    fill(outers[2], inners[1], 1.5)
    assert (outers[2].x, outers[2].inner.a, outers[2].many.tolist()) == (1.5, 7, [0.0, 3.0, 0.0])
    assert inners[1].b == -1.5
    assert not outers[:2].tobytes().strip(b"\0")
    assert not inners[:1].tobytes().strip(b"\0")


@kernel
def echo(values: Any, flag: bool, number: int, colour: Any, small: Any) -> Any:
    first = values.first
    if values.second is None:
        first = first + 1
    return Both(first, (flag, number - 1)), small, colour == Colour.BLUE


def test_numbers_truths_tuples_enums_and_none_come_and_go() -> None:
    arguments = (Both(2, None), True, -(1 << 62), Colour.BLUE, np.uint8(255))
    values = echo(*arguments)
    assert values == (Both(3, (True, -(1 << 62) - 1)), 255, True)
    assert type(values[0]) is Both
    assert values[0][1][0] is True
    assert echo(Both(2.5, 0.0), flag=False, number=1, colour=Colour.RED, small=np.int16(-3)) == (
        Both(2.5, (False, 0)), -3, False,
    )  # fmt: skip


@kernel
def colour_of(number: int) -> Any:
    return Colour.RED if number == 1 else Colour.BLUE


@kernel
def with_default(a: float, b: float = 3.0) -> float:
    return a * b


@kernel
def calls(function: Any, a: float) -> float:
    return function(a, 2.0)


@kernel
def halved(a: float, b: float) -> float:
    return a / b


def test_an_enum_a_default_value_and_a_kernel() -> None:
    assert colour_of(1) is Colour.RED
    assert with_default(2.0) == 6.0
    assert with_default(2.0, b=4.0) == with_default(b=4.0, a=2.0) == 8.0
    assert calls(halved, 3.0) == 1.5
    assert calls(divide, 3.0) == 1.5
    with pytest.raises(TypeError):
        with_default()


@pytest.mark.skipif(kernel_module.JIT_DISABLED, reason="nothing is compiled")
def test_what_machine_code_cannot_be_given_is_refused() -> None:
    with pytest.raises(TypeError, match="str"):
        divide("a", 1.0)  # type: ignore[arg-type]
    with pytest.raises(struct.error):
        colour_of(1 << 63)


def test_machine_code_that_is_not_as_it_was_written_is_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "x.entry"
    code = MachineCode("symbol", "qd", Result("d"), b"object", alone=True)
    machine_code.write(path, code)
    assert machine_code.read(path) == code
    assert [each.name for each in tmp_path.iterdir()] == ["x.entry"]
    data = path.read_bytes()
    for damaged in (b"", data[:40], data[:-1], data[:-1] + b"x", b"x" + data[1:]):
        path.write_bytes(damaged)
        assert machine_code.read(path) is None
    assert machine_code.read(tmp_path / "none") is None


@pytest.mark.skipif(kernel_module.JIT_DISABLED, reason="nothing is compiled")
def test_what_the_loop_and_the_virtual_joint_run_stands_alone() -> None:
    """Nothing of it is left to be found in the compiler, which their processes do not load."""
    total(np.arange(3.0))
    kept = [machine_code.read(path) for path in kernel_module.cache_folder.glob("*.entry")]
    assert kept
    assert all(code is not None and machine_code.stands_alone(code.object_code) for code in kept)
    code = next(code for code in kept if code is not None)
    assert machine_code.unresolved(code.object_code) is not None
    assert machine_code.unresolved(b"MZ") is None
    assert not machine_code.stands_alone(b"MZ")


# --- the cache must never run stale ---
@pytest.fixture
def copy_of_sources(tmp_path: Path) -> Path:
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def test_the_hash_depends_on_the_sources_and_not_on_their_place(copy_of_sources: Path) -> None:
    before = source_hash(copy_of_sources)
    assert len(before) == 16
    (copy_of_sources / "firmware_py" / "safety.py").touch()
    assert source_hash(copy_of_sources) == before


@pytest.mark.parametrize(
    ("edited", "counts"),
    [
        ("firmware_py/friction.py", True), ("drivers/canopen/exchange.py", True), ("drivers/canopen/cyclic.py", True),
        ("hil/plant.py", True), ("tools/identification/fit.py", True), ("tools/wake_up.py", True),
        ("tools/verbs/run.py", False),
    ],
)  # fmt: skip
def test_an_edited_or_renamed_callee_changes_the_hash_and_an_edited_verb_does_not(
    copy_of_sources: Path, edited: str, counts: bool
) -> None:
    before = source_hash(copy_of_sources)
    path = copy_of_sources / edited
    path.write_text(path.read_text() + "\n# edited\n")
    changed = source_hash(copy_of_sources)
    path.rename(path.with_name("renamed.py"))
    assert len({before, changed, source_hash(copy_of_sources)}) == (3 if counts else 1)


def test_the_cache_is_where_the_variable_says(tmp_path: Path) -> None:
    code = "from jointctl.firmware_py.kernel import cache_folder, kernel; print(cache_folder)"
    folder = Path(run_python(code, JOINTCTL_CACHE_DIR=str(tmp_path)).strip())
    assert folder == tmp_path / f"numba-{source_hash()}"
    assert folder.is_dir()


TWO_AT_ONCE = """
import sys, time
from pathlib import Path
from jointctl.firmware_py import compiler
from jointctl.firmware_py.safety import within
compiled, count = compiler.compiled, []
def slowly(*given):
    count.append(1)
    time.sleep(1.0)
    return compiled(*given)
compiler.compiled = slowly
folder, own = Path(sys.argv[1]), int(sys.argv[2])
(folder / f"here{own}").touch()
while not (folder / f"here{1 - own}").exists():
    time.sleep(0.001)
assert within(1.0, 0.0, 2.0)
print(len(count))
"""


def test_what_two_processes_need_at_once_is_compiled_once(tmp_path: Path) -> None:
    environment = {**os.environ, "JOINTCTL_CACHE_DIR": str(tmp_path)}
    both = [
        subprocess.Popen([sys.executable, "-c", TWO_AT_ONCE, tmp_path, str(k)], env=environment, stdout=subprocess.PIPE)
        for k in range(2)
    ]
    assert sorted(one.communicate(timeout=100.0)[0].split() for one in both) == [[b"0"], [b"1"]]
    assert list(tmp_path.glob("numba-*/*.lock")) == []


def test_a_process_that_is_halted_while_it_compiles_is_not_waited_for_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_module, "LONGEST_WAIT_s", 0.1)
    entered = []
    with kernel_module._one_process(tmp_path / "lock"), kernel_module._one_process(tmp_path / "lock"):
        entered.append(True)
    assert entered


def test_without_a_folder_it_still_works(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    code = "from jointctl.firmware_py.law import solve_lyapunov_p\n"
    code += "from jointctl.firmware_py.kernel import cache_folder, kernel\n"
    code += "from jointctl.firmware_py.safety import within\nprint(cache_folder, within(1.0, 0.0, 2.0))"
    assert run_python(code, JOINTCTL_CACHE_DIR=str(blocked)).split() == ["None", "True"]


def test_old_caches_are_removed_but_not_those_in_use(tmp_path: Path) -> None:
    now = time.time()
    for k in range(8):
        folder = tmp_path / f"numba-{k}"
        folder.mkdir()
        age_s = 60.0 if k == 7 else 4000.0 + k
        os.utime(folder, (now - age_s, now - age_s))
    kernel_module._prune(tmp_path, tmp_path / "numba-0")
    left = {p.name for p in tmp_path.iterdir()}
    assert "numba-0" in left  # the present one
    assert "numba-7" in left  # used a minute ago
    assert left == {"numba-0", "numba-7", "numba-1", "numba-2"}


# --- without the JIT ---
PLAIN = (
    "firmware_py/axis/test_safety*", "firmware_py/axis/test_axis_swing*", "firmware_py/axis/test_sequence_*",
    "firmware_py/test_friction", "firmware_py/test_kalman", "firmware_py/test_law", "drivers/canopen/test_cia402",
    "firmware_py/axis/test_live_*", "firmware_py/axis/test_stream", "firmware_py/axis/test_supervision_edges",
    "firmware_py/axis/test_sweep_velocity_command", "firmware_py/axis/test_own_loop", "firmware_py/test_schema",
)  # fmt: skip
FULLY_COVERED = (
    "drivers/canopen/cia.py",
    *(f"firmware_py/{name}.py" for name in ("safety", "sequence", "live_change")),
)


@pytest.mark.slow("the tests of the safety code once more, without the compiler")
def test_the_same_tests_pass_in_plain_python_and_cover_the_safety_code(tmp_path: Path) -> None:
    report = tmp_path / "coverage.json"
    files = [str(file) for name in PLAIN for file in sorted((ROOT / "tests" / "unit").glob(f"{name}.py"))]
    assert len(files) >= len(PLAIN)
    command = [sys.executable, "-m", "pytest", "-n0", "-p", "no:cacheprovider", *files]
    settings = tmp_path / "coverage.ini"  # lines of other files are not counted, which takes most of the time
    settings.write_text("[run]\nbranch = true\ninclude =\n" + "".join(f"  {ROOT / name}\n" for name in FULLY_COVERED))
    command += ["--cov", f"--cov-config={settings}", f"--cov-report=json:{report}"]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "COVERAGE_FILE": str(tmp_path / ".coverage")}
    result = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=1200.0
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    files = json.loads(report.read_text())["files"]
    for name in FULLY_COVERED:
        assert files[name]["missing_lines"] == [], name
        assert files[name]["missing_branches"] == [], name


def test_an_index_of_the_cache_that_cannot_be_read_costs_compiling_not_the_run(tmp_path: Path) -> None:
    def load(index: bytes) -> object:
        file = caching.IndexDataCacheFile(str(tmp_path), "kernel", 1)
        Path(file._index_path).write_bytes(pickle.dumps(file._version) + index)
        return file.load("signature")

    assert load(pickle.dumps((1, {}))) is None
    assert load(b"no pickle") is None
    assert load(pickle.dumps((1, {"x": StubOfATest})).replace(b"StubOfATest", b"NotThereNow")) is None


class StubOfATest:
    """What another program's cache may name."""

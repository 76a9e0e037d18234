"""The one decorator: options that matter for safety, the key of the cache, and the same results without the JIT."""

from __future__ import annotations

import errno
import json
import math
import os
import pickle
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numba.core import caching
from numba.core.errors import NumbaError

from jointctl.firmware_py import kernel as kernel_module
from jointctl.firmware_py.kernel import kernel, source_hash
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


def test_options() -> None:
    assert kernel_module._OPTIONS["nogil"] is True
    assert kernel_module._OPTIONS["error_model"] == "numpy"
    assert "fastmath" not in kernel_module._OPTIONS


def test_a_cache_that_takes_nothing_more_does_not_cost_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(caching.IndexDataCacheFile, "_save_index", full)

    @kernel
    def twice(a: float) -> float:
        return 2.0 * a

    assert twice(3.0) == 6.0


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


# --- machine code is made where it is needed ---
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
import numba
from one_kernel import called, doubled

again = numba.njit(lambda a: doubled(a) + 2.0)  # kept nowhere, so that it needs what it calls

def made(which: object) -> list[object]:
    return [*which.overloads.values()]

def hits(which: object) -> int:
    return sum(which.stats.cache_hits.values())

print(called(3.0), again(3.0), doubled(3.0))
print(made(called)[0].library._late, hits(called), hits(doubled.inner), hits(doubled))
for compiled in made(doubled.inner):
    library = compiled.library
    print(library._late, library.get_pointer_to_function(compiled.fndesc.mangled_name) > 0, library._late)
    print(library.get_pointer_to_function("not_there"))
"""


@pytest.mark.skipif(kernel_module.JIT_DISABLED, reason="nothing is compiled")
def test_what_only_kernels_call_has_no_machine_code_and_comes_from_the_cache(tmp_path: Path) -> None:
    (tmp_path / "one_kernel.py").write_text(ONE_KERNEL)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n" + CALLS_IT
    cache = str(tmp_path / "cache")
    first, second = (run_python(code, JOINTCTL_CACHE_DIR=cache).split() for _ in range(2))
    assert first[:7] == ["7.0", "8.0", "6.0", "False", "0", "0", "0"]
    assert second[:7] == ["7.0", "8.0", "6.0", "False", "1", "1", "1"]
    assert first[7:] == second[7:] == ["True", "True", "False", "0"]


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


def test_without_a_folder_it_still_works(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    code = "from jointctl.firmware_py.law import eigenvalues\n"
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
    "firmware_py/axis/test_sweep_velocity_command", "firmware_py/axis/test_own_loop",
)  # fmt: skip
FULLY_COVERED = (
    "drivers/canopen/cia402.py",
    *(f"firmware_py/{name}.py" for name in ("safety", "sequence", "live_change", "stream")),
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

    assert load(pickle.dumps((1, {}))) is None  # the twin
    assert load(b"no pickle") is None
    assert load(pickle.dumps((1, {"x": StubOfATest})).replace(b"StubOfATest", b"NotThereNow")) is None


class StubOfATest:
    """What another program's cache may name."""

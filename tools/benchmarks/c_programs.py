"""Our C sources for comparison, compiled for this very computer.

They lie in tests/bench/c of the source tree and are not part of the installed package; without them, or without a
compiler, the comparisons with C are skipped.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

from jointctl.drivers.errors import JointctlError

SOURCES = Path(__file__).resolve().parents[2] / "tests" / "bench" / "c"
OPTIMISED = ("-O3", "-march=native")
FAST_MATH = (*OPTIMISED, "-ffast-math")


class NoCompilerError(JointctlError):
    """There is nothing to compile with, or nothing to compile."""


def compiler() -> str:
    """Path of the C compiler; `NoCompilerError` in one line."""
    if not SOURCES.is_dir():
        raise NoCompilerError("the C sources are not installed with the package: run from the source tree")
    for name in ("gcc", "cc"):
        found = shutil.which(name)
        if found:
            return found
    raise NoCompilerError("no C compiler on this computer")


def _compile(source: str, target: Path, options: tuple[str, ...]) -> None:
    command = [compiler(), *options, str(SOURCES / source), "-o", str(target), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        first = (result.stderr.strip().splitlines() or ["no message"])[0]
        raise NoCompilerError(f"{source} does not compile: {first}")


def law_library(folder: Path, options: tuple[str, ...]) -> ctypes.CDLL:
    """law_tick.c as a library with the given optimisation."""
    target = folder / f"law{'-'.join(options).replace('=', '-')}.so"
    _compile("law_tick.c", target, (*options, "-shared", "-fPIC"))
    library = ctypes.CDLL(str(target))
    for name in ("run_ticks", "run_hidden"):
        getattr(library, name).argtypes = [ctypes.c_void_p] * 4 + [ctypes.c_long]
        getattr(library, name).restype = None
    for name in ("law_doubles", "state_doubles"):
        getattr(library, name).restype = ctypes.c_long
    return library


def exchange_program(folder: Path) -> Path:
    """exchange_loop.c as a program."""
    target = folder / "exchange_loop"
    _compile("exchange_loop.c", target, OPTIMISED)
    return target

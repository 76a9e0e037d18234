"""The shape of the project beyond what import-linter sees: top-level names, imports in functions, where kernels are."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from jointctl.firmware_py.kernel import TOOLS_WITH_KERNELS
from tests.places import ROOT

TOP_LEVEL = ("firmware_py", "drivers", "hil", "tools", "configs")
LONGEST_MODULE = 600  # where a reader asks whether it is one concept; tests may be longer
WITH_KERNELS = sorted(path for pattern in TOOLS_WITH_KERNELS for path in (ROOT / "tools").glob(pattern))
MODULES = sorted(path for folder in TOP_LEVEL for path in (ROOT / folder).rglob("*.py"))


@cache
def imported(path: Path) -> set[str]:
    """Every name that a module imports, as `package.module` and `package.module.name`; wherever it does so."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_no_module_is_imported_by_the_name_of_its_folder() -> None:
    """One name for each module: `jointctl.drivers`, never `drivers`."""
    wrong = {(str(path), name) for path in MODULES for name in imported(path) if name.split(".")[0] in TOP_LEVEL}
    assert wrong == set()


def test_the_links_are_the_folders_under_their_installed_names() -> None:
    links = ROOT / ".typed" / "jointctl"
    if not links.exists():
        pytest.skip("this is no clone: an sdist has no links")
    face = {path.name for path in (ROOT / "interface").iterdir()} - {"__pycache__"}
    assert {link.name for link in links.iterdir() if link.name != "__pycache__"} == face | set(TOP_LEVEL)
    for name in TOP_LEVEL:
        assert (links / name).resolve() == ROOT / name
    for name in face:
        assert (links / name).resolve() == ROOT / "interface" / name


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("firmware_py", ("drivers", "hil", "tools", "configs")),
        ("drivers", ("hil", "tools", "configs")),
        ("hil", ("drivers", "tools", "configs")),
    ],
)
def test_layers_hold_for_imports_inside_functions_too(package: str, forbidden: tuple[str, ...]) -> None:
    for path in (ROOT / package).rglob("*.py"):
        wrong = {name for name in imported(path) if name.split(".")[:2] in [["jointctl", layer] for layer in forbidden]}
        assert not wrong, f"{path.relative_to(ROOT)} imports {wrong}"


def test_kernels_are_only_where_the_cache_key_looks() -> None:
    """`firmware_py.kernel.source_hash` leaves out the verbs, so that editing one does not recompile everything."""
    for path in set((ROOT / "tools").rglob("*.py")).difference(WITH_KERNELS):
        decorators = {
            "jointctl.firmware_py.kernel.kernel",
            "jointctl.firmware_py.kernel.inlined",
            "jointctl.firmware_py.kernel.exported",
        }
        wrong = {name for name in imported(path) if name in decorators or name.split(".")[0] == "numba"}
        assert not wrong, f"{path.relative_to(ROOT)} imports {wrong}: kernels live in {TOOLS_WITH_KERNELS}"


def test_kernels_do_not_depend_on_what_the_cache_key_leaves_out() -> None:
    """A constant that a kernel takes from a module outside the key could change without a recompilation."""
    inside = tuple(".".join(("jointctl", *path.relative_to(ROOT).with_suffix("").parts)) for path in WITH_KERNELS)
    having = [path for path in WITH_KERNELS if "jointctl.firmware_py.kernel.kernel" in imported(path)]
    assert {path.name for path in having} == {"swarm.py", "wake_up.py"}
    for path in having:
        wrong = {n for n in imported(path) if n.startswith("jointctl.tools.") and not n.startswith(inside)}
        assert not wrong, f"{path.relative_to(ROOT)} has kernels and imports {wrong}"


def too_long(path: Path) -> bool:
    return len(path.read_text().splitlines()) > LONGEST_MODULE


def test_modules_are_short() -> None:
    """A longer one is to be split."""
    assert [path for path in MODULES if too_long(path)] == []


@pytest.mark.parametrize(("lines", "refused"), [(LONGEST_MODULE, False), (LONGEST_MODULE + 1, True)])
def test_one_line_too_many_is_refused(tmp_path: Path, lines: int, refused: bool) -> None:
    path = tmp_path / "module.py"
    path.write_text("pass\n" * lines)
    assert too_long(path) == refused


def test_unit_tests_have_names_of_their_own() -> None:
    """`pytest -k` and a look at a list of failures tell which module it is."""
    names = [path.name for path in (ROOT / "tests" / "unit").rglob("test_*.py")]
    assert sorted(set(names)) == sorted(names)

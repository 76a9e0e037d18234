"""Mutation run of the safety code: change one thing at a time, and see whether a test notices.

    NUMBA_DISABLE_JIT=1 python tests/bench/mutation_run.py [--module firmware_py/safety.py] [--part 1/2]

Mutants: another comparison, `and` for `or`, the operands' sign or operation, a constant one off, a condition negated,
another member of an enumeration, a statement left out.  Each runs in a child process that loads the changed module in
place of the file, first with the module's own tests, then with those of the axis; the file itself is not touched.
Survivors are explained in docs/safety-mutations.md.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib.abc
import importlib.machinery
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
TESTS = {
    "firmware_py/safety.py": ("test_safety", "test_axis"),
    "firmware_py/sequence.py": ("test_sequence", "test_axis"),
    "firmware_py/surroundings.py": ("test_surroundings_edges",),
    "firmware_py/frozen_reading.py": ("test_surroundings_edges",),
    "drivers/canopen/cia402.py": ("test_cia402",),
}
LONGEST_S = 120.0  # of processor time: on a busy computer a sound mutant must not count as one that hangs
COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,),
}  # fmt: skip
OPERATIONS: dict[type, type] = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
ENUMERATIONS = (
    "Fault",
    "Reaction",
    "AxisPhase",
    "DriveState",
    "DriveRequest",
    "State",
    "ControlWord",
    "StopRequest",
    "CommandKind",
)


def _variants(node: ast.AST) -> Iterator[tuple[str, Any]]:
    """(what is done, function that does it to a copy of the node)."""
    if isinstance(node, ast.Compare):
        for place, operator in enumerate(node.ops):
            for other in COMPARISONS.get(type(operator), ()):
                yield f"{type(operator).__name__} -> {other.__name__}", ("ops", place, other())
    elif isinstance(node, ast.BoolOp):
        other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield f"{type(node.op).__name__} -> {type(other).__name__}", ("op", None, other)
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATIONS:
        other_operation = OPERATIONS[type(node.op)]
        yield f"{type(node.op).__name__} -> {other_operation.__name__}", ("op", None, other_operation())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign dropped", ("op", None, ast.UAdd())
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool):
        yield f"{node.value} -> {node.value + 1}", ("value", None, node.value + 1)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"{node.value} -> {not node.value}", ("value", None, not node.value)
    elif isinstance(node, ast.If):
        yield "condition negated", ("test", None, ast.UnaryOp(ast.Not(), node.test))
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ENUMERATIONS:
        yield f"{node.value.id}.{node.attr} -> next member", ("next", None, None)
    elif isinstance(node, (ast.Assign, ast.AugAssign)) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    ):
        yield "statement left out", ("pass", None, None)


def mutants(source: str, module: str) -> list[tuple[int, str, ast.Module]]:
    """(line, what was done, changed tree) for every mutant of the functions of a module.

    Each is made in a copy of its own: a change must neither be lost nor be left behind in the next mutant.
    """
    tree = ast.parse(source)
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    inside = {id(node) for function in functions for node in ast.walk(function)}
    skipped = {id(n) for f in functions for d in (*f.decorator_list, f.args) for n in ast.walk(d)}
    found = []
    for place_in_tree, original in enumerate(ast.walk(tree)):
        if id(original) not in inside - skipped:
            continue
        for what, (field, place, value) in _variants(original):
            changed = copy.deepcopy(tree)
            node: Any = list(ast.walk(changed))[place_in_tree]
            if field == "next":
                members = _members(module, node.value.id)
                node.attr = members[(members.index(node.attr) + 1) % len(members)]
            elif field == "pass":
                line, end = node.lineno, node.end_lineno
                node.__class__ = ast.Pass
                vars(node).clear()
                node.lineno, node.end_lineno, node.col_offset, node.end_col_offset = line, end, 0, 0
            elif place is None:
                setattr(node, field, value)
            else:
                getattr(node, field)[place] = value
            if ast.dump(changed) == ast.dump(tree):
                raise AssertionError(f"{module}:{original.lineno}: {what} changes nothing")  # type: ignore[attr-defined]
            found.append((getattr(original, "lineno", 0), what, ast.fix_missing_locations(changed)))
    return found


def _members(module: str, enumeration: str) -> list[str]:
    source = ROOT / (module if enumeration in ("State", "ControlWord") else "firmware_py/states.py")
    for node in ast.parse(source.read_text()).body:
        if isinstance(node, ast.ClassDef) and node.name == enumeration:
            return [item.targets[0].id for item in node.body if isinstance(item, ast.Assign)]  # type: ignore[attr-defined]
    raise ValueError(f"enumeration (={enumeration}) must be in firmware_py/states.py or {module}")


class _Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module from a changed tree."""

    def __init__(self, module: str, tree: ast.Module) -> None:
        self._name, self._tree, self._path = module[:-3].replace("/", "."), tree, ROOT / module

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        if name != self._name:
            return None
        return importlib.machinery.ModuleSpec(name, self, origin=str(self._path))

    def exec_module(self, module: Any) -> None:
        module.__file__ = str(self._path)
        exec(compile(self._tree, str(self._path), "exec"), module.__dict__)


def killed(module: str, tree: ast.Module) -> bool:
    """Whether a test fails on the changed module, in a child process; one that hangs counts as killed."""
    child = os.fork()
    if child == 0:
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
        import pytest

        sys.meta_path.insert(0, _Changed(module, tree))
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", "--hypothesis-seed=0"]
        code = 1
        with contextlib.suppress(BaseException):
            for name in TESTS[module]:
                code = int(pytest.main([*options, str(ROOT / "tests" / "unit" / f"{name}.py")]))
                if code:
                    break
        os._exit(1 if code else 0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--module", choices=list(TESTS), action="append")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--part", default="1/1", help="k/n: every n-th mutant, from the k-th on")
    chosen = parser.parse_args()
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        print("NUMBA_DISABLE_JIT (=unset) must be 1: the mutants run as plain Python", file=sys.stderr)
        return 2
    sys.path.insert(0, str(ROOT))
    os.chdir(ROOT)
    import numba  # once for all children; what pytest rewrites (hypothesis) must not be imported here

    print(f"numba {numba.__version__}, part {chosen.part}", flush=True)
    part, parts = (int(text) for text in chosen.part.split("/"))
    survivors: list[dict[str, Any]] = []
    for module in chosen.module or TESTS:
        if killed(module, ast.parse((ROOT / module).read_text())):
            print(f"{module}: its tests fail without any change, or cannot run", file=sys.stderr)
            return 1
        found = mutants((ROOT / module).read_text(), module)[part - 1 :: parts]
        started = time.monotonic()
        lines = (ROOT / module).read_text().splitlines()
        alive = 0
        for line, what, tree in found:
            if not killed(module, tree):
                alive += 1
                text = lines[line - 1].strip()
                print(f"  {module}:{line}: {what}: {text}", flush=True)
                survivors.append({"module": module, "line": line, "mutation": what, "text": text})
        print(f"{module}: {len(found)} mutants, {alive} survive, {time.monotonic() - started:.0f} s", flush=True)
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(survivors, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

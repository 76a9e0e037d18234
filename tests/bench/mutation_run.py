"""Mutation run of the safety code: change one thing at a time, and see whether a test notices.

    NUMBA_DISABLE_JIT=1 python tests/bench/mutation_run.py [--module firmware_py/safety.py] [--part 1/2]
    python tests/bench/mutation_run.py                     the modules without kernels, against the compiled drive

Mutants: another comparison, `and` for `or`, the operands' sign or operation, a constant one off, a condition negated,
another member of an enumeration, a statement left out.  Each runs in a child process whose functions have the changed
code, with the module's own tests and those of the axis, until one fails; the file itself is not touched.
Survivors are explained in docs/safety-mutations.md.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
UNIT_TESTS = ROOT / "tests" / "unit"
TESTS = {  # below UNIT_TESTS
    "firmware_py/safety.py": ("firmware_py/axis/test_*",),
    "firmware_py/axis.py": ("firmware_py/axis/test_own_loop*", "firmware_py/axis/test_axis*"),
    "firmware_py/observers.py": ("firmware_py/axis/test_axis_*", "firmware_py/test_kalman", "firmware_py/test_law"),
    "firmware_py/live_change.py": (
        "firmware_py/axis/test_stream", "firmware_py/axis/test_sequence_rules", "firmware_py/axis/test_live_*",
    ),
    "firmware_py/sequence.py": (
        "firmware_py/axis/test_sequence_*", "firmware_py/axis/test_axis_*", "firmware_py/test_cycle",
    ),
    "drivers/canopen/cia.py": ("drivers/canopen/test_cia402",),
    "drivers/canopen/network.py": (
        "drivers/canopen/test_other_controllers", "drivers/canopen/test_switch_off", "drivers/canopen/test_arm_drives",
        "drivers/canopen/test_commissioning",
    ),
    "drivers/drive.py": ("drivers/canopen/test_switch_off", "drivers/elmo/test_elmo_drive"),
    "drivers/canopen/switch_off.py": ("drivers/canopen/test_switch_off",),
    "drivers/canopen/watchdog.py": ("drivers/canopen/test_watchdog", "drivers/canopen/test_switch_off"),
    "drivers/canopen/commissioning.py": (
        "drivers/canopen/test_commissioning", "drivers/canopen/test_odd_drives", "drivers/canopen/test_watchdog",
        "drivers/canopen/test_eds", "drivers/canopen/test_two_encoders",
    ),
    "drivers/canopen/drive.py": (
        "drivers/canopen/test_switch_off", "drivers/canopen/test_commissioning", "drivers/canopen/test_watchdog",
        "drivers/canopen/test_two_encoders", "drivers/canopen/test_other_controllers",
        "drivers/canopen/test_thermometer", "drivers/canopen/test_arm_drives", "drivers/canopen/test_odd_drives",
    ),
    "drivers/bus_lock.py": ("drivers/test_bus_lock", "drivers/test_stop_note", "session/test_control"),
    "drivers/stop_note.py": ("drivers/test_stop_note", "interface/test_joint_starts"),
    "tools/session/control.py": ("session/test_control",),
    "tools/session/elmo_guard.py": ("session/test_elmo_guard",),
    "tools/session/set_points.py": ("interface/test_lockstep_joint", "scoping/test_remote"),
}  # fmt: skip
KERNELS = (*(module for module in TESTS if module.startswith("firmware_py")), "drivers/canopen/cia.py")
# of processor time, the second times that of all tests: a mutant that no test notices must not count as one that hangs
LONGEST_S, LONGEST_FACTOR = 120.0, 2.0
LONGEST_TEST_S, LONGEST_TEST_FACTOR = 15.0, 10.0  # a test may take the sum of these, the second of its own time
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
    "Notice",
    "NmtCommand",
    "NmtState",
    "SetPointProblem",
)
HOMES = {  # of enumerations that are not in firmware_py/states.py
    "State": "drivers/canopen/cia.py", "ControlWord": "drivers/canopen/cia.py",
    "NmtCommand": "drivers/canopen/cia.py", "NmtState": "drivers/canopen/cia.py",
}  # fmt: skip


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
    functions = _functions(tree)
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
                members = _members(node.value.id)
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


def _functions(tree: ast.Module) -> list[ast.FunctionDef]:
    """Those of the module and the methods of its classes."""
    bodies = [tree.body, *(node.body for node in tree.body if isinstance(node, ast.ClassDef))]
    return [node for body in bodies for node in body if isinstance(node, ast.FunctionDef)]


def _members(enumeration: str) -> list[str]:
    source = ROOT / HOMES.get(enumeration, "firmware_py/states.py")
    for node in ast.parse(source.read_text()).body:
        if isinstance(node, ast.ClassDef) and node.name == enumeration:
            return [item.targets[0].id for item in node.body if isinstance(item, ast.Assign)]  # type: ignore[attr-defined]
    raise ValueError(f"enumeration (={enumeration}) must be in {source.name}")


def changed_code(module: str, tree: ast.Module) -> dict[str, Any]:
    """Function name -> the code object that the changed module gives it; module-level values are as they were."""
    loaded = importlib.import_module("jointctl." + module[:-3].replace("/", "."))
    space = dict(vars(loaded))
    defined = [node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
    exec(compile(ast.Module([*defined], []), str(ROOT / module), "exec"), space)
    found = {}
    for node in defined:
        if isinstance(node, ast.FunctionDef):
            found[node.name] = _bare(getattr(loaded, node.name)), _bare(space[node.name]).__code__
            continue
        before, after = vars(getattr(loaded, node.name)), vars(space[node.name])
        for method in node.body:
            if isinstance(method, ast.FunctionDef):
                found[f"{node.name}.{method.name}"] = _bare(before[method.name]), _bare(after[method.name]).__code__
    return found


def _bare(function: Any) -> Any:
    """The function itself, without property, staticmethod, or a decorator that wraps it."""
    function = getattr(function, "fget", None) or getattr(function, "__func__", function)
    return getattr(function, "__wrapped__", function)


class Session:
    """A pytest plugin: the tests of one module are collected once, and run in a child process for each mutant.

    Without the JIT a kernel is its Python function, so that whoever has imported it runs the changed code.  The tests
    that have noticed most mutants so far come first, then the quick ones.
    """

    def __init__(self, module: str, part: int, parts: int) -> None:
        self._module, self._part, self._parts = module, part, parts
        self.survivors: list[dict[str, Any]] = []
        self.refused = False

    def pytest_runtestloop(self, session: Any) -> bool:
        """In place of running the tests once."""
        source = (ROOT / self._module).read_text()
        items, durations_s = list(session.items), [0.0] * len(session.items)
        noticed = [0] * len(items)
        if self._first_failure(session, items, range(len(items)), {}, durations_s) is not None:
            print(f"{self._module}: its tests fail without any change", file=sys.stderr)
            self.refused = True
            return True
        found = mutants(source, self._module)[self._part - 1 :: self._parts]
        started, lines = time.monotonic(), source.splitlines()
        for count, (line, what, tree) in enumerate(found):
            if count % 20 == 0:
                print(f"  {count} of {len(found)}, {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
            order = sorted(range(len(items)), key=lambda i: (-noticed[i], durations_s[i]))
            by = self._first_failure(session, items, order, changed_code(self._module, tree), durations_s)
            if by is None:
                text = lines[line - 1].strip()
                print(f"  {self._module}:{line}: {what}: {text}", flush=True)
                self.survivors.append({"module": self._module, "line": line, "mutation": what, "text": text})
            elif by >= 0:
                noticed[by] += 1
        passed_s, alive = time.monotonic() - started, len(self.survivors)
        print(f"{self._module}: {len(found)} mutants, {alive} survive, {passed_s:.0f} s", flush=True)
        return True

    @staticmethod
    def _first_failure(
        session: Any, items: list[Any], order: Any, code: dict[str, Any], durations_s: list[float]
    ) -> int | None:
        """Index of the first test that fails in a child process; -1 if it hangs or dies, None if all pass.

        `durations_s`: of each test by the clock, 0 where that is not known; without a change of code it is measured.
        """
        read_fd, write_fd = os.pipe()
        child = os.fork()
        if child == 0:
            os.setpgid(0, 0)  # with what its tests start
            if code:
                signal.setitimer(signal.ITIMER_PROF, LONGEST_S + LONGEST_FACTOR * sum(durations_s))
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            for function, changed in code.values():
                function.__code__ = changed
            with contextlib.suppress(BaseException):
                ordered = [items[i] for i in order]
                for place, (item, following) in enumerate(zip(ordered, [*ordered[1:], None], strict=True)):
                    began_s = time.monotonic()
                    if code:
                        longest_s = LONGEST_TEST_S + LONGEST_TEST_FACTOR * durations_s[order[place]]
                        signal.setitimer(signal.ITIMER_REAL, longest_s)
                    item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                    passed = not session.testsfailed
                    os.write(write_fd, f"{order[place]} {time.monotonic() - began_s} {passed:d}\n".encode())
                    if not passed:
                        break
                else:
                    os.write(write_fd, b"all\n")
            os._exit(0)
        os.close(write_fd)
        try:
            with os.fdopen(read_fd) as answers:
                told = answers.read().splitlines()
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
        if told and told[-1] == "all":
            if not code:
                for line in told[:-1]:
                    durations_s[int(line.split()[0])] = float(line.split()[1])
            return None
        last = told[-1].split() if told else ["-1", "0", "1"]
        return int(last[0]) if last[2] == "0" else -1


def files_of_tests(module: str) -> list[Path]:
    """The files of the tests of a module; ValueError if one of `TESTS` is not there."""
    found = {name: sorted(UNIT_TESTS.glob(f"{name}.py")) for name in TESTS[module]}
    for name, files in found.items():
        if not files:
            raise ValueError(f"{module}: tests/unit/{name}.py does not exist")
    return [file for files in found.values() for file in files]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--module", choices=list(TESTS), action="append")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--part", default="1/1", help="k/n: every n-th mutant, from the k-th on")
    chosen = parser.parse_args()
    plain = os.environ.get("NUMBA_DISABLE_JIT") == "1"
    modules = chosen.module or [module for module in TESTS if (module in KERNELS) == plain]
    if any((module in KERNELS) != plain for module in modules):
        print(f"NUMBA_DISABLE_JIT must be 1 for {', '.join(KERNELS)}, and unset for the others", file=sys.stderr)
        return 2
    sys.path.insert(0, str(ROOT))
    os.chdir(ROOT)
    import pytest

    print(f"part {chosen.part}", flush=True)
    part, parts = (int(text) for text in chosen.part.split("/"))
    options = [
        "-o",
        "addopts=--import-mode=importlib",
        "-s",
        "-qq",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:randomly",
        "-p",
        "no:xdist",
        "--hypothesis-seed=0",
    ]
    survivors: list[dict[str, Any]] = []
    for module in modules:
        session = Session(module, part, parts)
        code = pytest.main([*options, *map(str, files_of_tests(module))], plugins=[session])
        if code or session.refused:
            return 1
        survivors += session.survivors
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(survivors, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

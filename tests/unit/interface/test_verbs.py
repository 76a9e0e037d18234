"""The commands as functions, and what `import jointctl` gives."""

from __future__ import annotations

import ast
import inspect
import runpy
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import jointctl
from jointctl import verbs
from jointctl.drivers.errors import DECLINED, INTERRUPTED
from jointctl.firmware_py.states import Fault
from jointctl.tools.inspection.health import PROBLEM, Finding
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.session.result import RunResult
from jointctl.tools.verbs.verb_options import ResultOutput
from tests.configurations import written
from tests.places import CONFIGS


def test_every_name_is_there_and_typed() -> None:
    for name in jointctl.__all__:
        assert getattr(jointctl, name) is not None
    assert Path(jointctl.__file__).with_name("py.typed").exists()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = jointctl.nothing  # type: ignore[attr-defined]


def test_what_a_type_checker_knows_of_the_options_is_what_they_are() -> None:
    """Written anew by `python docs/signatures.py`."""
    made = runpy.run_path(str(CONFIGS.parent / "docs" / "signatures.py"))
    written = made["TARGET"].read_text(encoding="utf-8")
    assert ast.dump(ast.parse(made["stub"]())) == ast.dump(ast.parse(written))


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, jointctl; print([m for m in ('numpy', 'numba', 'scipy', 'can', 'matplotlib') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True).stdout == "[]\n"


@pytest.mark.parametrize(
    "call", ["Joint('virtual')", "Joint('virtual', lockstep=True)", "Arm('virtual', lockstep=True)", "check('virtual')"]
)
def test_too_few_files_may_be_opened(call: str) -> None:
    code = (
        "import jointctl, resource; jointctl.Joint, jointctl.Arm, jointctl.check, jointctl.JointctlError\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (30, 30))\n"
        f"try: jointctl.{call}\n"
        "except jointctl.JointctlError as error: print(type(error).__name__, error.message)"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert done.stdout.startswith("JointctlError open files: "), done.stderr
    assert "more may be opened, at least 32 are needed" in done.stdout


def test_the_processes_of_a_study_do_not_run_the_users_program_again(tmp_path: Path) -> None:
    """It may have moved a joint before, and need not protect what it does by a condition on its name."""
    program = tmp_path / "program.py"
    program.write_text(
        "import jointctl\n"
        "print('once')\n"
        "found = jointctl.study(plants=['3'], controllers=['pid'], after_s=0.0, workers=2, quiet=True)\n"
        "print(found.values('pid', 'rmse_mrad').shape)\n"
    )
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=300.0)
    assert (done.stdout, done.returncode) == ("once\n(3,)\n", 0), done.stderr


COPIED = """
import sys, multiprocessing
import jointctl

def tried(call):
    try:
        call()
    except jointctl.JointctlError as error:
        print(__name__, type(error).__name__, flush=True)

tried(jointctl.Joint("joint.toml").__enter__)
tried(lambda: jointctl.run("joint.toml", yes=True, quiet=True))
process = multiprocessing.get_context(sys.argv[1]).Process(target=print)
process.start()
process.join()
"""


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_nor_does_a_process_of_the_program_itself_move_the_joint_again(tmp_path: Path, method: str) -> None:
    """Python runs the file from its first line there, where no condition on `__name__` keeps it from that."""
    written(tmp_path / "joint.toml", "virtual", bus__channel=str(tmp_path / "no-one"))
    (tmp_path / "program.py").write_text(COPIED)
    command = [sys.executable, "-P", "program.py", method]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300.0)
    assert done.stdout == "__main__ BusError\n" * 2 + "__mp_main__ UsageError\n" * 2, done.stderr


CLOSED = """
import os
import jointctl

for descriptor in range(3):
    os.close(descriptor)
try:
    {call}
except jointctl.JointctlError as error:
    found = [os.fstat(descriptor).st_rdev == os.stat(os.devnull).st_rdev for descriptor in range(3)]
    open("found.txt", "w").write(f"{{type(error).__name__}} {{found}}")
"""


@pytest.mark.parametrize(
    "call", ['jointctl.Joint("joint.toml").__enter__()', 'jointctl.run("joint.toml", yes=True, quiet=True)']
)
def test_what_a_program_prints_behind_closed_streams_does_not_land_in_a_bus(tmp_path: Path, call: str) -> None:
    """As one does that has made a daemon of itself: the next socket would get the number of its standard output."""
    written(tmp_path / "joint.toml", "virtual", bus__channel=str(tmp_path / "no-one"))
    (tmp_path / "program.py").write_text(CLOSED.format(call=call))
    subprocess.run([sys.executable, "-P", "program.py"], cwd=tmp_path, timeout=300.0, check=True)
    assert (tmp_path / "found.txt").read_text() == "BusError [True, True, True]"


def test_what_moves_a_joint_is_refused_in_another_thread_in_words(tmp_path: Path) -> None:
    written(tmp_path / "joint.toml", "virtual", bus__channel=str(tmp_path / "no-one"))
    with ThreadPoolExecutor(1) as threads:
        done = threads.submit(jointctl.run, tmp_path / "joint.toml", yes=True, quiet=True)
        with pytest.raises(jointctl.UsageError, match="in the main thread only"):
            done.result()


def test_check_gives_the_margins() -> None:
    report = jointctl.check("virtual")
    assert report.verdict == "ok"
    assert report.margins.phase_margin_deg > 20.0
    with pytest.raises(jointctl.MarginError, match="phase margin"):
        jointctl.check(CONFIGS / "virtual.toml", delay_s=0.02)
    with pytest.raises(TypeError, match="check\\(\\) has no option 'dellay'"):
        jointctl.check("virtual", dellay=1.0)
    with pytest.raises(jointctl.ConfigurationError):
        jointctl.check("no_such_file.toml")


def test_a_value_of_the_wrong_type_or_beyond_its_bounds_is_named() -> None:
    with pytest.raises(jointctl.UsageError, match=r"check\(\): delay_s \(=-1\): input should be greater than"):
        jointctl.check("virtual", delay_s=-1)
    with pytest.raises(jointctl.UsageError, match=r"study\(\): seed \(='x'\): input should be a valid integer"):
        jointctl.study(seed="x")
    with pytest.raises(TypeError, match="needs 'config'"):
        jointctl.check()
    with pytest.raises(TypeError, match="takes 1 arguments without a name at most, not 2"):
        jointctl.check("virtual", 0.01)
    with pytest.raises(TypeError, match=r"identify has no option 'quiet'; there are .*model, "):
        jointctl.identify("none.csv", quiet=True)
    with pytest.raises(TypeError, match=r"table has no option 'speed'; there are .*velocity_column"):
        jointctl.identify_motion("none.csv", table={"speed": "v"})


@pytest.mark.parametrize("name", verbs.VERBS)
def test_a_verb_shows_its_options_and_what_it_returns(name: str) -> None:
    function = getattr(jointctl, name)
    shown = inspect.signature(function)
    assert not {"json", "output", "assume_yes"} & set(shown.parameters)
    assert "Callable" not in str(shown.return_annotation)
    text = inspect.getdoc(function) or ""
    assert all(f"\n{key}: " in text for key in shown.parameters if key in ("yes", "dry_run", "report", "quiet"))


def test_results_come_as_objects_and_nothing_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "sweep.csv"
    swept = jointctl.sweep("sweep_virtual", out=data, lockstep=True, points=8, dwell_s=0.1, quiet=True)
    assert (swept.points, swept.data) == (8, str(data))
    studied = jointctl.study(plants=1, controllers=["pid"], after_s=1.0, workers=1, quiet=True)
    assert studied.values("pid", "rmse_mrad")[0] > 0.0
    with pytest.raises(jointctl.UsageError, match=r"controller \(=paper\) must be one of pid"):
        studied.values("paper", "rmse_mrad")
    with pytest.raises(jointctl.UsageError, match=r"figure \(=rmse\) must be one of peak_mrad, rmse_mrad, "):
        studied.values("pid", "rmse")
    assert capsys.readouterr().out == ""
    with pytest.raises(jointctl.DataError, match="exists already"):
        jointctl.sweep("sweep_virtual", out=data, lockstep=True)


def test_what_a_frequency_response_shows_is_a_result(tmp_path: Path) -> None:
    found, fit = jointctl.response(
        "virtual", lockstep=True, legs=8, out=tmp_path / "r.json", figure=tmp_path / "r.png", quiet=True
    )
    assert len(found.frequency_Hz) > 10
    assert fit.values["inertia_kgm2"].value == pytest.approx(2.1, rel=0.1)


def test_a_configuration_is_written_and_a_shipped_one_is_not_tuned(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    assert jointctl.new(path, shipped="precise", quiet=True) is None
    assert jointctl.check(path).verdict == "ok"
    assert jointctl.tune(path, lockstep=True, dry_run=True, quiet=True) is None
    with pytest.raises(jointctl.ConfigurationError, match="is not changed"):
        jointctl.tune("precise", lockstep=True)


def test_what_the_doctor_finds_is_a_result_and_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    bad = Finding("bus", PROBLEM, "there is none", "make one")
    monkeypatch.setattr(import_module("jointctl.tools.verbs.doctor"), "findings", lambda config, cold: iter([bad]))
    assert jointctl.doctor(quiet=True) == [bad]


class Ended:
    """As a `RunResult` that a fault has ended."""

    name, fault, fault_text = "", Fault.FOLLOWING_ERROR, fault_text(Fault.FOLLOWING_ERROR, 0.1, 0)
    motion_fault = RunResult.motion_fault

    @property
    def faulty(self) -> list[Ended]:
        return [self]


@pytest.mark.parametrize(
    ("code", "result", "kind", "words"),
    [
        (DECLINED, None, jointctl.JointctlError, "declined"),
        (INTERRUPTED, None, KeyboardInterrupt, None),
        (jointctl.MotionFault.exit_code, Ended(), jointctl.MotionFault, "FOLLOWING_ERROR"),
        (1, None, jointctl.JointctlError, "exit code 1"),
    ],
)
def test_an_exit_code_that_no_result_explains_is_an_exception(
    monkeypatch: pytest.MonkeyPatch, code: int, result: object, kind: type[BaseException], words: str | None
) -> None:
    def stop(output: ResultOutput) -> int:
        output.result("", None, result)
        return code

    monkeypatch.setattr(import_module("jointctl.tools.verbs.stop"), "stop", stop)
    with pytest.raises(kind, match=words):
        verbs._function("stop")()


def test_identify_gives_the_model_and_writes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "sweep.csv"
    speeds_degps = np.concatenate([s * np.geomspace(0.5, 60.0, 40) for s in (1.0, -1.0)])
    shape = 10.0 + 4.0 * np.exp(-((speeds_degps / 5.0) ** 2)) + 0.1 * np.abs(speeds_degps)
    rows = "\n".join(f"{v:.6f},{t:.8f}" for v, t in zip(speeds_degps, np.sign(speeds_degps) * shape, strict=True))
    path.write_text(f"speed,torque\n{rows}\n")
    table = {
        "velocity_column": "speed", "torque_column": "torque", "velocity_unit": "deg/s", "side": "joint",
        "torque_side": "joint", "ratio": 100.0,
    }  # fmt: skip
    found = jointctl.identify(path, table=table, model="stribeck")
    assert found.model == "stribeck"
    assert found.rmse_Nm < 5e-3
    assert [p.name for p in tmp_path.iterdir()] == ["sweep.csv"]
    with pytest.raises(jointctl.DataError, match="speed"):
        jointctl.identify(path)


def test_a_log_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"no log")
    with pytest.raises(jointctl.DataError, match="is not an MCAP file"):
        jointctl.read_log(tmp_path / "x.mcap")

"""Fixtures that several folders share, and Ctrl-C for what the tests start."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command sets it; before numpy

import copy
import dataclasses
import functools
import gc
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests import plain_records

if os.environ.get("NUMBA_DISABLE_JIT") == "1":
    plain_records.use()

from jointctl.drivers import stop_note
from jointctl.drivers.canopen import drive as drive_module
from jointctl.drivers.canopen import encoder as encoder_module
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.hil.canopen import dictionary, encoder_node
from jointctl.tools import drawing
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.load import load_config
from jointctl.tools.recording import report_page
from jointctl.tools.verbs import main as main_module
from jointctl.tools.virtual_joint import new_device
from tests.axis_on_stub_joint import Rig, small_axis_constants
from tests.device_on_bus import DeviceOnBus
from tests.page_figures import NO_PICTURE
from tests.places import CONFIGS, ROOT
from tests.python_process import Finished
from tests.tiers import tier_of

# no example is judged by the clock, so that none fails on a busy computer
settings.register_profile("no clock", deadline=None, suppress_health_check=[*HealthCheck])
settings.load_profile("no clock")


def read_once(read: Callable[..., Any]) -> Callable[..., Any]:
    """A shipped EDS file is read once, which takes most of the time that it takes to begin with a (virtual) drive."""
    of_shipped = functools.cache(read)

    def reading(path: Path, node: int, **more: bool) -> Any:
        return copy.copy((of_shipped if path.parent.resolve() == CONFIGS else read)(path, node, **more))

    return reading


dictionary.load_entries = encoder_node.load_entries = read_once(dictionary.load_entries)
drive_module.read_eds = encoder_module.read_eds = read_once(drive_module.read_eds)


def pytest_configure() -> None:
    """Ctrl-C reaches what the tests start, although `nohup` or `&` makes a shell start pytest with SIGINT ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("COLUMNS", "LINES"):  # readline gives them to processes that a test process starts
        os.environ.pop(name, None)
    gc.set_threshold(50_000, 20, 10)  # a tenth of the time of tests went into it
    os.nice = lambda _: 0  # what one test tries would slow down all that follow in its process
    os.environ["JOINTCTL_TRACEBACK"] = "1"  # what no one has foreseen is to be seen in what the tests start


def pytest_collection_finish() -> None:
    """What is loaded by now stays: no collection looks at it again, which took a tenth of a second each time."""
    gc.collect()
    gc.freeze()


def pytest_xdist_auto_num_workers() -> int:
    """Some tests wait: three at once on two cores."""
    return 3 * (os.cpu_count() or 1) // 2


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Each test gets the marker of its folder, before -m chooses; `slow` tells why.

    Files are handed out to processes in this order: a long one at the end would be waited for by one core.  So those
    with a slow test come first, and in real time, where a test takes some seconds whichever it is, those with many.
    In a file the slow ones come first: a process gets its next file when it has begun the last test but one.
    """
    in_real_time: Counter[Path] = Counter()
    for item in items:
        tier = tier_of(item.path.relative_to(ROOT / "tests"))
        if tier is not None:
            item.add_marker(tier)
            in_real_time[item.path] += 1
        for mark in item.iter_markers("slow"):
            if not (len(mark.args) == 1 and isinstance(mark.args[0], str)):
                raise pytest.UsageError(f"{item.nodeid}: pytest.mark.slow needs its reason")
    slow = {item: item.get_closest_marker("slow") is not None for item in items}
    with_slow = {item.path for item in items if slow[item]}
    items.sort(key=lambda item: (item.path not in with_slow, -in_real_time[item.path], item.path, not slow[item]))


@pytest.fixture(scope="session", autouse=True)
def notes_of_stops(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Of this process alone: stops of another one that tests the same bus mean nothing here."""
    stop_note.FOLDER = tmp_path_factory.mktemp("stops")


@pytest.fixture
def axis_constants() -> Any:
    """A record array of one `AxisConstants`."""
    return small_axis_constants()


@pytest.fixture
def rig() -> Callable[..., Rig]:
    """Builds an axis on a stub joint: `rig(position_rad)`."""
    return Rig


@pytest.fixture
def device_on_bus() -> Iterator[DeviceOnBus]:
    """The virtual joint of configs/virtual.toml on a bus of its own."""
    with DeviceOnBus(new_device(load_config(CONFIGS / "virtual.toml"))) as device:
        yield device


@pytest.fixture
def settings_of_virtual_joint() -> CanopenSettings:
    """What configs/virtual.toml tells the driver; it waits for nobody for long."""
    return dataclasses.replace(canopen_settings(load_config(CONFIGS / "virtual.toml")), boot_timeout_s=0.2)


@pytest.fixture
def joint(device_on_bus: DeviceOnBus, settings_of_virtual_joint: CanopenSettings) -> DeviceOnBus:
    """The same; `joint.opened()` is the real driver on it."""
    device_on_bus.settings = settings_of_virtual_joint
    return device_on_bus


@pytest.fixture
def empty_bus(settings_of_virtual_joint: CanopenSettings) -> Iterator[DeviceOnBus]:
    """A bus on which no one answers."""
    with DeviceOnBus(None, settings_of_virtual_joint) as device:
        yield device


@pytest.fixture
def virtual_config() -> Any:
    """configs/virtual.toml."""
    return load_config(CONFIGS / "virtual.toml")


@pytest.fixture
def undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made but not drawn, which takes nine tenths of their time: each picture is an empty one.

    For the tests of a module that are not marked `draws`.
    """

    def save(_: object, target: Any, **how: Any) -> None:
        target.write(NO_PICTURE[how["format"]])

    if request.node.get_closest_marker("draws") is None:
        for module in (drawing, report_page):
            monkeypatch.setattr(module, "save_figure", save)


@pytest.fixture
def main_in_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """`main` leaves the streams and the end of the test's process alone."""
    for name in ("occupy_standard_streams", "never_refuse_a_character", "_start_quickly"):
        monkeypatch.setattr(main_module, name, lambda: None)
    monkeypatch.setattr(main_module.atexit, "register", lambda *_: None)


@pytest.fixture
def jointctl(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], main_in_test: None
) -> Callable[..., Finished]:
    """`jointctl WORDS` in the process of the test: for what ends before it starts another one."""

    def run(*words: str) -> Finished:
        monkeypatch.setattr(sys, "argv", ["jointctl", *words])
        with pytest.raises(SystemExit) as ended:
            main_module.main()
        code = ended.value.code
        assert isinstance(code, int)
        return Finished(code, *capsys.readouterr())

    return run

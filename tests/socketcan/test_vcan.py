"""The whole chain on a real SocketCAN interface: virtual joint and controller as separate processes on vcan0."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest
import tomlkit

from jointctl.drivers.can.open import open_cyclic_end
from jointctl.drivers.errors import BusError
from jointctl.tools.recording.run_log_reader import read_run_log
from tests.configurations import set_keys, written
from tests.python_process import Finished
from tests.started import Started

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "virtual.toml"
ON_VCAN = ("-i", "socketcan", "-c", "vcan0")
# A slow guest may need some periods for a cycle, and now and then stand still: gains that do not mind a late command,
# and limits that do not mind a pause.  This is about the bus; timing is measured elsewhere.  Its only processor is
# shared fairly: a loop with SCHED_FIFO that takes all of it starves its supervisor, which the loop then stops for.
GENTLE = {
    "control.kp": 64.0, "control.kv": 16.0, "control.lyapunov_q": 20.0,
    "limits.sample_age_max_s": 0.5, "limits.skipped_max_s": 0.5, "limits.following_error_max_rad": 0.3,
    # the guest has one processor: an answer that waited while it stood still seems to belong to the next SYNC
    "limits.position_jump_max_rad": 0.1, "limits.velocity_max_radps": 5.0,
    "sequence.supervisor_timeout_s": 5.0, "sequence.wait_timeout_s": 30.0, "drive.heartbeat_s": 0.6,
    "log.picture": False, "loop.priority": None, "sequence.settle_s": 0.005,
}  # fmt: skip
# as the driver of a controller makes it
ERROR_PASSIVE = "20000004#0020000000008000"
ERROR_PASSIVE_TEXT = "error passive (transmit); transmit errors 128"
SLOW_GUEST = ("-y", "--allow-low-margin")


@pytest.fixture
def interface() -> Iterator[None]:
    """vcan0 up before and after."""
    subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
    yield
    subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)


@pytest.fixture
def rate_Hz() -> float:
    """Half the system calls, so that the other programs of a test get their turn on the only processor."""
    return 500.0


@pytest.fixture
def duration_s() -> float:
    return 4.0


@pytest.fixture
def config(tmp_path: Path, rate_Hz: float, duration_s: float) -> str:
    changes = GENTLE | {"loop.rate_Hz": rate_Hz, "trajectory.duration_s": duration_s}
    return written(tmp_path / "joint.toml", **{path.replace(".", "__"): value for path, value in changes.items()}).name


@pytest.fixture
def joint(tmp_path: Path, config: str, interface: None) -> Iterator[None]:
    """`jointctl hil` on vcan0."""
    with started(tmp_path, "hil", config, *ON_VCAN) as process:
        process.saw("Ctrl-C ends it")
        yield
        process.signal(signal.SIGTERM)
        process.finished(20.0)


@contextmanager
def started(folder: Path, *arguments: str) -> Iterator[Started]:
    """A command, killed at the end where it still runs."""
    process = Started(folder, arguments)
    try:
        yield process
    finally:
        process.end()


def ended(dump: subprocess.Popen[str]) -> list[str]:
    """Ends candump; its lines.  A SIGTERM that comes just before it waits for a frame is only seen at the next one."""
    while True:
        dump.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            return dump.communicate(timeout=0.5)[0].splitlines()


@contextmanager
def candump(*what: str) -> Iterator[subprocess.Popen[str]]:
    """`candump -L` of these, killed at the end: what fails meanwhile would wait for it for ever."""
    with subprocess.Popen(["candump", "-L", *what], stdout=subprocess.PIPE, text=True) as dump:
        try:
            yield dump
        finally:
            dump.kill()


@contextmanager
def tracking(folder: Path, config: str, *, interface: tuple[str, ...] = ON_VCAN) -> Iterator[Started]:
    """A `jointctl run` that has reached its trajectory."""
    with started(folder, "run", config, *interface, *SLOW_GUEST) as process:
        yield process.saw("tracking")


def run(folder: Path, *arguments: str) -> Finished:
    with started(folder, *arguments) as process:
        done = process.finished(300.0)
    assert "Traceback" not in done.err, done.err
    return done


@pytest.mark.parametrize("rate_Hz", [1000.0])
@pytest.mark.usefixtures("joint")
def test_a_run_at_1_khz(tmp_path: Path, config: str) -> None:
    done = run(tmp_path, "run", config, *ON_VCAN, *SLOW_GUEST)
    assert done.code == 0, done.err
    log = read_run_log(next((tmp_path / "runs").glob("*.mcap")))
    tracking = log.records[log.records.phase == 3]
    assert len(tracking) > 1000
    assert abs(tracking.error_rad).max() < 0.05


@pytest.mark.usefixtures("joint")
def test_candump_sees_the_run_and_cansend_can_stop_it(tmp_path: Path, config: str) -> None:
    assert shutil.which("candump"), "can-utils must be installed"
    with candump("vcan0") as dump:
        with tracking(tmp_path, config) as moving:
            subprocess.run(["cansend", "vcan0", "000#8001"], check=True)  # NMT: pre-operational, from somebody else
            assert moving.finished(60.0).code == 7
        lines = ended(dump)
    identifiers = {line.split()[2].split("#")[0] for line in lines}
    assert {"080", "181", "201", "77E", "601", "581"} <= identifiers


# --- a stop, and other controllers ---
def drive_state(folder: Path, node: int = 1, channel: str = "vcan0") -> str:
    info = run(folder, "info", "-i", "socketcan", "-c", channel, "-t", str(node), "--json")
    return str(json.loads(info.out)["state"]["drive_state"])


@pytest.mark.usefixtures("joint")
def test_a_stop_in_the_motion_ends_the_run(tmp_path: Path, config: str) -> None:
    with tracking(tmp_path, config) as moving:
        stopped = run(tmp_path, "stop", config, *ON_VCAN)
        assert stopped.code == 0, stopped.err
        done = moving.finished(60.0)
    assert done.code == 130, done.err
    assert "jointctl stop" in done.err
    assert drive_state(tmp_path) == "switch on disabled"


@pytest.mark.parametrize("after_s", [0.3, 1.0, 2.0, 3.0])  # some four until it moves
@pytest.mark.usefixtures("joint")
def test_a_stop_before_the_motion_is_final(tmp_path: Path, config: str, after_s: float) -> None:
    """The program was starting, listening, or commissioning the drive: it ends, and no frame enables afterwards."""
    with candump("vcan0,201:7FF") as dump:
        with started(tmp_path, "run", config, *ON_VCAN, *SLOW_GUEST) as starting:
            time.sleep(after_s)
            stopped = run(tmp_path, "stop", config, *ON_VCAN)
            ended_s = time.time()
            assert stopped.code == 0, stopped.err
            done = starting.finished(60.0)
            assert done.code == 130, done.err
        time.sleep(1.0)
        lines = ended(dump)
    commands = [(float(line.split()[0].strip("()")), line.split("#")[1][:4]) for line in lines]
    assert not [command for time_s, command in commands if time_s > ended_s and command == "0F00"]
    assert drive_state(tmp_path) == "switch on disabled"


@pytest.mark.usefixtures("joint")
def test_a_joint_that_another_master_commands_is_left_alone(tmp_path: Path, config: str) -> None:
    """SYNC every 20 ms: nothing is sent, which candump sees."""
    sync = ["cangen", "vcan0", "-g", "20", "-I", "080", "-L", "0"]
    with subprocess.Popen(sync) as foreign, candump("vcan0,080~7FF") as dump:
        try:
            refused = run(tmp_path, "run", config, *ON_VCAN, *SLOW_GUEST)
        finally:
            foreign.terminate()
        others = {line.split()[2].split("#")[0] for line in ended(dump)}
    assert refused.code == 4, refused.err
    assert "SYNC" in refused.err
    assert others <= {"701"}  # the drive's own heartbeat


@pytest.mark.usefixtures("interface")
def test_an_arm_on_two_interfaces_moves_and_stops_as_one(tmp_path: Path) -> None:
    """Shoulder and elbow on vcan0, the wrist with the shoulder's node on vcan1."""
    if not Path("/sys/class/net/vcan1").exists():
        pytest.skip("no vcan1 beside vcan0")
    folder = tmp_path / "arm"
    shutil.copytree(CONFIG.parent / "arm", folder)
    urdf = folder / "arm.urdf"
    urdf.write_text(re.sub(r'velocity="[\d.]+"', 'velocity="20"', urdf.read_text()))
    for path in folder.glob("*.toml"):
        document = tomlkit.parse(path.read_text())
        if "arm" in document:
            set_keys(document, motion__duration_s=30.0)
        else:
            own = GENTLE | {
                "loop.rate_Hz": 250.0, "control.velocity_cutoff_Hz": 60.0, "limits.velocity_max_radps": 20.0,
                "bus.interface": "socketcan", "bus.channel": "vcan0",
            }  # fmt: skip
            if path.stem == "wrist":
                own |= {"bus.channel": "vcan1", "drive.node": 1}
            set_keys(document, **{key.replace(".", "__"): value for key, value in own.items()})
        path.write_text(tomlkit.dumps(document))
    with started(tmp_path, "hil", "arm/arm.toml") as drives:
        drives.saw("Ctrl-C ends it")
        with tracking(tmp_path, "arm/arm.toml", interface=()) as moving:
            stopped = run(tmp_path, "stop", "arm/wrist.toml")
            assert stopped.code == 0, stopped.err
            done = moving.finished(60.0)
            assert done.code == 130, done.err
        states = [drive_state(tmp_path, node, channel) for node, channel in ((1, "vcan0"), (2, "vcan0"), (1, "vcan1"))]
        assert states == ["switch on disabled"] * 3


@pytest.mark.usefixtures("joint")
def test_an_interface_that_goes_down_in_the_run_stops_the_joint(tmp_path: Path, config: str) -> None:
    with tracking(tmp_path, config) as moving:
        subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
        done = moving.finished(60.0)
    assert done.code == 7
    rest = done.err
    assert "Traceback" not in rest
    assert "error:" in rest
    assert "vcan0" in rest
    assert "ip link set vcan0 up" in rest
    # the drive is alone now: its own watchdog has switched it off, as the next commissioning finds
    subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
    time.sleep(0.5)
    stopped = run(tmp_path, "stop", config, *ON_VCAN)
    assert stopped.code == 0, stopped.err


@pytest.mark.usefixtures("interface")
def test_interface_problems_are_told_with_their_cure(tmp_path: Path, config: str) -> None:
    missing = run(tmp_path, "run", config, "-i", "socketcan", "-c", "can7", "-y")
    assert missing.code == 4
    assert "can7" in missing.err
    assert "ip link set can7 up" in missing.err
    subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
    down = run(tmp_path, "run", config, *ON_VCAN, *SLOW_GUEST)
    assert down.code == 4
    assert "vcan0 is down" in down.err


@pytest.mark.usefixtures("interface")
def test_nobody_on_the_bus(tmp_path: Path, config: str) -> None:
    alone = run(tmp_path, "run", config, *ON_VCAN, *SLOW_GUEST)
    assert alone.code == 5, alone.err
    assert "does not answer" in alone.err


@pytest.mark.usefixtures("interface")
def test_the_cyclic_end_is_non_blocking_and_shares_the_bus_with_python_can() -> None:
    with open_cyclic_end("socketcan", "vcan0") as end, can.Bus(interface="socketcan", channel="vcan0") as bus:
        assert not os.get_blocking(end.fileno())
        bus.send(can.Message(arbitration_id=0x123, data=b"\x01\x02", is_extended_id=False))
        time.sleep(0.05)
        frame = end.recv(16)
        assert (int.from_bytes(frame[:4], "little"), frame[4], frame[8:10]) == (0x123, 2, b"\x01\x02")
    with pytest.raises(BusError, match="can9"):
        open_cyclic_end("socketcan", "can9")


# --- what looks at the bus ---
@pytest.mark.usefixtures("joint")
def test_scan_info_and_monitor(tmp_path: Path) -> None:
    found = run(tmp_path, "scan", *ON_VCAN, "--json", "--listen", "0.2")
    assert found.code == 0, found.err
    assert [node["node"] for node in json.loads(found.out)["nodes"]] == [1]
    info = run(tmp_path, "info", *ON_VCAN, "-t", "1", "--json")
    assert json.loads(info.out)["state"]["drive_state"] == "switch on disabled"
    with started(tmp_path, "monitor", *ON_VCAN, "--count", "2", "--json") as monitor:
        monitor.saw("listening on")
        subprocess.run(["cansend", "vcan0", "705#7F"], check=True)
        subprocess.run(["cansend", "vcan0", ERROR_PASSIVE], check=True)
        out = monitor.finished(60.0).out
    first, second = (json.loads(line) for line in out.splitlines())
    assert (first["kind"], first["text"]) == ("heartbeat", "pre-operational")
    assert (second["kind"], second["text"]) == ("error", ERROR_PASSIVE_TEXT + ", receive errors 0")


@pytest.mark.parametrize("duration_s", [10.0])  # time for the program that sends the complaint
@pytest.mark.usefixtures("joint")
def test_a_run_beside_foreign_traffic_tells_what_the_controller_complains_about(tmp_path: Path, config: str) -> None:
    with subprocess.Popen(["cangen", "vcan0", "-g", "5", "-I", "500", "-L", "8"]) as foreign:
        try:
            with tracking(tmp_path, config) as moving:
                subprocess.run(["cansend", "vcan0", ERROR_PASSIVE], check=True)
                done = moving.finished(60.0)
                assert done.code == 0, done.err
        finally:
            foreign.terminate()
    assert ERROR_PASSIVE_TEXT in done.err
    assert "power of the drive" in done.err


@pytest.mark.usefixtures("joint")
def test_a_full_transmit_queue_stops_the_joint_and_is_told(tmp_path: Path, config: str) -> None:
    """A queue that lets next to nothing out fills up, as that of a controller whose frames nobody acknowledges."""
    slow = ["qdisc", "add", "dev", "vcan0", "root", "tbf", "rate", "8kbit", "burst", "32", "limit", "64"]
    with tracking(tmp_path, config) as moving:
        subprocess.run(["tc", *slow], check=True)
        try:
            done = moving.finished(60.0)
            assert done.code == 7, done.err
        finally:
            subprocess.run(["tc", "qdisc", "del", "dev", "vcan0", "root"], check=True)
    assert "Traceback" not in done.err
    assert "transmit queue of vcan0 is full" in done.err
    assert "txqueuelen" in done.err


@pytest.mark.usefixtures("joint")
def test_a_sweep(tmp_path: Path, config: str) -> None:
    (tmp_path / "speeds").write_text("0.2\n-0.2\n")
    options = ("--grid", "list", "--speeds", "speeds", "--warm-up", "0", "--dwell", "0.2", "-o", "friction.csv")
    done = run(tmp_path, "sweep", config, *ON_VCAN, *SLOW_GUEST, *options)
    assert done.code == 0, done.err
    assert len((tmp_path / "friction.csv").read_text().splitlines()) >= 3


@pytest.mark.usefixtures("interface")
def test_doctor_tells_the_state_of_the_interface(tmp_path: Path, config: str) -> None:
    subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
    down = run(tmp_path, "doctor", config, *ON_VCAN, "--json")
    (found,) = [item for item in json.loads(down.out)["findings"] if item["topic"] == "interface"]
    assert (down.code, found["status"]) == (1, "problem")
    assert "vcan0 is down" in found["text"]
    assert "ip link set vcan0 up" in found["remedy"]

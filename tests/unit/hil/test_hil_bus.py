"""The hub itself: socket file, life cycle, counters."""

from __future__ import annotations

import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from jointctl.firmware_py.schema import new
from jointctl.hil.bus.timing import frame_bits
from jointctl.hil.bus.virtual_bus import (
    MAX_CLIENTS,
    VirtualBusError,
    VirtualBusHub,
    WireFrame,
    default_socket_path,
    remove_dead_sockets,
)

FRAME = b"\x81\x01\x00\x00\x08\x00\x00\x00" + bytes(range(8))


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("b") / "bus.sock"


def join(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.settimeout(10.0)
    client.connect(str(path))
    return client


def eventually(condition: Callable[[], bool]) -> None:
    limit_s = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < limit_s
        time.sleep(0.001)


def test_counters(path: Path) -> None:
    with VirtualBusHub(path, bitrate_bitps=500_000) as hub, join(path) as a, join(path) as b:
        for _ in range(10):
            a.send(FRAME)
            assert b.recv(64) == FRAME
        record = new(WireFrame)
        record["identifier"], record["length"], record["payload"] = 0x181, 8, range(8)
        bits = 10 * frame_bits(record, 0)
        eventually(lambda: hub.counters["frames"] == 10)
        counters = hub.counters
        assert (counters["bits"], counters["busy_ns"]) == (bits, bits * 2000)
        assert (counters["clients"], counters["accepted"], counters["refused"]) == (2, 2, 0)
        assert (counters["dropped"], counters["malformed"]) == (0, 0)
        assert list(hub.client_counters["sent"]) == [10, 0]
        assert list(hub.client_counters["delivered"]) == [0, 10]


def test_the_socket_is_for_this_user_and_goes_with_the_hub(path: Path) -> None:
    hub = VirtualBusHub(path).start()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    hub.stop()
    hub.stop()
    assert list(path.parent.iterdir()) == []
    with hub, join(path) as a, join(path) as b:  # a hub can be started again
        a.send(FRAME)
        assert b.recv(64) == FRAME


def test_a_live_hub_is_a_clear_error_and_stays_alive(path: Path) -> None:
    with VirtualBusHub(path):
        with pytest.raises(VirtualBusError, match=r"a virtual bus already runs at .*bus\.sock"):
            VirtualBusHub(path).start()
        with join(path) as a, join(path) as b:
            a.send(FRAME)
            assert b.recv(64) == FRAME


def test_the_socket_of_a_killed_hub_is_replaced(path: Path) -> None:
    program = (
        "import sys; from jointctl.hil.bus.virtual_bus import VirtualBusHub as Hub; "
        "Hub(sys.argv[1]).start(); print('up', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        with pytest.raises(VirtualBusError, match="already runs"):
            VirtualBusHub(path).start()
        process.kill()
        process.wait()
    assert path.is_socket()
    with VirtualBusHub(path), join(path) as a, join(path) as b:
        a.send(FRAME)
        assert b.recv(64) == FRAME
        assert remove_dead_sockets(path.parent) == 0
    assert list(path.parent.iterdir()) == []


def test_what_killed_hubs_left_is_removed_and_what_lives_stays(tmp_path: Path) -> None:
    for name in ("demo-1", "demo-2"):
        (tmp_path / f"{name}.sock.lock").touch()
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
            dead.bind(str(tmp_path / f"{name}.sock"))
    (tmp_path / "notes.lock").touch()
    with VirtualBusHub(tmp_path / "live.sock"), join(tmp_path / "live.sock") as a, join(tmp_path / "live.sock") as b:
        assert remove_dead_sockets(tmp_path) == 2
        assert sorted(path.name for path in tmp_path.iterdir()) == ["live.sock", "live.sock.lock", "notes.lock"]
        a.send(FRAME)
        assert b.recv(64) == FRAME


def test_two_hubs_never_share_a_name_while_others_come_and_go(path: Path) -> None:
    """Many threads start and stop a hub of one name: each start either works alone or is refused."""
    running, worst, refused = [0], [0], [0]

    def come_and_go() -> None:
        for _ in range(10):
            hub = VirtualBusHub(path)
            try:
                hub.start()
            except VirtualBusError:
                refused[0] += 1
                continue
            running[0] += 1
            worst[0] = max(worst[0], running[0])
            running[0] -= 1
            hub.stop()

    threads = [threading.Thread(target=come_and_go) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert worst[0] == 1
    assert refused[0] < 40
    assert list(path.parent.iterdir()) == []


def test_a_file_that_is_no_socket_is_not_removed(path: Path) -> None:
    path.write_text("precious")
    with pytest.raises(VirtualBusError, match="cannot listen at"):
        VirtualBusHub(path).start()
    assert path.read_text() == "precious"


def test_clients_up_to_the_limit_and_one_more(path: Path) -> None:
    with VirtualBusHub(path) as hub:
        clients = [join(path) for _ in range(MAX_CLIENTS)]
        eventually(lambda: hub.counters["clients"] == MAX_CLIENTS)
        with join(path) as refused:
            assert refused.recv(64) == b""
        assert hub.counters["refused"] == 1
        clients[0].send(FRAME)
        assert all(client.recv(64) == FRAME for client in clients[1:])
        clients.pop().close()
        eventually(lambda: hub.counters["clients"] == MAX_CLIENTS - 1)
        clients.append(join(path))
        clients[0].send(FRAME)
        assert all(client.recv(64) == FRAME for client in clients[1:])
        for client in clients:
            client.close()


def test_a_client_that_only_ends_its_sending_is_removed(path: Path) -> None:
    with VirtualBusHub(path) as hub, join(path) as a, join(path) as b:
        a.send(FRAME)
        a.shutdown(socket.SHUT_WR)
        assert b.recv(64) == FRAME
        eventually(lambda: hub.counters["clients"] == 1)
        assert hub.counters["malformed"] == 0


def test_frames_of_a_dead_client_still_get_their_time_on_the_wire(path: Path) -> None:
    with VirtualBusHub(path, bitrate_bitps=100_000, timing=True) as hub, join(path) as b:
        with join(path) as a:
            for number in range(80):  # more than a queue in the hub holds
                a.send(bytes([number]) + bytes(15))
        assert [b.recv(64)[0] for _ in range(80)] == list(range(80))
        eventually(lambda: hub.counters["clients"] == 1)


def test_the_folder_of_the_default_path(monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(path.parent))
    own = default_socket_path("vcan")
    with VirtualBusHub(own):
        assert stat.S_IMODE(own.parent.stat().st_mode) == 0o700
    own.parent.chmod(0o755)
    with pytest.raises(VirtualBusError, match="mode 0700"):
        VirtualBusHub(own).start()


@pytest.mark.parametrize("bitrate", [999, 1_000_001])
def test_bad_bitrate(path: Path, bitrate: int) -> None:
    with pytest.raises(VirtualBusError, match=rf"bitrate_bitps \(={bitrate}\) must be in \[1000..1000000\]"):
        VirtualBusHub(path, bitrate_bitps=bitrate)


def test_bad_paths(path: Path) -> None:
    VirtualBusHub("x" * 107)
    with pytest.raises(VirtualBusError, match="at most 107 bytes"):
        VirtualBusHub("x" * 108)
    with pytest.raises(VirtualBusError, match="must exist"):
        VirtualBusHub(path.parent / "missing" / "bus.sock").start()

"""The virtual bus: exact frame lengths and arbitration, and the hub with its socket file."""

from __future__ import annotations

import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.firmware_py.schema import new
from jointctl.hil.bus_timing import (
    EXTENDED,
    NO_NODE,
    REMOTE,
    Waiting,
    Wire,
    arbitration_key,
    crc15_step,
    finish_frame,
    frame_bits,
    pend_frame,
)
from jointctl.hil.virtual_bus import (
    MAX_CLIENTS,
    VirtualBusError,
    VirtualBusHub,
    WireFrame,
    default_socket_path,
    remove_dead_sockets,
)
from tests.python_process import eventually

# --- Exact frame lengths and the arbitration of the virtual bus, with the time as an argument ---
STANDARD_BITS, EXTENDED_BITS = 47, 67  # of a frame without data and stuff bits, interframe space included


def wire_frame(identifier: int, payload: bytes = b"") -> Any:
    frame = new(WireFrame)
    frame["identifier"][0] = identifier
    frame["length"][0] = len(payload)
    frame["payload"][0, : len(payload)] = list(payload)
    return frame


def bits_by_text(identifier: int, payload: bytes) -> int:
    """The same length by another way: the frame as a text of bits, the CRC by polynomial division."""
    length = f"{len(payload):04b}"
    remote = "1" if identifier & REMOTE else "0"
    if identifier & EXTENDED:
        number = f"{identifier & 0x1FFFFFFF:029b}"
        text = "0" + number[:11] + "11" + number[11:] + remote + "00" + length
    else:
        text = "0" + f"{identifier & 0x7FF:011b}" + remote + "00" + length
    if remote == "0":
        text += "".join(f"{byte:08b}" for byte in payload)
    remainder = int(text, 2) << 15
    for position in range(len(text) - 1, -1, -1):
        if remainder >> (position + 15) & 1:
            remainder ^= 0xC599 << position
    text += f"{remainder:015b}"
    stuffed = ""
    for bit in text:
        stuffed += bit
        if stuffed.endswith(("00000", "11111")):
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed) + 13


def test_crc_has_the_published_check_value() -> None:
    crc = 0
    for byte in b"123456789":
        for shift in range(7, -1, -1):
            crc = crc15_step(crc, (byte >> shift) & 1)
    assert crc == 0x059E  # CRC-15/CAN in the catalogue of parametrised CRC algorithms


@pytest.mark.parametrize(("flag", "least"), [(0, STANDARD_BITS), (EXTENDED, EXTENDED_BITS)])
@settings(max_examples=300)
@given(identifier=st.integers(0, 0x1FFFFFFF), remote=st.booleans(), payload=st.binary(max_size=8))
def test_frames_have_the_exact_length(flag: int, least: int, identifier: int, remote: bool, payload: bytes) -> None:
    word = (identifier if flag else identifier & 0x7FF) | flag | (REMOTE if remote else 0)
    bits = frame_bits(wire_frame(word, payload))
    assert bits == bits_by_text(word, payload)
    carried = 0 if remote else len(payload)
    stuffed = least - 13 + 8 * carried  # without CRC delimiter, acknowledge, end and interframe space
    assert least + 8 * carried <= bits <= least + 8 * carried + (stuffed - 1) // 4


def test_arbitration_order() -> None:
    base = 0x123
    ordered = [
        0, base - 1, base, base | REMOTE, EXTENDED | base << 18, EXTENDED | REMOTE | base << 18,
        EXTENDED | base << 18 | 1, base + 1, 0x7FF, EXTENDED | 0x1FFFFFFF,
    ]  # fmt: skip
    keys = [arbitration_key(identifier) for identifier in ordered]
    assert keys == sorted(keys)
    assert len(set(keys)) == len(keys)


class Timeline:
    """Three nodes with queues of two frames at 1 Mbit/s: 1 bit is 1000 ns."""

    def __init__(self) -> None:
        self.wire = new(Wire)
        self.wire["bitrate_bitps"] = 1_000_000
        self.wire["sender"] = NO_NODE
        self.queues = Waiting(new(WireFrame, 6), np.zeros(6, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64))
        self.on_wire, self.finished = new(WireFrame), new(WireFrame)

    def pend(self, node: int, identifier: int, now_ns: int) -> bool:
        return bool(pend_frame(wire_frame(identifier), node, now_ns, self.queues))

    def finish(self, now_ns: int) -> tuple[int, int] | None:
        sender = finish_frame(self.wire, now_ns, self.queues, self.on_wire, self.finished)
        return None if sender == NO_NODE else (sender, int(self.finished["identifier"][0]))


def test_a_frame_is_there_when_its_last_bit_is_over() -> None:
    bus = Timeline()
    bus.pend(0, 0x155, 5000)
    over_ns = 5000 + (frame_bits(wire_frame(0x155)) - 3) * 1000
    assert bus.finish(5000) is None
    assert bus.finish(over_ns - 1) is None
    assert bus.finish(over_ns) == (0, 0x155)
    assert bus.finish(over_ns + 10**9) is None


def test_the_lowest_waiting_identifier_wins_and_none_is_interrupted() -> None:
    bus = Timeline()
    bus.pend(0, 0x700, 0)
    assert bus.finish(0) is None  # 0x700 is on the wire
    bus.pend(1, 0x600, 10_000)
    bus.pend(2, 0x100, 20_000)
    seen = [bus.finish(10**9) for _ in range(4)]
    assert seen == [(0, 0x700), (2, 0x100), (1, 0x600), None]


def test_back_to_back_frames_are_three_bits_apart_even_after_a_late_wake_up() -> None:
    bus = Timeline()
    bus.pend(0, 0x155, 0)
    bus.pend(0, 0x2AA, 0)
    first = frame_bits(wire_frame(0x155)) * 1000
    second = frame_bits(wire_frame(0x2AA)) * 1000
    assert bus.finish(first + second - 3001) == (0, 0x155)
    assert bus.finish(first + second - 3001) is None
    assert bus.finish(first + second - 3000) == (0, 0x2AA)


def test_a_frame_that_came_later_does_not_take_part_in_an_earlier_arbitration() -> None:
    bus = Timeline()
    bus.pend(0, 0x700, 0)
    bus.pend(1, 0x001, 1)
    assert [bus.finish(10**9), bus.finish(10**9)] == [(0, 0x700), (1, 0x001)]
    twin = Timeline()
    twin.pend(0, 0x700, 1)
    twin.pend(1, 0x001, 1)
    assert [twin.finish(10**9), twin.finish(10**9)] == [(1, 0x001), (0, 0x700)]


def test_queues_are_first_in_first_out_and_bounded() -> None:
    bus = Timeline()
    assert [bus.pend(0, identifier, 0) for identifier in (0x300, 0x200, 0x100)] == [True, True, False]
    assert [bus.finish(10**9) for _ in range(3)] == [(0, 0x300), (0, 0x200), None]
    assert bus.pend(0, 0x100, 0)


@pytest.mark.parametrize("bitrate", [125_000, 500_000])
def test_lower_bit_rates_take_longer(bitrate: int) -> None:
    bus = Timeline()
    bus.wire["bitrate_bitps"] = bitrate
    bus.pend(0, 0x155, 0)
    over_ns = (frame_bits(wire_frame(0x155)) - 3) * (10**9 // bitrate)
    assert bus.finish(over_ns - 1) is None
    assert bus.finish(over_ns) == (0, 0x155)


# --- The hub itself: socket file, life cycle, counters ---
# an SDO request: the hub passes it on as it is (SYNC, PDOs and heartbeats are stamped)
FRAME = b"\x01\x06\x00\x00\x08\x00\x00\x00" + bytes(range(8))


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("b") / "bus.sock"


def join(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.settimeout(10.0)
    client.connect(str(path))
    return client


def assert_passes_frames(path: Path) -> None:
    with join(path) as a, join(path) as b:
        a.send(FRAME)
        assert b.recv(64) == FRAME


def test_the_socket_is_for_this_user_and_goes_with_the_hub(path: Path) -> None:
    hub = VirtualBusHub(path).start()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    hub.stop()
    hub.stop()
    assert list(path.parent.iterdir()) == []
    with hub:  # a hub can be started again
        assert_passes_frames(path)


def test_a_live_hub_is_a_clear_error_and_stays_alive(path: Path) -> None:
    with VirtualBusHub(path):
        with pytest.raises(VirtualBusError, match=r"a virtual bus already runs at .*bus\.sock"):
            VirtualBusHub(path).start()
        assert_passes_frames(path)


def test_the_socket_of_a_killed_hub_is_replaced(path: Path) -> None:
    program = (
        "import sys; from jointctl.hil.virtual_bus import VirtualBusHub as Hub; "
        "Hub(sys.argv[1]).start(); print('up', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"up\n"
        with pytest.raises(VirtualBusError, match="already runs"):
            VirtualBusHub(path).start()
        process.kill()
        process.wait()
    assert path.is_socket()
    with VirtualBusHub(path):
        assert_passes_frames(path)
        assert remove_dead_sockets(path.parent) == 0
    assert list(path.parent.iterdir()) == []


def test_what_killed_hubs_left_is_removed_and_what_lives_stays(tmp_path: Path) -> None:
    for name in ("demo-1", "demo-2"):
        (tmp_path / f"{name}.sock.lock").touch()
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
            dead.bind(str(tmp_path / f"{name}.sock"))
    (tmp_path / "notes.lock").touch()
    with VirtualBusHub(tmp_path / "live.sock"):
        assert remove_dead_sockets(tmp_path) == 2
        assert sorted(path.name for path in tmp_path.iterdir()) == ["live.sock", "live.sock.lock", "notes.lock"]
        assert_passes_frames(tmp_path / "live.sock")


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
        eventually(lambda: hub.counters["clients"] == MAX_CLIENTS, 60.0)
        with join(path) as refused:
            assert refused.recv(64) == b""
        clients[0].send(FRAME)
        assert all(client.recv(64) == FRAME for client in clients[1:])
        clients.pop().close()
        eventually(lambda: hub.counters["clients"] == MAX_CLIENTS - 1, 60.0)
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
        eventually(lambda: hub.counters["clients"] == 1, 60.0)
        assert hub.counters["malformed"] == 0


def test_frames_of_a_dead_client_still_get_their_time_on_the_wire(path: Path) -> None:
    with VirtualBusHub(path, bitrate_bitps=100_000, timing=True) as hub, join(path) as b:
        with join(path) as a:
            for number in range(80):  # more than a queue in the hub holds
                a.send(bytes([number]) + bytes(15))
        assert [b.recv(64)[0] for _ in range(80)] == list(range(80))
        eventually(lambda: hub.counters["clients"] == 1, 60.0)


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

"""One contract for every end of a bus: the raw end of the control loop and python-can, with and without bit times."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, ClassVar

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable

from jointctl.drivers.can import virtual_bus
from jointctl.drivers.can.open import open_python_can
from jointctl.hil import virtual_bus as hil_bus
from jointctl.hil.virtual_bus import VirtualBusHub
from tests.contract.ends_of_a_bus import (
    EXTENDED,
    LONG_S,
    REMOTE,
    SHORT_S,
    End,
    PythonCanEnd,
    RawEnd,
    send_surely,
)
from tests.python_process import eventually

END = (0x7AA, b"")  # the last frame of a test


@contextmanager
def joining(connect: Callable[[], End]) -> Iterator[Callable[[], End]]:
    """What opens one more end; all are closed with the block."""
    with ExitStack() as stack:
        yield lambda: stack.enter_context(closing(connect()))


class BusContract:
    """What holds for every end.  A subclass gives `join`, which connects one more end to the same bus."""

    def test_a_frame_arrives_unchanged(self, join: Callable[[], End]) -> None:
        sender, receiver = join(), join()
        for identifier, data in [(0, b""), (0x7FF, b"\x00"), (0x181, bytes(range(8))), (EXTENDED | 0x1FFFFFFF, b"ab")]:
            assert sender.send(identifier, data)
            assert receiver.receive() == (identifier, data)
        assert sender.send(REMOTE | 0x701)
        assert receiver.receive() == (REMOTE | 0x701, b"")

    def test_own_frames_are_not_received(self, join: Callable[[], End]) -> None:
        sender, receiver = join(), join()
        assert sender.send(0x123)
        assert receiver.receive() == (0x123, b"")
        assert sender.receive(SHORT_S) is None

    def test_all_clients_see_each_other(self, join: Callable[[], End]) -> None:
        ends = [join() for _ in range(16)]
        for number, sender in enumerate(ends):
            assert sender.send(number, bytes([number]))
            for receiver in ends:
                if receiver is not sender:
                    assert receiver.receive() == (number, bytes([number]))
        assert all(end.receive(0.0) is None for end in ends)

    def test_the_order_of_one_sender_is_kept(self, join: Callable[[], End]) -> None:
        sender, receiver = join(), join()
        for number in range(50):
            assert sender.send(0x7FF - number)
        assert [receiver.receive() for _ in range(50)] == [(0x7FF - number, b"") for number in range(50)]

    def test_a_thousand_frames_are_not_lost(self, join: Callable[[], End]) -> None:
        sender, receiver = join(), join()
        got: list[Any] = []
        reader = threading.Thread(target=lambda: got.extend(receiver.receive() for _ in range(1000)))
        reader.start()
        for number in range(1000):
            send_surely(sender, number, bytes([number & 255]))
        reader.join(2 * LONG_S)
        assert got == [(number, bytes([number & 255])) for number in range(1000)]
        assert receiver.receive(0.0) is None

    def test_the_others_go_on_when_one_leaves(self, join: Callable[[], End]) -> None:
        sender, leaving, receiver = join(), join(), join()
        assert leaving.send(1)
        leaving.close()
        assert receiver.receive() == (1, b"")
        assert sender.receive() == (1, b"")
        for number in range(20):
            assert sender.send(number)
            assert receiver.receive() == (number, b"")


class HubContract(BusContract):
    """What holds for every end of the virtual bus of this project."""

    timing: ClassVar[bool]

    @pytest.fixture
    def hub(self, tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualBusHub]:
        with VirtualBusHub(tmp_path_factory.mktemp("b") / "bus.sock", timing=self.timing) as hub:
            yield hub

    @pytest.fixture
    def join(self, hub: VirtualBusHub) -> Iterator[Callable[[], End]]:
        with joining(lambda: self.connect(hub.path)) as connect:
            yield connect

    def connect(self, path: Path) -> End:
        raise NotImplementedError

    def test_all_receivers_see_one_order(self, join: Callable[[], End]) -> None:
        senders, receivers = [join() for _ in range(3)], [join() for _ in range(3)]
        threads = [
            threading.Thread(target=lambda s=sender, n=n: [send_surely(s, 100 * n + k) for k in range(40)])
            for n, sender in enumerate(senders)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(LONG_S)
        orders = [[receiver.receive() for _ in range(120)] for receiver in receivers]
        assert orders[0] == orders[1] == orders[2]
        for n in range(3):  # and each sender's own order is kept in it
            own = [got[0] for got in orders[0] if got is not None and got[0] // 100 == n]
            assert own == [100 * n + k for k in range(40)]

    def test_one_that_does_not_read_does_not_hold_up_the_others(self, hub: VirtualBusHub, join: Any) -> None:
        sender, sleeper, receiver = join(), join(), join()
        for number in range(3000):
            send_surely(sender, number % 0x700, b"12345678")
            assert receiver.receive() == (number % 0x700, b"12345678")
        eventually(lambda: hub.counters["frames"] == 3000, 60.0)
        lost = int(hub.counters["dropped"])
        kept = 3000 - lost
        assert lost > 0
        # It finds the oldest frames in order, and after them the new ones.
        assert [sleeper.receive() for _ in range(kept)] == [(n % 0x700, b"12345678") for n in range(kept)]
        assert sleeper.receive(SHORT_S) is None
        assert sender.send(0x7AA)
        assert sleeper.receive() == (0x7AA, b"")

    def test_datagrams_of_a_wrong_size_are_counted_and_not_passed_on(self, hub: VirtualBusHub, join: Any) -> None:
        receiver = join()
        with virtual_bus.connect(str(hub.path)) as bad:
            long_data = b"\x01\x00\x00\x00\x09" + bytes(11)
            error_frame = b"\x01\x00\x00\x20\x00" + bytes(11)
            for datagram in (b"", bytes(1), bytes(15), bytes(17), bytes(72), long_data, error_frame):
                bad.send(datagram)
            bad.send(b"\x55\x00\x00\x00" + bytes(12))  # the twin that must pass
            assert receiver.receive() == (0x55, b"")
            assert hub.counters["malformed"] == 7
            eventually(lambda: hub.counters["frames"] == 1, 60.0)

    def test_one_that_dies_with_unread_frames_is_removed(self, hub: VirtualBusHub, join: Any) -> None:
        sender, dying, receiver = join(), join(), join()
        assert sender.send(0x10)
        assert receiver.receive() == (0x10, b"")
        assert dying.send(0x11)
        dying.close()
        assert receiver.receive() == (0x11, b"")  # its last frame still counts
        eventually(lambda: hub.counters["clients"] == 2, 60.0)
        for number in range(100):
            assert sender.send(number)
            assert receiver.receive() == (number, b"")
        assert hub.counters["dropped"] == 0

    def test_the_bus_ends_for_all(self, hub: VirtualBusHub, join: Any) -> None:
        end = join()
        eventually(lambda: hub.counters["clients"] == 1, 60.0)
        hub.stop()
        with pytest.raises((OSError, can.CanOperationError)):
            end.receive()


class TimedHubContract(HubContract):
    timing = True

    def test_a_sender_faster_than_the_bus_finds_its_queue_full(self, tmp_path_factory: pytest.TempPathFactory) -> None:
        path = tmp_path_factory.mktemp("b") / "bus.sock"
        # 0.65 ms a frame: any sender is faster, on a busy computer too
        with VirtualBusHub(path, 200_000, timing=True), ExitStack() as stack:
            sender, receiver = (stack.enter_context(closing(self.connect(path))) for _ in range(2))
            taken, came = 0, list[tuple[int, bytes] | None]()

            def take_all() -> None:  # meanwhile: what a receiver leaves waiting is lost at last, as in a real adapter
                while not came or came[-1] not in (END, None):
                    came.append(receiver.receive())

            taking = threading.Thread(target=take_all)
            taking.start()
            while sender.send(taken & 0x3FF, b"12345678"):
                taken += 1
                assert taken < 100_000
            assert taken > 64
            eventually(lambda: sender.send(*END), 60.0)
            taking.join()
            assert came == [(number & 0x3FF, b"12345678") for number in range(taken)] + [END]


class TestRawEnd(HubContract):
    timing = False

    def connect(self, path: Path) -> End:
        return RawEnd(path)


class TestRawEndWithBitTimes(TimedHubContract):
    def connect(self, path: Path) -> End:
        return RawEnd(path)


class TestPythonCan(HubContract):
    timing = False

    def connect(self, path: Path) -> End:
        return PythonCanEnd(open_python_can("jointctl", str(path), 1_000_000))


class TestPythonCanWithBitTimes(TimedHubContract):
    def connect(self, path: Path) -> End:
        return PythonCanEnd(open_python_can("jointctl", str(path)))


class TestInterfaceVirtualOfPythonCan(BusContract):
    """The contract is not our own invention: python-can's bus inside one process keeps it, too."""

    @pytest.fixture
    def join(self, tmp_path: Path) -> Iterator[Callable[[], End]]:
        with joining(lambda: PythonCanEnd(open_python_can("virtual", str(tmp_path)))) as connect:
            yield connect


def test_both_sides_name_the_same_socket(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for runtime in (str(tmp_path), "", str(tmp_path / "missing")):
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        for channel in ("vcan", "can0", "a.b-c_1"):
            assert hil_bus.default_socket_path(channel) == virtual_bus.default_socket_path(channel)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert virtual_bus.default_socket_path("vcan") == tmp_path / "jointctl" / "vcan.sock"
    for channel in ("", "..", "a/b", "a b", "-i"):
        with pytest.raises(Exception, match="channel"):
            hil_bus.default_socket_path(channel)
        with pytest.raises(Exception, match="channel"):
            virtual_bus.default_socket_path(channel)


def _dictionary() -> canopen.ObjectDictionary:
    dictionary = canopen.ObjectDictionary()
    for name, index, kind in (
        ("Target torque", 0x6071, canopen.objectdictionary.INTEGER16),
        ("Producer heartbeat time", 0x1017, canopen.objectdictionary.UNSIGNED16),
    ):
        variable = ODVariable(name, index, 0)
        variable.data_type, variable.access_type, variable.default = kind, "rw", 0
        dictionary.add_object(variable)
    return dictionary


@pytest.mark.parametrize("timing", [False, True])
def test_two_canopen_networks_talk(tmp_path_factory: pytest.TempPathFactory, timing: bool) -> None:
    with VirtualBusHub(tmp_path_factory.mktemp("b") / "bus.sock", timing=timing) as hub:
        master, slave = (canopen.Network(open_python_can("jointctl", str(hub.path))) for _ in range(2))
        master.NOTIFIER_CYCLE = slave.NOTIFIER_CYCLE = 0.02  # it is waited for at the end
        master.connect()
        slave.connect()
        try:
            local = slave.create_node(5, _dictionary())
            remote = master.add_node(5, _dictionary())
            remote.sdo.RESPONSE_TIMEOUT = LONG_S
            remote.sdo[0x6071].raw = -1234
            assert local.sdo[0x6071].raw == -1234
            assert remote.sdo[0x6071].raw == -1234
            local.nmt.state = "PRE-OPERATIONAL"
            remote.nmt.state = "OPERATIONAL"
            eventually(lambda: local.nmt.state == "OPERATIONAL", 60.0)
        finally:
            master.disconnect()
            slave.disconnect()

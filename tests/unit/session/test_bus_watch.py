"""What is watched beside a run: a sick SocketCAN interface, and the drive's temperature up to the report."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from jointctl.drivers.can.socketcan import BUS_OFF, CONTROLLER, LinkState
from jointctl.drivers.canopen.settings import TemperatureObject
from jointctl.drivers.drive import Reading
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.records import LawConstants, LogRecord
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.canopen import temperature_object
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.recording.report_figures import temperature_figure
from jointctl.tools.recording.run_log import RunLogWriter
from jointctl.tools.recording.run_log_reader import csv_bytes, npz_bytes, read_run_log, table_columns
from jointctl.tools.recording.run_summary import summarise
from jointctl.tools.session import run_watch as module
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.session.run_watch import STALE_S, BusWatch, TemperatureWatch, bus_watch
from tests.configurations import shipped, written

# --- What a sick SocketCAN interface adds to a run: its complaints as they come, its state as the cause of a fault ---
TEXT = fault_text(Fault.STALE_SAMPLE, 5.0, 0)


@pytest.fixture
def config() -> Config:
    return shipped(bus__interface="socketcan", bus__channel="can0")


@pytest.fixture
def ends() -> Iterator[Any]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    near.setblocking(False)
    yield near, far
    near.close()
    far.close()


def error_frame(identifier: int, data: bytes) -> bytes:
    return struct.pack("<IB3x8s", identifier | 0x20000000, 8, data)


def test_each_trouble_is_told_once(config: Config, ends: Any) -> None:
    near, far = ends
    watch = BusWatch(config, near)
    assert watch.news() == []
    for _ in range(3):
        far.send(error_frame(CONTROLLER, b"\0\x20\0\0\0\0\x80\0"))
    far.send(error_frame(CONTROLLER, b"\0\x08"))  # a warning is no trouble
    (news,) = watch.news()
    assert "can0: error passive (transmit); transmit errors 128" in news
    assert "power of the drive" in news
    far.send(error_frame(BUS_OFF, b""))
    assert "bus-off" in watch.news()[0]
    far.close()
    assert watch.news() == []


def link(**changes: Any) -> LinkState:
    values = {
        "name": "can0", "kind": "can", "up": True, "state": "ERROR-ACTIVE", "transmit_errors": 0, "receive_errors": 0,
        "bitrate_bitps": 1_000_000, "queue_frames": 10, "counts": {},
    }  # fmt: skip
    return LinkState(**{**values, **changes})


@pytest.mark.parametrize(
    ("state", "code", "cause"),
    [
        (link(up=False), 0, "can0 is down"), (link(state="BUS-OFF"), 0, "bus-off"),
        (link(), errno.ENOBUFS, "queue of can0 is full"), (link(), 0, TEXT.cause), (None, errno.ENODEV, "has gone"),
        (None, 0, TEXT.cause),
    ],
)  # fmt: skip
def test_the_cause_of_a_fault(
    config: Config, ends: Any, state: LinkState | None, code: int, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "link_state", lambda channel: state)
    found = BusWatch(config, ends[0]).explained(Fault.STALE_SAMPLE, TEXT, code)
    assert found is not None
    assert cause in found.cause
    assert found.happened == TEXT.happened


def test_other_faults_keep_their_own_cause_beside_it_and_other_buses_their_text(
    config: Config, ends: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "link_state", lambda channel: link(up=False))
    text = fault_text(Fault.POSITION_LIMIT, 1.0, 0)
    found = BusWatch(config, ends[0]).explained(Fault.POSITION_LIMIT, text, 0)
    assert found is not None
    assert "can0 is down" in found.cause
    assert text.cause in found.cause
    monkeypatch.setattr(module, "link_state", lambda channel: link())
    assert BusWatch(config, ends[0]).explained(Fault.POSITION_LIMIT, text, 0) == text
    assert BusWatch(config, None).explained(Fault.STALE_SAMPLE, TEXT, errno.ENOBUFS) is TEXT
    assert BusWatch(config, ends[0]).explained(Fault.NONE, None, 0) is None


def test_an_interface_that_does_not_exist_is_told_by_the_drive(config: Config) -> None:
    with bus_watch(config) as watch:
        assert watch.news() == []


# --- The drive's temperature from the configuration to the report: watched, logged, exported, drawn ---
# --- configuration ---------------------------------------------------------------------------------------------
S = 1_000_000_000  # ns


def test_the_configuration_names_object_unit_and_offset(tmp_path: Path) -> None:
    path = tmp_path / "joint.toml"
    named = {"object": "2203:2", "unit_degC": 0.01, "offset_degC": -273.15}
    config = load_config(written(path, **{f"drive__temperature_{key}": value for key, value in named.items()}))
    assert temperature_object(config) == TemperatureObject(0x2203, 2, 0.01, -273.15)
    without = written(path, drive__temperature_object=None, drive__temperature_unit_degC=None)
    assert temperature_object(load_config(without)) is None


@pytest.mark.parametrize("wrong", ["1000", "2203:255", "temperature", 0x2203, ""])
def test_a_place_that_is_none_is_refused(tmp_path: Path, wrong: str | int) -> None:
    with pytest.raises(ConfigurationError, match=r"drive\.temperature_object"):
        load_config(written(tmp_path / "joint.toml", drive__temperature_object=wrong))


# --- watch, log and what is made of it ---
class Told:
    """A thermometer that says what the test wants."""

    def __init__(self, *readings: Reading | None) -> None:
        self._readings = list(readings)

    def poll(self) -> Reading | None:
        return self._readings.pop(0) if self._readings else None


def log_with(path: Path, *readings: Reading | None, cycles: int = 4) -> Any:
    records = np.zeros(cycles, dtype_of(LogRecord))
    records["time_ns"] = np.arange(1, cycles + 1) * S
    with RunLogWriter(path, {}) as log:
        watch = TemperatureWatch(Told(*readings), log)
        for _ in readings:
            watch.poll()
        log.write_records(records)
    return read_run_log(path)


def test_readings_are_logged_and_each_trouble_is_told_once(tmp_path: Path) -> None:
    silent = Reading(3 * S, None, "no answer")
    log = log_with(tmp_path / "a.mcap", Reading(2 * S, 25.5), None, silent, silent, Reading(4 * S, 26.0))
    assert log.temperatures["time_ns"].tolist() == [2 * S, 4 * S]
    assert log.temperatures["temperature_degC"].tolist() == [25.5, 26.0]
    assert [(event.time_ns, event.source, event.text) for event in log.events] == [(3 * S, "drive", "no answer")]
    found = summarise(log.records, temperatures_degC=log.temperatures["temperature_degC"])
    assert (found.temperature_degC.least, found.temperature_degC.greatest) == (25.5, 26.0)


def test_the_newest_reading_goes_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = TemperatureWatch(Told(Reading(10 * S, 25.5)))
    assert watch.newest_degC is None
    watch.poll()
    limit_ns = 10 * S + round(STALE_S * S)
    for now_ns, expected in ((limit_ns, 25.5), (limit_ns + 1, None)):
        monkeypatch.setattr("time.monotonic_ns", lambda now_ns=now_ns: now_ns)
        assert watch.newest_degC == expected


def test_the_law_gets_each_reading_and_its_age_is_told_once_when_it_holds_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    law = new(LawConstants)[0]
    law.friction.temperature_viscous_pK = 0.01
    with RunLogWriter(tmp_path / "a.mcap", {}) as log:
        readings = (Reading(10 * S, 25.5), None, None, Reading(20 * S, 26.0))
        watch = TemperatureWatch(Told(*readings), log, law)
        for now_s, held in ((10, 25.5), (12, 25.5), (15, 25.5), (20, 26.0), (21, 26.0), (25, 26.0), (26, 26.0)):
            monkeypatch.setattr("time.monotonic_ns", lambda now_s=now_s: now_s * S)
            watch.poll()
            assert law.temperature.degC[0] == held
        monkeypatch.undo()
        assert law.temperature.time_ns[0] == 20 * S
        log.write_records(np.zeros(1, dtype_of(LogRecord)))
    texts = [event.text for event in read_run_log(tmp_path / "a.mcap").events]
    assert texts == [
        "no temperature for 5 s: the friction feed-forward holds that of 25.5 °C",
        "no temperature for 5 s: the friction feed-forward holds that of 26.0 °C",
    ]


def test_a_law_whose_friction_knows_no_temperature_holds_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RunLogWriter(tmp_path / "a.mcap", {}) as log:
        watch = TemperatureWatch(Told(Reading(10 * S, 25.5), None), log, new(LawConstants)[0])
        for now_s in (10, 15):
            monkeypatch.setattr("time.monotonic_ns", lambda now_s=now_s: now_s * S)
            watch.poll()
        monkeypatch.undo()
        log.write_records(np.zeros(1, dtype_of(LogRecord)))
    assert read_run_log(tmp_path / "a.mcap").events == ()


def test_a_drive_without_a_thermometer_tells_nothing(tmp_path: Path) -> None:
    watch = TemperatureWatch(None)
    watch.poll()
    assert (watch.newest_degC, watch.values_degC) == (None, [])
    log = log_with(tmp_path / "a.mcap")
    assert len(log.temperatures) == 0
    assert "temperature_degC" not in table_columns(log)
    assert summarise(log.records).temperature_degC is None


def test_mcaps_own_ros_2_decoder_reads_the_topic(tmp_path: Path) -> None:
    log_with(tmp_path / "a.mcap", Reading(2 * S, 25.5))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [message for *_, message in reader.iter_decoded_messages(topics=["/temperature"])]
    assert [(message.time_ns, message.temperature_degc) for message in found] == [(2 * S, 25.5)]


def test_exports_hold_the_newest_reading_of_each_cycle(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    log = log_with(path, Reading(2 * S, 25.5), Reading(4 * S - 1, 26.0))
    column = table_columns(log)["temperature_degC"]
    np.testing.assert_array_equal(column, [np.nan, 25.5, 25.5, 26.0])
    assert csv_bytes(log, path).splitlines()[2].endswith(b",25.5")
    (tmp_path / "a.npz").write_bytes(npz_bytes(log, path))
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["temperature_degC"].tolist() == [25.5, 26.0]
        assert arrays["temperature_time_ns"].tolist() == [2 * S, 4 * S - 1]


def test_the_report_draws_it_from_ten_readings_on(tmp_path: Path) -> None:
    readings = [Reading(second * S, 25.0 + second) for second in range(1, 11)]
    (figure,) = temperature_figure(log_with(tmp_path / "a.mcap", *readings, cycles=12))
    assert "°C" in figure.svg
    assert temperature_figure(log_with(tmp_path / "b.mcap", *readings[:9], cycles=12)) == []

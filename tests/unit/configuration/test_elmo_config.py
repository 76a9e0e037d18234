"""The configuration of a serial drive: what is shipped loads and tracks within its margins, what is wrong is named."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from jointctl.drivers.elmo.codes import motor_fault_text
from jointctl.drivers.errors import ConfigurationError, MarginError
from jointctl.firmware_py.states import Fault
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo_settings import elmo_section, serial_line_share, with_port_override
from jointctl.tools.configuration.load import load_config, shipped_config, with_bus_overrides
from jointctl.tools.session.fault_words import SERIAL_FAULT_TEXTS
from jointctl.tools.session.open_drive import check_cyclic_rate, drive_fault_text

SHIPPED = shipped_config("elmo_serial").read_text()


@pytest.fixture
def config() -> Config:
    return load_config(shipped_config("elmo_serial"))


def problem(tmp_path: Path, pattern: str, line: str) -> str:
    changed, count = re.subn(rf"^{pattern}", lambda _: line, SHIPPED, count=1, flags=re.M)
    assert count == 1, pattern
    path = tmp_path / "joint.toml"
    path.write_text(changed)
    with pytest.raises(ConfigurationError) as caught:
        check_cyclic_rate(load_config(path))
    return caught.value.message


def test_the_shipped_one_loads_and_its_port_is_its_bus(config: Config) -> None:
    drive = elmo_section(config)
    assert (config.bus.interface, config.bus.channel, config.bus.bitrate_bitps) == ("serial", drive.port, 115_200)
    assert 0.5 < serial_line_share(config) < 1.0


@pytest.mark.parametrize(
    ("pattern", "line", "words"),
    [
        ("kind = .*", 'kind = "elmo"', "drive.kind (=elmo) must be one of 'canopen', 'elmo_serial'"),
        ("kind = .*", "", "drive.kind must be one of 'canopen', 'elmo_serial'"),
        ("port = .*", "", "drive.port is missing"),
        ("port = .*", "port = 3", "drive.port (=3) must be a text in quotes"),
        ("baud_rate_bitps = .*", "baud_rate_bitps = 100000", "drive.baud_rate_bitps (=100000) must be one of 9600,"),
        ("baud_rate_bitps = .*", "baud_rate_bitps = 57600", "loop.rate_Hz (=125) must be at most 101 at"),
        ("port = .*", 'prot = "x"', "drive.prot is not a known key: did you mean port?"),
        ("echo = .*", "node = 1", "drive.node is not a known key"),
        ("continuous_current_A = .*", "continuous_current_A = 5.1", "must be at most drive.peak_current_A (=5)"),
        ("torque_max_Nm = .*", "torque_max_Nm = 61", "limits.torque_max_Nm (=61) must be in (0..60.5]"),
        ("dead_man_s = .*", "dead_man_s = 0.11", "must be at most limits.sample_age_max_s (=0.1)"),
        ("dead_man_s = .*", "dead_man_s = 0.006", "must be at least one period"),
        ("counts_parameter = .*", 'counts_parameter = "CA"', 'such as "CA[18]"'),
        ("rate_Hz = .*", "rate_Hz = 9.9", "loop.rate_Hz (=9.9) must be in [10..10000]"),
        (r"\[drive\]", '[bus]\ninterface = "a"\nchannel = "b"\nbitrate_bitps = 20000\n[drive]', "[bus] must be absent"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path: Path, pattern: str, line: str, words: str) -> None:
    assert words in problem(tmp_path, pattern, line)


def test_the_port_can_be_overridden_and_can_options_cannot(config: Config) -> None:
    other = with_port_override(config, "COM7")
    assert (elmo_section(other).port, other.bus.channel) == ("COM7", "COM7")
    assert with_port_override(config, None) is config
    assert with_bus_overrides(config, environ={"CAN_CHANNEL": "can3"}) is config
    for option in ({"channel": "can3"}, {"interface": "socketcan"}, {"bitrate": 0}):
        with pytest.raises(ConfigurationError, match="use -p"):
            with_bus_overrides(config, **option)
    with pytest.raises(ConfigurationError, match="for a serial port"):
        with_port_override(load_config(shipped_config("virtual")), "COM7")


def test_can_parts_say_that_they_are_not_for_a_serial_drive(config: Config) -> None:
    with pytest.raises(ConfigurationError, match='must be "canopen" here'):
        _ = config.canopen


@pytest.mark.parametrize("delay_s", [0.002, 0.004, 0.006])
def test_the_shipped_gains_are_carried_by_the_rate(config: Config, delay_s: float) -> None:
    assert require_margin(config, delay_s).phase_margin_deg > 25.0


def test_gains_of_a_fast_bus_are_refused_naming_some_that_are_carried(config: Config) -> None:
    control = config.control.model_copy(update={"kp": 784.0, "kv": 56.0, "q": (1800.0,)})
    fast = config.model_copy(update={"control": control})
    with pytest.raises(MarginError) as caught:
        require_margin(fast, 0.003)
    found = re.search(r"a slower loop: control.kp = ([\d.]+), kv = ([\d.]+), q = ([\d.]+)", caught.value.hint)
    assert found is not None
    kp, kv, q = map(float, found.groups())
    named = control.model_copy(update={"kp": kp, "kv": kv, "q": (q,)})
    # the printed gains are rounded to four digits, which may cost some hundredths of a degree
    margin = config.margin.model_copy(update={"min_phase_margin_deg": config.margin.min_phase_margin_deg - 0.2})
    assert require_margin(config.model_copy(update={"control": named, "margin": margin}), 0.003).stable


@pytest.mark.parametrize("fault", list(SERIAL_FAULT_TEXTS))
def test_every_fault_text_takes_its_value(config: Config, fault: Fault) -> None:
    text = drive_fault_text(config, fault, 144.0, 0x20000)
    assert "{" not in text.happened
    assert motor_fault_text(0x20000) in text.happened


@pytest.mark.parametrize("fault", [fault for fault in Fault if fault is not Fault.NONE])
def test_no_fault_speaks_of_a_watchdog_that_a_serial_drive_has_not(config: Config, fault: Fault) -> None:
    text = drive_fault_text(config, fault, 5.0, 0)
    assert "watchdog" not in f"{text.happened} {text.cause} {text.next_step}"


def test_after_standby_the_user_hears_that_the_drive_held_its_torque(config: Config) -> None:
    text = drive_fault_text(config, Fault.SUSPENDED, 3600.0, 0)
    assert "slept for 3600.0 s" in text.happened
    assert "the drive held its last command meanwhile" in text.happened
    assert "systemd-inhibit" in text.next_step
    canopen = drive_fault_text(load_config(shipped_config("virtual")), Fault.SUSPENDED, 3600.0, 0)
    assert "the drive's watchdog stopped the joint" in canopen.next_step


def test_a_text_with_a_status_shows_it_in_hexadecimal(config: Config) -> None:
    assert "(SR 90h)" in drive_fault_text(config, Fault.DRIVE_FAULT, 144.0, 0).happened
    assert "CANopen" not in drive_fault_text(config, Fault.POSITION_LIMIT, 0.5, 0).happened

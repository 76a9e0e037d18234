"""Frame lengths and bus budget, against the figures of the hardware specification, section 4."""

from __future__ import annotations

import pytest

from jointctl.drivers.can.frames import bus_load, highest_rate_Hz, worst_cycle_bits, worst_frame_bits
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.drive_settings import cyclic_bus_load
from jointctl.tools.configuration.load import load_config, shipped_config

SYNC, POSITION, TORQUE = 0, 8, 4


@pytest.mark.parametrize(("length", "worst"), [(0, 55), (4, 95), (8, 135)])
def test_bits_of_one_frame(length: int, worst: int) -> None:
    assert worst_frame_bits(length) == worst


def test_bits_of_an_extended_frame() -> None:
    assert worst_frame_bits(8, extended=True) == 160  # Davis et al. (2007)


def test_every_length_follows_the_formula() -> None:
    for length in range(9):
        assert worst_frame_bits(length) == 47 + 8 * length + (33 + 8 * length) // 4


def test_the_cycle_of_the_controller() -> None:
    cycle = [SYNC, POSITION, TORQUE]
    assert worst_cycle_bits(cycle) == 285
    assert bus_load(cycle, 1000.0, 1_000_000) == pytest.approx(0.285, abs=1e-12)
    assert highest_rate_Hz(cycle, 1_000_000) == pytest.approx(3508.77, abs=0.01)
    assert bus_load(cycle, 1000.0, 500_000) == pytest.approx(0.57, abs=1e-12)
    assert bus_load(cycle, 1000.0, 250_000) > 1.0


def test_a_second_input_frame_at_2_kHz() -> None:
    assert bus_load([SYNC, POSITION, POSITION, TORQUE], 2000.0, 1_000_000) == pytest.approx(0.84)
    assert bus_load([SYNC, POSITION, POSITION, 8], 2000.0, 1_000_000) == pytest.approx(0.92)


def test_highest_rate_is_where_the_load_is_reached() -> None:
    cycle = [SYNC, POSITION, TORQUE]
    rate_Hz = highest_rate_Hz(cycle, 500_000, highest_load=0.7)
    assert bus_load(cycle, rate_Hz, 500_000) == pytest.approx(0.7)


@pytest.mark.parametrize("length", [-1, 9])
def test_length_outside_is_refused(length: int) -> None:
    with pytest.raises(ValueError, match=rf"data length \(={length}\) must be in \[0..8\]"):
        worst_frame_bits(length)


@pytest.mark.parametrize("bitrate", [0, -1, 1_000_001])
def test_bitrate_outside_is_refused(bitrate: int) -> None:
    with pytest.raises(ValueError, match=rf"bitrate_bitps \(={bitrate}\)"):
        bus_load([0], 1000.0, bitrate)


def test_other_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="rate_Hz"):
        bus_load([0], float("nan"), 1_000_000)
    with pytest.raises(ValueError, match="at least one frame"):
        highest_rate_Hz([], 1_000_000)
    with pytest.raises(ValueError, match="highest_load"):
        highest_rate_Hz([0], 1_000_000, 1.5)


@pytest.mark.parametrize(
    ("bitrate", "rate_Hz", "mode", "refused"),
    [
        (1_000_000, 2807.0, "cst", ""),
        (1_000_000, 2808.0, "cst", "at most 2807"),
        (500_000, 1000.0, "cst", ""),
        (250_000, 1000.0, "cst", "= 285 bits a cycle, 114% of the bus, 80% allowed"),
        (1_000_000, 2622.0, "cyclic_sync_velocity", ""),
        (1_000_000, 2624.0, "cyclic_sync_velocity", r"SYNC \+ TPDO\(8\) \+ RPDO\(6\) = 305 bits a cycle"),
    ],
)
def test_a_configuration_beyond_the_bus_is_refused_with_the_arithmetic(
    bitrate: int, rate_Hz: float, mode: str, refused: str
) -> None:
    config = load_config(shipped_config("virtual"))
    config = config.model_copy(
        update={
            "bus": config.bus.model_copy(update={"bitrate_bitps": bitrate}),
            "loop": config.loop.model_copy(update={"rate_Hz": rate_Hz}),
            "drive": config.drive.model_copy(update={"mode": mode}),
        }
    )
    if refused:
        with pytest.raises(ConfigurationError, match=refused):
            cyclic_bus_load(config)
    else:
        assert 0.5 < cyclic_bus_load(config) <= 0.8

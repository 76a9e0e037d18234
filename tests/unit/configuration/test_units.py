"""Quantities with a unit, where they have one meaning, and the echo of what was understood."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.load import load_config, understood, unit_of, with_units
from tests.configurations import VIRTUAL, load, problems


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("position_max_rad", "30 deg", math.pi / 6),
        ("position_max_rad", "-30°", -math.pi / 6),
        ("velocity_max_radps", "60 rpm", math.tau),
        ("velocity_max_radps", "6e1 r/min", math.tau),
        ("brake_radps2", "180 deg/s2", math.pi),
        ("jerk_radps3", "180 deg/s3", math.pi),
        ("rate_Hz", "1 kHz", 1000.0),
        ("rate_Hz", ".5kHz", 500.0),
        ("heartbeat_s", "100 ms", 0.1),
        ("inertia_kgm2", "20 kg cm2", 2e-3),
        ("bitrate_bitps", "1 Mbit/s", 1_000_000),
        ("bitrate_bitps", "0.5 Mbit/s", 500_000),
        ("max_torque_permille", "50 %", 500),
        ("torque_max_Nm", "1_500 mNm", 1.5),
        ("stiffness_Nmprad", "17 kNm/rad", 1.7e4),
        ("stiffness_Nmprad", "5 Nm/arcmin", 5.0 * 60.0 * 180.0 / math.pi),
        ("stiffness_Nmprad", "300 Nm/deg", 300.0 * 180.0 / math.pi),
        ("damping_Nmspr", "8 Nm s/rad", 8.0),
        ("hysteresis_width_rad", "1 arcmin", math.pi / 180.0 / 60.0),
        ("hysteresis_width_rad", "60 arcsec", math.pi / 180.0 / 60.0),
    ],
)
def test_what_has_one_meaning(key: str, text: str, value: float) -> None:
    found = understood(key, text)
    assert found == pytest.approx(value)
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("position_max_rad", "30"), ("position_max_rad", "30 rpm"), ("rate_Hz", "1 k"), ("rate_Hz", "1 khz"),
        ("torque_max_Nm", "3 nm"), ("heartbeat_s", "100 m"), ("interface", "1 kHz"), ("bitrate_bitps", "1.5 bit/s"),
        ("rate_Hz", "one kHz"), ("rate_Hz", "1 kHz or so"), ("rate_Hz", "nan kHz"), ("rate_Hz", ""),
        ("bitrate_bitps", "1e999 kbit/s"), ("max_torque_permille", "1e308 %"),
    ],
)  # fmt: skip
def test_what_is_left_alone(key: str, text: str) -> None:
    assert understood(key, text) is None


def test_a_key_has_the_unit_at_its_end() -> None:
    assert (unit_of("rated_current_A"), unit_of("side"), unit_of("rate")) == ("A", None, None)


def test_a_file_with_units_loads_and_echoes_them(tmp_path: Path) -> None:
    path = tmp_path / "joint.toml"
    path.write_text(VIRTUAL.replace("rate_Hz = 1000.0", 'rate_Hz = "1 kHz"', 1))
    config = load_config(path)
    assert config.loop.rate_Hz == 1000.0
    assert config.remarks == ("loop.rate_Hz: 1 kHz is read as 1000 Hz",)
    assert load(tmp_path).remarks == ()


def test_a_unit_of_something_else_is_refused_as_any_text(tmp_path: Path) -> None:
    (line,) = problems(tmp_path, "rate_Hz = 1000.0", 'rate_Hz = "1000 rpm"')
    assert "loop.rate_Hz (=1000 rpm)" in line
    path = tmp_path / "joint.toml"
    path.write_text(VIRTUAL.replace("rate_Hz = 1000.0", 'rate_Hz = "50 kHz"', 1))
    with pytest.raises(ConfigurationError, match="rate_Hz"):
        load_config(path)


def test_tables_in_tables() -> None:
    assert with_units({"a": {"b": {"c_s": "3 ms"}}, "d": ["1 kHz"]}) == (
        {"a": {"b": {"c_s": pytest.approx(0.003)}}, "d": ["1 kHz"]},
        ["a.b.c_s: 3 ms is read as 0.003 s"],
    )

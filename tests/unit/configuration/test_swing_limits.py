"""The keys of the limit-cycle monitor: defaults, what they become in the records, what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from jointctl.tools.configuration.load import load_config, shipped_config
from tests.sessions import constants_of
from tests.unit.configuration.edited_config import load, problems

ANCHOR = "standstill_radps = .*"


def added(line: str) -> str:
    return f"standstill_radps = 0.02\n{line}"


@pytest.mark.parametrize("name", ["virtual", "paper", "precise", "sweep_virtual"])
def test_the_monitor_is_on_in_every_file_that_does_not_name_it(name: str) -> None:
    config = load_config(shipped_config(name))
    axis = constants_of(config)[0]
    swing = axis.limits.swing
    assert swing.torque_Nm == 60.0  # half of -60..60
    assert swing.error_rad == pytest.approx(0.05 * config.limits.following_error_max_rad)
    assert swing.slowest_cycles == 300
    assert swing.noise_Nm == pytest.approx(12.0)
    assert swing.noise_gain == pytest.approx(1.0 / 250.0)
    assert axis.law.learning.growth == (1.05 if config.control.learning is not None else 0.0)


def test_each_key_reaches_its_record(tmp_path: Path) -> None:
    keys = ("swing_torque_share = 0.75", "swing_error_share = 0.1", "swing_slowest_s = 0.5", "torque_noise_share = 0.1")
    axis = constants_of(load(tmp_path, ANCHOR, added("\n".join(keys))))[0]
    swing = axis.limits.swing
    assert (swing.torque_Nm, swing.slowest_cycles) == (90.0, 500)
    assert (swing.error_rad, swing.noise_Nm) == (pytest.approx(0.005), pytest.approx(6.0))
    text = shipped_config("precise").read_text()
    axis = constants_of(load(tmp_path, ANCHOR, added("learning_growth = 1.5"), text))[0]
    assert axis.law.learning.growth == 1.5


def test_noise_is_also_what_comes_near_the_rate_limit(tmp_path: Path) -> None:
    """2 Nm in a cycle are allowed: 12 Nm would never come."""
    axis = constants_of(load(tmp_path, "torque_rate_max_Nmps = .*", "torque_rate_max_Nmps = 2000.0"))[0]
    assert axis.limits.swing.noise_Nm == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("key", "value", "allowed"),
    [
        ("swing_torque_share", 0.19, "[0.2..1]"),
        ("swing_torque_share", 1.01, "[0.2..1]"),
        ("swing_error_share", 0.0, "[0.01..1]"),
        ("swing_slowest_s", 2.1, "[0.01..2]"),
        ("torque_noise_share", 1.1, "[0.01..1]"),
        ("learning_growth", 0.99, "[1..10]"),
    ],
)
def test_what_is_out_of_range_is_refused(tmp_path: Path, key: str, value: float, allowed: str) -> None:
    (line,) = problems(tmp_path, ANCHOR, added(f"{key} = {value}"))
    assert line == f"limits.{key} (={value:g}) must be in {allowed}"


@pytest.mark.parametrize(("rate_Hz", "refused"), [(399.0, True), (400.0, False)])
def test_half_a_swing_is_at_least_four_periods(tmp_path: Path, rate_Hz: float, refused: bool) -> None:
    text = load_text_with(rate_Hz)
    if refused:
        (line,) = problems(tmp_path, ANCHOR, added("swing_slowest_s = 0.01"), text)
        assert line.startswith("limits.swing_slowest_s (=0.01) must be at least 4 periods, 0.0100251 s")
    else:
        load(tmp_path, ANCHOR, added("swing_slowest_s = 0.01"), text)


def load_text_with(rate_Hz: float) -> str:
    """configs/virtual.toml at another rate."""
    return shipped_config("virtual").read_text().replace("rate_Hz = 1000.0", f"rate_Hz = {rate_Hz}")

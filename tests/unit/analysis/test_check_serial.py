"""`jointctl check` on a serial line: a rate that the line cannot carry is refused, and the advice passes."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest

from jointctl.drivers.errors import ConfigurationError, MarginError
from jointctl.tools.configuration.elmo_settings import refuse_serial
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.experiments.controllers import from_file
from jointctl.tools.output import Output
from jointctl.tools.verbs.check import check
from jointctl.tools.verbs.fault_campaign import fault_campaign

SHIPPED = shipped_config("elmo_serial").read_text()


def checked(tmp_path: Path, **changes: float) -> str:
    """What `check` prints for the shipped configuration with other values."""
    text = SHIPPED
    for key, value in changes.items():
        text, count = re.subn(rf"^{key} = [^#\n]*", f"{key} = {value:g} ", text, count=1, flags=re.MULTILINE)
        assert count == 1, key
    path = tmp_path / "joint.toml"
    path.write_text(re.sub(r"^rate_Hz = (\d+) ", r"rate_Hz = \1.0 ", text, flags=re.MULTILINE))
    out = io.StringIO()
    check(load_config(path), Output(stdout=out, stderr=io.StringIO()))
    return out.getvalue()


def test_the_shipped_one_passes_and_tells_what_the_line_carries(tmp_path: Path) -> None:
    told = checked(tmp_path)
    assert "62% of the line; up to 202 Hz at 115200 baud" in told


@pytest.mark.parametrize(("baud_rate", "refused"), [(57_600, True), (115_200, False), (230_400, False)])
def test_another_baud_rate_may_not_carry_the_rate(tmp_path: Path, baud_rate: int, refused: bool) -> None:
    if not refused:
        assert f"at {baud_rate} baud" in checked(tmp_path, baud_rate_bitps=baud_rate)
        return
    with pytest.raises(ConfigurationError, match=r"loop.rate_Hz \(=125\) must be at most 101 at") as caught:
        checked(tmp_path, baud_rate_bitps=baud_rate)
    hint = caught.value.hint
    assert hint.startswith("with loop.rate_Hz = 90 and control.velocity_cutoff_Hz = 43 the gains need a slower loop")
    advice = {key: float(value) for key, value in re.findall(r"(\w+) = ([\d.]+)", hint)}
    told = checked(tmp_path, baud_rate_bitps=baud_rate, position_jump_max_rad=0.04, **advice)
    assert "verdict" in told
    with pytest.raises(MarginError, match="phase margin"):  # the twin: the rate alone is not enough
        checked(
            tmp_path, baud_rate_bitps=baud_rate, position_jump_max_rad=0.04,
            rate_Hz=advice["rate_Hz"], velocity_cutoff_Hz=advice["velocity_cutoff_Hz"],
        )  # fmt: skip


def test_a_rate_that_leaves_the_gains_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        checked(tmp_path, rate_Hz=203)
    assert re.match(r"with loop.rate_Hz = 181 the gains keep \d\d deg", caught.value.hint)


def test_what_is_simulated_in_lockstep_is_refused_in_one_line() -> None:
    config = load_config(shipped_config("elmo_serial"))
    with pytest.raises(ConfigurationError, match=r'drive.kind \(=elmo_serial\) must be "canopen" for fault-campaign'):
        fault_campaign(config, Output())
    with pytest.raises(ConfigurationError, match=r'drive.kind \(=elmo_serial\) must be "canopen" for study'):
        from_file("elmo_serial")
    refuse_serial(load_config(shipped_config("virtual")), "fault-campaign")  # the twin

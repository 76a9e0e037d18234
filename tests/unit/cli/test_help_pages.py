"""Every help page in a terminal of 80 columns, and names of shipped configurations wherever one is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from jointctl.tools.cli.main import app
from jointctl.tools.experiments.paper_experiments import synthetic_sweep


def pages() -> list[tuple[str, ...]]:
    """The arguments that lead to each help page."""
    top: Any = typer.main.get_command(app)
    found: list[tuple[str, ...]] = [()]
    for name, command in top.commands.items():
        found += [(name,), *((name, inner) for inner in getattr(command, "commands", ()))]
    return found


@pytest.mark.parametrize("words", pages(), ids="-".join)
def test_nothing_is_cut_off_in_a_help_page_of_80_columns(words: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "80"})
    assert shown.exit_code == 0
    assert "…" not in shown.output
    assert max(len(line) for line in shown.output.splitlines()) <= 80


@pytest.fixture
def data(tmp_path: Path) -> Path:
    sweep = synthetic_sweep()
    path = tmp_path / "sweep.csv"
    rows = zip(sweep.velocity_radps, sweep.motor_torque_Nm, strict=True)
    path.write_text("velocity,torque\n" + "".join(f"{velocity},{torque}\n" for velocity, torque in rows))
    return path


FOREIGN = ("--velocity-column", "velocity", "--torque-column", "torque", "--velocity-unit", "rad/s", "--side", "joint",
           "--torque-side", "motor", "--ratio", "121")  # fmt: skip


def test_validate_and_identify_take_the_name_of_a_shipped_configuration(data: Path) -> None:
    found = CliRunner().invoke(app, ["validate", "paper", str(data), *FOREIGN])
    assert found.exception is None or isinstance(found.exception, SystemExit)
    assert found.exit_code == 0
    assert data.with_suffix(".validation.png").exists()
    swarm = ("--particles", "40", "--iterations", "40", "--folds", "2")
    assert CliRunner().invoke(app, ["identify", str(data), "--config", "paper", *FOREIGN, *swarm]).exit_code == 0

"""Options that stand in a dataclass reach the verb as one object; the command line shows them one by one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from jointctl.tools.cli.option_group import grouped


@dataclass(frozen=True)
class Place:
    name: Annotated[str | None, typer.Option("-n", "--name")] = None
    number: Annotated[int, typer.Option("--number", min=1)] = 3


taken: list[Any] = []
app = typer.Typer(add_completion=False)


@app.command()
@grouped
def verb(*, first: Annotated[str, typer.Argument()] = "a", place: Place, last: bool = False) -> None:
    """What it does."""
    taken.append((first, place, last))


@pytest.mark.parametrize(("arguments", "expected"), [
    ([], ("a", Place(None, 3), False)),
    (["b", "-n", "here", "--last"], ("b", Place("here", 3), True)),
    (["--number", "7"], ("a", Place(None, 7), False)),
])  # fmt: skip
def test_a_group_reaches_the_verb_as_one_object(arguments: list[str], expected: tuple[str, Place, bool]) -> None:
    taken.clear()
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert taken == [expected]


def test_the_command_line_shows_the_options_of_a_group_in_their_place() -> None:
    command = typer.main.get_command(app)
    assert [parameter.name for parameter in command.params] == ["first", "name", "number", "last"]
    assert command.help == "What it does."


def test_limits_of_an_option_hold_in_a_group() -> None:
    assert CliRunner().invoke(app, ["--number", "0"]).exit_code == 2

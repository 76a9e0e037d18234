"""What the command line says about itself, and `jointctl new`."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import typer

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.tools.cli.main import EPILOG, app
from jointctl.tools.configuration.load import SHIPPED_FOLDER, load_config
from jointctl.tools.output import Output
from jointctl.tools.verbs.new import new

QUIET = Output(stdout=io.StringIO(), stderr=io.StringIO())
MARKUP = re.compile(r"\[[a-z#/@]")  # what the help's formatter takes for a style, and swallows


def commands(command: Any = None, name: str = "jointctl") -> Iterator[tuple[str, Any]]:
    """Every verb of the command line by its full name."""
    command = command or typer.main.get_command(app)
    yield name, command
    for key, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, f"{name} {key}")


@pytest.mark.parametrize(("name", "command"), list(commands()))
def test_no_help_text_loses_its_brackets(name: str, command: Any) -> None:
    texts = [command.help or "", command.epilog or "", *(getattr(p, "help", "") or "" for p in command.params)]
    assert [text for text in texts if MARKUP.search(text)] == []


@pytest.mark.parametrize(("name", "command"), list(commands()))
def test_every_verb_says_what_it_does(name: str, command: Any) -> None:
    assert command.help, name


def test_the_help_names_every_shipped_configuration() -> None:
    for file in SHIPPED_FOLDER.glob("*.toml"):
        assert file.stem in EPILOG


def test_the_version_is_that_of_the_package() -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "jointctl.tools.cli", "--version"], capture_output=True, text=True, check=True
    )
    assert shown.stdout == f"jointctl {version('jointctl')}\n"


def test_nothing_heavy_is_imported_for_the_help() -> None:
    heavy = "{'numba', 'numpy', 'scipy', 'can', 'canopen', 'pydantic', 'matplotlib', 'tomlkit', 'mcap'}"
    code = f"import sys, tools.cli.main; print(sorted({heavy} & set(sys.modules)))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout == "[]\n"


def test_what_starts_a_motion_waits_for_no_slow_import() -> None:
    slow = "{'scipy.optimize', 'scipy.interpolate', 'scipy.stats', 'matplotlib'}"
    code = f"import sys, tools.verbs.run, tools.verbs.sweep; print(sorted({slow} & set(sys.modules)))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout == "[]\n"


@pytest.mark.parametrize("shipped", ["virtual", "precise", "elmo_serial.toml"])
def test_new_copies_a_shipped_configuration_that_loads(tmp_path: Path, shipped: str) -> None:
    assert new(tmp_path / "mine.toml", QUIET, shipped=shipped) == 0
    assert load_config(tmp_path / "mine.toml").log.folder == "runs"


def test_new_counts_what_is_to_be_filled_in(tmp_path: Path) -> None:
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    new(tmp_path / "mine.toml", output, shipped="elmo_gold_can")
    tomllib.loads((tmp_path / "mine.toml").read_text())
    with pytest.raises(ConfigurationError, match="missing"):
        load_config(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("name", "shipped", "error", "match"),
    [
        ("there.toml", "virtual", DataError, "exists already"),
        ("none/mine.toml", "virtual", DataError, "cannot be written: No such file or directory"),
        ("mine.txt", "virtual", DataError, "must end in .toml"),
        ("mine.toml", "nothing", ConfigurationError, "no such file"),
    ],
)
def test_new_refuses(tmp_path: Path, name: str, shipped: str, error: type[Exception], match: str) -> None:
    (tmp_path / "there.toml").write_text("mine")
    with pytest.raises(error, match=match):
        new(tmp_path / name, QUIET, shipped=shipped)
    assert (tmp_path / "there.toml").read_text() == "mine"

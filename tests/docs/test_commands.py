"""Every command block in the README and in docs/ works as it stands there.

The `sh` blocks of a page are one script, run in an empty folder with the installed package.  A block whose fence reads
`sh no-run: reason` is not run; of every command anywhere, verb and options are checked to exist.
Those in Python are for test_notebook.py.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer

from jointctl.tools.verbs.main import app
from tests.places import ROOT

PAGES = [ROOT / "README.md", *(ROOT / name for name in ("CHANGELOG.md", "CONTRIBUTING.md")), *ROOT.glob("docs/**/*.md")]
FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(jointctl [^`\n]+)`")
LONGEST_S = 300.0


class Block(NamedTuple):
    info: str
    body: str


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page."""
    return [Block(m["info"].strip(), m["body"]) for m in FENCE.finditer(page.read_text())]


def runnable(page: Path) -> list[str]:
    return [block.body for block in blocks(page) if block.info == "sh"]


def commands(page: Path) -> Iterator[list[str]]:
    """Every `jointctl ...` of a page, in blocks and in running text, as words."""
    lines = INLINE.findall(page.read_text())
    for block in blocks(page):
        if block.info.startswith("sh"):
            lines += block.body.replace("\\\n", " ").splitlines()
    for line in lines:
        for part in re.split(r"&&|[;|]", line.split(" #")[0]):
            words = part.split()
            if words[:1] == ["jointctl"] and len(words) > 1:
                yield words[1:]


def problem_with(words: list[str]) -> str:
    """What is wrong with verb and options; "" if nothing."""
    command: Any = typer.main.get_command(app)
    options = {option for p in command.params for option in p.opts} | {"--help", "--install-completion"}
    for word in words:
        if word.startswith("-"):
            if word.split("=")[0] not in options:
                return f"no option {word}"
        elif hasattr(command, "commands") and not word.startswith(("VERB", "{", "<")):
            if word not in command.commands:
                return f"no verb {word}"
            command = command.commands[word]
            options = {option for p in command.params for option in p.opts} | {"--help"}
    return ""


def test_a_wrong_verb_and_a_wrong_option_are_noticed() -> None:
    assert problem_with(["rum", "virtual"]) == "no verb rum"
    assert problem_with(["run", "virtual", "--yess"]) == "no option --yess"
    assert problem_with(["log", "inform"]) == "no verb inform"
    assert problem_with(["run", "virtual", "-y"]) == problem_with(["log", "info", "x"]) == ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_verb_and_option_that_is_named_exists(page: Path) -> None:
    found = {" ".join(words): problem_with(words) for words in commands(page)}
    assert {line: problem for line, problem in found.items() if problem} == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_block_that_is_not_run_says_why(page: Path) -> None:
    for block in blocks(page):
        assert block.info in ("sh", "python", "text", "toml", "") or re.fullmatch(r"sh no-run: .{5,}", block.info), (
            block.info
        )


def test_few_blocks_are_not_run() -> None:
    for page in ("docs/first-hour.md", "README.md"):
        found = [block for block in blocks(ROOT / page) if block.info.startswith("sh")]
        assert runnable(ROOT / page), page
        assert len(found) <= 12, page
    assert len(runnable(ROOT / "docs" / "first-hour.md")) >= 9


def test_every_link_between_the_pages_leads_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", [p for p in PAGES if runnable(p)], ids=lambda page: page.name)
def test_the_commands_of_a_page_work_in_their_order(page: Path, tmp_path: Path) -> None:
    folder, sockets = tmp_path / "empty", tmp_path / "s"
    folder.mkdir()
    sockets.mkdir(mode=0o700)
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash")
    script = "set -eux -o pipefail\ntrap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n" + "\n".join(runnable(page))
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    # sockets of its own: no other test's virtual joint is met
    environment = {**os.environ, "PATH": path, "XDG_RUNTIME_DIR": str(sockets), "COLUMNS": "120"}
    done = subprocess.run(
        [bash, "-c", script], cwd=folder, env=environment, text=True, timeout=LONGEST_S,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]

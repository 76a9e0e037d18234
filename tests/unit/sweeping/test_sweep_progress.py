"""When the bar of a sweep is drawn: not before the loop runs, or it paints over what is said until then."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Advance, Output
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.verbs import sweep as verb


class Bars(Output):
    """Notes what the bar was told."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.told: list[float | str] = []

    @contextmanager
    def progress(self, title: str, total: float) -> Iterator[Advance]:
        self.told.append(title)
        yield self.told.append
        self.told.append("end")


def test_the_bar_comes_with_the_first_record_of_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = Bars(stdout=StringIO(), stderr=StringIO())
    seen: list[list[float | str]] = []

    class Loop:
        drive_state = "off"

        def __init__(self, *given: Any, **_: Any) -> None:
            self._progress: Callable[[float], None] = given[6]

        def run(self) -> None:
            seen.append(output.told[:])
            self._progress(-1.0)
            self._progress(2.0)

    monkeypatch.setattr(verb, "SweepSupervisor", Loop)
    options = SweepOptions(points=24, assume_yes=True)
    assert verb.sweep(load_config(shipped_config("sweep_virtual")), output, tmp_path / "data.csv", options) == 0
    assert seen == [[]]
    assert output.told == ["24 points", 0.0, 2.0, "end"]

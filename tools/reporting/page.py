"""The page: a title, sections, and in each section texts, tables, figures and preformatted text in any order.

Everything that is text is escaped; only `Figure.svg` is taken as it is, so it must come from `figure.svg_figure`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from jointctl.drivers.errors import DataError
from jointctl.drivers.printable import printable
from jointctl.tools.written_file import replace_file, require_target

_TEMPLATE = "page.html.j2"


@dataclass(frozen=True)
class Paragraph:
    """Plain text; `tone` "error", "warning" or "good" sets it off."""

    text: str
    tone: str = ""
    kind: str = field(default="paragraph", init=False)


@dataclass(frozen=True)
class Table:
    """Rows of cells; a cell is text or a number that is already rounded.  Numbers and units stand right.

    `tones` gives a row, by its index, one of "error", "warning", "good".
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[object]]
    caption: str = ""
    tones: Mapping[int, str] = field(default_factory=dict)
    kind: str = field(default="table", init=False)

    def is_number(self, column: int) -> bool:
        """Whether every cell of the column reads as a number, so that it stands right."""
        cells = [str(row[column]) for row in self.rows if column < len(row) and str(row[column]) not in ("", "-")]
        return bool(cells) and all(_NUMBER.match(cell) for cell in cells)


_NUMBER = re.compile(r"[-+]?[0-9][0-9.,]*(e[-+]?[0-9]+)?( ?%)?$")


@dataclass(frozen=True)
class Figure:
    """A picture inside the page, as SVG markup; `alt` says in words what is to be seen."""

    alt: str
    svg: str
    caption: str = ""
    kind: str = field(default="figure", init=False)


@dataclass(frozen=True)
class Details:
    """Text that is shown on demand, such as a configuration file."""

    summary: str
    text: str
    kind: str = field(default="details", init=False)


Block = Paragraph | Table | Figure | Details


@dataclass(frozen=True)
class Section:
    """A heading and what stands below it, in order."""

    title: str
    blocks: Sequence[Block]

    @property
    def anchor(self) -> str:
        """For the list of contents."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


def _shown(value: Any) -> Any:
    """What is text on the page, without what a browser would obey; markup (`Figure.svg`) is left as it is."""
    return printable(value, keep="\n\t") if isinstance(value, str) and not hasattr(value, "__html__") else value


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("jointctl.tools.reporting", "."),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def page(title: str, sections: Sequence[Section], *, subtitle: str = "", made_at: str | None = None) -> str:
    """The HTML text.  `made_at` (default: now) is printed at the foot."""
    made_at = made_at if made_at is not None else datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    template = _environment().get_template(_TEMPLATE)
    context: dict[str, Any] = {"title": title, "subtitle": subtitle, "sections": sections, "made_at": made_at}
    return template.render(**context)


def check_target(path: Path, inputs: Sequence[Path] = ()) -> None:
    """`DataError` if a page cannot go there, or would overwrite one of its `inputs`; ask before the work is done."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise DataError(f"{path}: the name of a report must end in .html")
    require_target(path, inputs)


def write_page(path: str | Path, html: str, inputs: Sequence[Path] = ()) -> Path:
    """Put a page in place in one step; refuses as `check_target` does."""
    path = Path(path)
    check_target(path, inputs)
    replace_file(path, html.encode("utf-8"))
    return path

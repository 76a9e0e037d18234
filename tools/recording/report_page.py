"""The page of a report: a title, sections, and in each section texts, tables, figures and preformatted text.

    table = Table(["controller", "RMSE [mrad]"], rows)
    picture = svg_figure(figure, "what it shows", "what to note in it")  # a matplotlib figure
    write_page(path, page("Study", [Section("Errors", [table, picture])]), inputs)

Nothing is fetched from anywhere: styles and figures are in the file.  It follows the reader's light or dark scheme and
prints in black on white.

Everything that is text is escaped; only `Figure.svg` is taken as it is, so it must come from `svg_figure`.  A figure's
colours follow the page, so that one figure serves light, dark and print: what is drawn with the colours of
`tools.drawing` (and the default text and axes) gets the variables of the page.  Text stays text.  Pictures inside
(rasterised points) become embedded PNG.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from rich.table import Table as TerminalTable

from jointctl.drivers.errors import DataError, printable
from jointctl.tools.drawing import COLOURS, canvas, save_figure
from jointctl.tools.output import Output, cell_text
from jointctl.tools.written_file import replace_file, require_target

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

_TEMPLATE = "page.html.j2"
_NUMBER = re.compile(r"[-+]?[0-9][0-9.,]*(e[-+]?[0-9]+)?( ?%)?$")
_PAIR = re.compile(r"(?<=\d), (?=-?\d)")
_RANGE = "\N{NO-BREAK SPACE}..\N{NO-BREAK SPACE}"


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


def _shown(value: object) -> Any:
    """What is text on the page, without what a browser would obey; markup (`Figure.svg`) is left as it is."""
    return printable(value, keep="\n\t") if isinstance(value, str) and not hasattr(value, "__html__") else value


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("jointctl.tools.recording", "."),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def page(title: str, sections: Sequence[Section], *, subtitle: str = "") -> str:
    """The HTML text, with the time now at its foot."""
    made_at = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
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


# --- matplotlib figures as SVG markup ---


def draw(height_in: float, paint: Callable[[Picture], None], alt: str, caption: str = "") -> Figure:
    """A figure of the page's width: `paint(figure)` draws into a `matplotlib.figure.Figure` in the page's style."""
    with canvas(height_in) as figure:
        paint(figure)
        return svg_figure(figure, alt, caption)


def svg_figure(figure: Picture, alt: str, caption: str = "") -> Figure:
    """A matplotlib figure, drawn on a `canvas`, as a figure of the page."""
    data = io.StringIO()
    save_figure(figure, data, format="svg", dpi=150, metadata={"Date": None, "Creator": None}, hashsalt=alt)
    return Figure(alt, _inline(data.getvalue(), alt), caption)


def _inline(text: str, alt: str) -> str:
    """Only the <svg> element, its names unlike those of any other figure, its colours those of the page."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    mark = "f" + hashlib.sha256((alt + text).encode()).hexdigest()[:8]
    text = re.sub(r'\bid="', f'id="{mark}-', text)
    text = re.sub(r'(xlink:href="|url\()#', rf"\1#{mark}-", text)
    for name, colour in COLOURS.items():
        # in a style, since a presentation attribute knows no variables
        text = text.replace(colour, f"var(--{name})")
    return text


# --- the page of a verb whose result is shown in the terminal as well: the same tables, the same pictures ---


def from_terminal(table: TerminalTable) -> Table:
    """A table of the terminal as one of the page; without styles."""
    named = [(cell_text(column.header) if table.show_header else "", column) for column in table.columns]
    columns = [(heading, [_unbroken(cell_text(cell)) for cell in column.cells]) for heading, column in named]
    # a column that says nothing is left out
    columns = [(heading, cells) for heading, cells in columns if any(cells) or not (heading and cells)]
    notes = [cell_text(part) for part in (table.title, table.caption) if part]
    rows = list(zip(*(cells for _, cells in columns), strict=True))
    return Table([heading for heading, _ in columns], rows, caption=". ".join(notes))


def _unbroken(text: str) -> str:
    """A range or a pair of numbers is not broken in its middle."""
    return _PAIR.sub(",\N{NO-BREAK SPACE}", text.replace(" .. ", _RANGE))


def remarks(lines: Sequence[str], tone: str = "warning") -> list[Block]:
    """Each line a paragraph of its own."""
    return [Paragraph(line, tone) for line in lines]


def write_verb_page(
    path: Path, title: str, sections: Sequence[Section], output: Output, *, subtitle: str = "",
    inputs: Sequence[Path] = (),
) -> None:  # fmt: skip
    """Write the page and say so; sections without content are left out."""
    write_page(path, page(title, [section for section in sections if section.blocks], subtitle=subtitle), inputs)
    output.note(f"written: {path}")

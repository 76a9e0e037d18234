"""One style for every matplotlib picture: a PNG on white as a file, or SVG whose colours follow the page it stands on.

Draw on a `canvas` with the colours of `COLOURS` (and the default text and axes); `tools.recording.report_page` replaces
each of them by a variable of the page.  matplotlib is slow to import, and only wanted here.  No display is needed.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TextIO

from jointctl.drivers.errors import UsageError, printable
from jointctl.tools.written_file import refuse_overwriting, refuse_unwritable, replace_file, writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# the numbers only mark what to replace; near the page's light colours, so that a plain viewer is right as well
COLOURS = {
    "ink": "#1c2431",
    "soft": "#5b6676",
    "line": "#d9dee6",
    "blue": "#1f5fa9",
    "orange": "#c96f13",
    "green": "#2f8045",
    "red": "#b3282e",
    "violet": "#7a4fa4",
    "grey": "#6b7281",
    "wash-1": "#e3edf9",
    "wash-2": "#f8ecda",
    "wash-3": "#eceff4",
}
INK, SOFT, LINE, BLUE, ORANGE, GREEN, RED, VIOLET, GREY = (
    COLOURS[name] for name in ("ink", "soft", "line", "blue", "orange", "green", "red", "violet", "grey")
)
SERIES = (BLUE, ORANGE, GREEN, VIOLET, RED, GREY)
# these stay what they are: legible on white and on black, for a seventh line and for rasterised points
TEAL, MID_BLUE, MID_GREEN, MID_RED = "#3b8ea5", "#7fa3cc", "#4fa866", "#e0524f"
EITHER_WAY = (TEAL, MID_BLUE, MID_GREEN, MID_RED)
WIDTH_in = 10.0
_PNG_DPI = 110
STYLE: Any = {
    "svg.fonttype": "none",
    "text.parse_math": False,  # a name may hold dollar signs
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "axes.grid": True,
    "grid.color": LINE,
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "axes.xmargin": 0.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.1,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}


@contextmanager
def canvas(height_in: float, title: str = "") -> Iterator[Figure]:
    """A `matplotlib.figure.Figure` of the common width; what is drawn inside the `with` has the style."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_in, height_in), layout="constrained")
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
        yield figure


_POWER = re.compile(r"\$\\mathdefault\{(.*?)\^\{(\S+?)\}\}\$")
_RAISED = str.maketrans("0123456789-\N{MINUS SIGN}", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁻")


FEW_DECADES = 100.0  # between the ends of a logarithmic axis


def _label_logarithmic(figure: Figure) -> None:
    """Powers of ten as "10³": formulas are not set (`text.parse_math`), since a name may look like one.

    On an axis of few decades 1, 2 and 5 of each: there may be no power, and labels of all steps would overlap.  Where
    there is one of these alone, equal steps.
    """
    from matplotlib.ticker import AutoLocator, LogFormatterMathtext, LogFormatterSciNotation, LogLocator, NullFormatter

    class Powers(LogFormatterSciNotation):
        def __call__(self, x: float, pos: int | None = None) -> str:
            text = _POWER.sub(lambda found: found[1] + found[2].translate(_RAISED), super().__call__(x, pos))
            return text.replace(r"\times", "\N{MULTIPLICATION SIGN}").removeprefix("$\\mathdefault{").removesuffix("}$")

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if not isinstance(axis.get_major_formatter(), LogFormatterMathtext):
                continue
            low, high = sorted(axis.get_view_interval())
            if high < FEW_DECADES * low:
                few = LogLocator(subs=(1.0, 2.0, 5.0))
                several = sum(low <= at <= high for at in few.tick_values(low, high)) > 1
                axis.set_major_locator(few if several else AutoLocator())
                axis.set_major_formatter(lambda x, _: f"{x:g}" if "e" not in f"{x:g}" else Powers()(x))
                axis.set_minor_formatter(NullFormatter())
            else:
                axis.set_major_formatter(Powers(labelOnlyBase=True))
                axis.set_minor_formatter(Powers(labelOnlyBase=False))


def save_figure(figure: Figure, target: BinaryIO | TextIO, **how: Any) -> None:
    """matplotlib's `savefig` in the common style; names in titles and legends are shown as they may be."""
    import matplotlib
    from matplotlib.text import Text

    _label_logarithmic(figure)
    for text in figure.findobj(Text):
        text.set_text(printable(text.get_text(), keep="\n"))
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": how.pop("hashsalt", None)}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from")  # drawn as a box
        figure.savefig(target, **how)


def png(figure: Figure) -> bytes:
    """The picture on white, for a file."""
    data = io.BytesIO()
    save_figure(figure, data, format="png", dpi=_PNG_DPI, facecolor="white")
    return data.getvalue()


def require_png(path: Path, inputs: Iterable[Path]) -> None:
    """For `--figure`, before the work: `UsageError` without .png; `DataError` if it would overwrite an input."""
    if path.suffix.lower() != ".png":
        raise UsageError(f"--figure (={path}) must end in .png")
    refuse_overwriting(path, inputs)
    refuse_unwritable(path)


def save_png(figure: Figure, path: Path) -> Path:
    """`png` into a file, whose folder is made; returns the path.  `DataError` if it cannot be written."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, png(figure))
    return path

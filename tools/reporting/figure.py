"""matplotlib figures as SVG markup whose colours follow the page, so that one figure serves light, dark and print.

Draw with the colours of `COLOURS` (and the default text and axes); each is replaced by a variable of the page.
Text stays text.  Pictures inside (rasterised points) become embedded PNG.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable
from typing import Any

from tools.reporting.page import Figure

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
WIDTH_in = 10.0
_STYLE: Any = {
    "svg.fonttype": "none",
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


def draw(height_in: float, paint: Callable[[Any], None], alt: str, caption: str = "") -> Figure:
    """A figure of the page's width: `paint(figure)` draws into a `matplotlib.figure.Figure` in the page's style."""
    import matplotlib
    from matplotlib.figure import Figure as Canvas

    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": alt}):
        figure = Canvas(figsize=(WIDTH_in, height_in), layout="constrained")
        paint(figure)
        return svg_figure(figure, alt, caption)


def svg_figure(figure: Any, alt: str, caption: str = "") -> Figure:
    """Any matplotlib figure as a figure of the page; without the style of `draw` it keeps its own colours."""
    data = io.StringIO()
    figure.savefig(data, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    return Figure(alt, caption, svg=_inline(data.getvalue(), alt))


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

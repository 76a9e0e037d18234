"""matplotlib figures as SVG markup whose colours follow the page, so that one figure serves light, dark and print.

What is drawn with the colours of `tools.drawing` (and the default text and axes) gets the variables of the page.
Text stays text.  Pictures inside (rasterised points) become embedded PNG.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable
from typing import Any

from jointctl.tools.drawing import COLOURS, canvas, save_figure
from jointctl.tools.reporting.page import Figure


def draw(height_in: float, paint: Callable[[Any], None], alt: str, caption: str = "") -> Figure:
    """A figure of the page's width: `paint(figure)` draws into a `matplotlib.figure.Figure` in the page's style."""
    with canvas(height_in) as figure:
        paint(figure)
        return svg_figure(figure, alt, caption)


def svg_figure(figure: Any, alt: str, caption: str = "") -> Figure:
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

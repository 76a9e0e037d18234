"""What is asked of every figure on a page: it is there as markup, and all its colours are the page's."""

from __future__ import annotations

import re

from jointctl.tools.drawing import EITHER_WAY

NO_PICTURE: dict[str, str | bytes] = {"svg": "<svg></svg>", "png": b""}  # by format, for tests that look at none


def svgs(html: str) -> list[str]:
    """Every figure of the page; an <img> would stay white on a dark page."""
    assert "<img" not in html
    return re.findall(r"<svg.*?</svg>", html, re.DOTALL)


def foreign_colours(svg: str) -> set[str]:
    """Colours that neither follow the page nor are legible on white and on black alike; text without a colour."""
    named = set(re.findall(r"#[0-9a-f]{6}\b", re.sub(r'(href|id)="[^"]*"|url\([^)]*\)', "", svg))) - set(EITHER_WAY)
    # a power of ten is several pieces of text in a group, which has the colour
    texts = re.findall(r"(?:<g style=[^>]*>\s*)?<text[^>]*>", svg)
    return named | {text for text in texts if "fill: var(--" not in text}

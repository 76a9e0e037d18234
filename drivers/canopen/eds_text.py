"""The text of an EDS or DCF file (CiA 306) as sections of keys, whoever wrote it: nothing here raises for a bad line.

Section names and keys are compared without regard to case.  Every defect is one remark.
"""

from __future__ import annotations

import re
from pathlib import Path

from jointctl.drivers.errors import ConfigurationError

LARGEST_BYTES = 16_000_000
LONGEST_NUMBER = 40
LONGEST_SHOWN = 60
Sections = dict[str, dict[str, str]]

_LINE_END = re.compile(r"\r\n|\r|\n")
_SECTION = re.compile(r"\[\s*(.*?)\s*\]")
_NODE_ID = re.compile(r"\+?\$NODEID\+?")
_NUMBERS = (  # the first form counts; `int` by itself takes more, such as 1_0
    (re.compile(r"[+-]?0X[0-9A-F]+"), 16),
    (re.compile(r"[+-]?0[0-7]+"), 8),
    (re.compile(r"[+-]?[0-9]+"), 10),
    (re.compile(r"[0-9]*[A-F][0-9A-F]*"), 16),
)


def shown(text: str) -> str:
    """What a file holds, for a message: one line, no control characters, not too long."""
    clean = "".join(character if character.isprintable() else "?" for character in text)
    return clean if len(clean) <= LONGEST_SHOWN else clean[:LONGEST_SHOWN] + "..."


def decoded(data: bytes) -> tuple[str, list[str]]:
    """Text of UTF-8 (with or without byte order mark), UTF-16 with a mark, else Latin-1, which takes any byte."""
    remarks = []
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16", errors="replace")
        remarks.append("is UTF-16, CiA 306 asks for ASCII")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1").removeprefix("\xef\xbb\xbf")
            remarks.append("is not UTF-8: read as Latin-1")
    if "\0" in text:
        text = text.replace("\0", "")
        remarks.append("holds NUL characters, which were skipped")
    return text, remarks


def read_text(path: Path) -> tuple[str, list[str]]:
    """The file's text and what is odd about its encoding; `ConfigurationError` if it cannot be read at all."""
    refusal = f"drive.eds (={path}) is not a readable EDS file:"
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise ConfigurationError(f"{refusal} {path.stat().st_size} bytes, at most {LARGEST_BYTES} are read")
        return decoded(path.read_bytes())
    except OSError as error:
        raise ConfigurationError(f"{refusal} {error.strerror or error}") from error


def parse_sections(text: str) -> tuple[Sections, list[str]]:
    """Sections by their name in lower case, keys in lower case.  What comes first counts."""
    sections: Sections = {}
    remarks: list[str] = []
    current: dict[str, str] | None = None
    name = ""
    for number, raw in enumerate(_LINE_END.split(text), start=1):
        line = raw.strip()
        if not line or line[0] in ";#":
            continue
        header = _SECTION.match(line)
        if header is not None:
            name = header[1].lower()
            if name in sections:
                remarks.append(f"line {number}: [{shown(header[1])}] a second time: only what the first lacks is taken")
            current = sections.setdefault(name, {})
            continue
        key, equals, value = line.partition("=")
        if not equals or not key.strip():
            remarks.append(f"line {number}: neither [section] nor key=value: skipped")
        elif current is None:
            remarks.append(f"line {number}: before the first section: skipped")
        else:
            key, value = key.strip().lower(), re.split(r"\s;", value, maxsplit=1)[0].strip()
            if current.setdefault(key, value) != value:
                remarks.append(f"line {number}: [{shown(name)}] {shown(key)} a second time with another value: skipped")
    return sections, remarks


def number_of(text: str, node: int) -> int | None:
    """A number as CiA 306 writes it: decimal, 0x.., octal with a leading 0, $NODEID+..; None if it is none.

    Hexadecimal digits without 0x are taken where they can be nothing else (1F).
    """
    compact = re.sub(r"\s", "", text)
    if len(compact) > LONGEST_NUMBER or not compact.isascii():
        return None
    compact = compact.upper().rstrip("UL")
    if "$NODEID" in compact:
        rest = _NODE_ID.sub("", compact)
        offset = number_of(rest, node) if rest else 0
        return None if offset is None else offset + node
    for form, base in _NUMBERS:
        if form.fullmatch(compact):
            return int(compact, base)
    return None

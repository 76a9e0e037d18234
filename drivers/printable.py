"""Text of others (names of files and devices, values, what a library says) as it may be shown: one line, no control.

What a terminal or a browser would obey instead of show is escaped as JSON and TOML write it: ESC is `\\u001b`.  Both
are applied where text leaves the program (`JointctlError`, `tools.output`, pages), not where a message is made; applied
twice, they change nothing more.
"""

from __future__ import annotations

import re

LONGEST_VALUE = 120  # characters of a value in a message
LONGEST_MESSAGE = 2000
_TAIL = 40  # of a value that is cut: a file's name stands at the end of its path
# C0, C1; what is invisible or turns the direction of writing; line separators; lone surrogates (names that are no
# UTF-8); tags
_CONTROL = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    "\ud800-\udfff\U000e0000-\U000e0fff]"
)
_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}
_INDENTED_BREAK = re.compile(r"[ \t]*\n[ \t]+|[ \t]+\n")
_WORD = re.compile(rf"([(=\"']{{0,3}})(\S{{{LONGEST_VALUE - 5},}}?)([)\"':;,.]{{0,3}})(?!\S)")
# a value in brackets, or in quotes that are no apostrophe; what begins a line up to a colon is the name of a file
_VALUES = (
    re.compile(r"(?<=\(=).*?(?=\)(?:[ :,;.]|$))"),
    re.compile(r"(?<!\w)'.*?'(?!\w)"),
    re.compile(r'(?<!\w)".*?"(?!\w)'),
    re.compile(r"^[^:]*(?=: )"),
)


def printable(text: str, keep: str = "") -> str:
    """Every control character, line break, direction mark and lone surrogate as its escape; but those of `keep`."""
    return _CONTROL.sub(lambda found: found[0] if found[0] in keep else _escaped(found[0]), text)


def _escaped(character: str) -> str:
    code = ord(character)
    return _SHORT.get(character) or (f"\\u{code:04x}" if code <= 0xFFFF else f"\\U{code:08x}")


def shortened(value: str) -> str:
    """At most `LONGEST_VALUE` characters: beginning and end."""
    if len(value) <= LONGEST_VALUE:
        return value
    return f"{value[: LONGEST_VALUE - _TAIL - 3]}...{value[-_TAIL:]}"


def message_line(text: str) -> str:
    """A message as one printable line whose values are cut.

    What a value is shows in how messages are written: `(=value)`, `'value'`, `file: ...`, and any word of that length.
    """
    line = printable(text)
    if len(line) <= LONGEST_VALUE:
        return line
    for value in _VALUES:
        line = value.sub(lambda found: shortened(found[0]), line)
    line = _WORD.sub(lambda found: found[1] + shortened(found[2]) + found[3], line)
    return line if len(line) <= LONGEST_MESSAGE else f"{line[: LONGEST_MESSAGE - 3]}..."


def one_line(text: str) -> str:
    """As `message_line`; a text that was broken and indented is put together again."""
    return message_line(re.sub(r" {2,}", " ", _INDENTED_BREAK.sub(" ", text)).strip())

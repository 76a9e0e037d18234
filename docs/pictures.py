"""The pictures of docs/python.md: cells of examples/joint.ipynb that name one are run, and what they draw is kept.

python docs/pictures.py [FOLDER]
"""

from __future__ import annotations

import base64
import sys
from collections.abc import Iterator
from pathlib import Path

import nbclient
import nbformat

DOCS = Path(__file__).resolve().parent
NOTEBOOK = DOCS.parent / "examples" / "joint.ipynb"


def pictures(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Name and PNG of each, from a notebook that is executed in `folder`."""
    book = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in book.cells:
        drawn = [
            output.data["image/png"] for output in cell.get("outputs", ()) if "image/png" in output.get("data", {})
        ]
        if "picture" in cell.metadata:
            yield f"{cell.metadata['picture']}.png", base64.b64decode(drawn[0])


if __name__ == "__main__":
    target = Path(sys.argv[1]) if sys.argv[1:] else DOCS
    for name, png in pictures(target):
        (target / name).write_bytes(png)

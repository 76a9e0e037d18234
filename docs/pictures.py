"""What the pages show of runs, made anew: pictures of notebook, demo, first hour and page, and the table of `paper`.

python docs/pictures.py [notebook] [demo] [first_hour] [page] [paper]     all of them, without a word

The page needs the extra `scope`, websockets and a Chromium.
"""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
NOTEBOOK = ROOT / "examples" / "joint.ipynb"
LAW = DOCS / "law.md"
JOINTCTL = (sys.executable, "-P", "-m", "jointctl.tools.verbs")
HEADING = "| experiment | paper | ours | `precise` |"
PATIENCE = {"heartbeat_s": 0.4, "sample_age_max_s": 0.2, "skipped_max_s": 0.2, "duration_s": 60.0}  # a browser draws
TRACKING_s = 12.0  # before the page is taken


def pictures(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Name and PNG of each, from a notebook that is executed in `folder`."""
    import nbclient
    import nbformat

    book = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in book.cells:
        drawn = [
            output.data["image/png"] for output in cell.get("outputs", ()) if "image/png" in output.get("data", {})
        ]
        if "picture" in cell.metadata:
            yield f"{cell.metadata['picture']}.png", base64.b64decode(drawn[0])


def notebook(folder: Path) -> None:
    for name, png in pictures(folder):
        (DOCS / name).write_bytes(png)


def demo(folder: Path) -> None:
    """The picture that `jointctl demo` leaves."""
    subprocess.run([*JOINTCTL, "demo"], cwd=folder, check=True)
    (picture,) = folder.glob("runs/*.png")
    (DOCS / "demo.png").write_bytes(picture.read_bytes())
    smaller(DOCS / "demo.png")


def first_hour(folder: Path) -> None:
    """Friction and margins, by the commands of docs/first-hour.md."""
    made = {"sweep.friction.png": "friction.png", "loop.png": "margins.png"}
    wanted = ("jointctl new", "jointctl sweep", "jointctl identify sweep.csv", "sed -i", "jointctl check")
    for line in (DOCS / "first-hour.md").read_text(encoding="utf-8").splitlines():
        if line.startswith(wanted) and " other.csv" not in line:
            line = line.replace("jointctl", " ".join(JOINTCTL), 1)
            subprocess.run(line, shell=True, cwd=folder, check=True)
    for name, picture in made.items():
        (DOCS / picture).write_bytes((folder / name).read_bytes())
        smaller(DOCS / picture)


def smaller(picture: Path) -> None:
    """In 64 colours, which are enough for lines and letters."""
    from PIL import Image

    Image.open(picture).convert("RGB").quantize(64).save(picture, optimize=True)


def page(folder: Path) -> None:
    """The page of a run on the virtual joint, while it tracks."""
    sys.path.insert(0, str(ROOT))
    from tests.browser import Browser, free_port

    channel, port = f"docs-{os.getpid()}", str(free_port())
    text = (ROOT / "configs" / "virtual.toml").read_text(encoding="utf-8")
    for key, value in PATIENCE.items():
        text = re.sub(rf"(?m)^{key} = \S+", f"{key} = {value}", text)
    (folder / "joint.toml").write_text(text, encoding="utf-8")
    joint = subprocess.Popen([*JOINTCTL, "hil", "joint.toml", "-c", channel], cwd=folder)
    printed = folder / "printed"
    try:
        time.sleep(5.0)
        with printed.open("w") as stream:
            words = [*JOINTCTL, "run", "joint.toml", "-c", channel, "-y", "--scope", "--scope-port", port]
            run = subprocess.Popen(words, cwd=folder, stdout=stream, stderr=stream)
        try:
            while (found := re.search(r"scope: (http://\S+)", printed.read_text())) is None:
                time.sleep(0.1)
                if run.poll() is not None:
                    raise SystemExit(printed.read_text())
            with Browser(folder, 1280, 820) as browser:
                tab = browser.open(found[1])
                tab.until("document.querySelector('[data-testid=\"state\"]').innerText.includes('tracking')", 60.0)
                time.sleep(TRACKING_s)
                if run.poll() is not None:
                    raise SystemExit(printed.read_text())
                tab.picture(DOCS / "page.png")
                smaller(DOCS / "page.png")
        finally:
            run.terminate()
            run.wait()
    finally:
        joint.terminate()
        joint.wait()


def paper_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows of `jointctl paper --json`, without reference and note."""
    shown = [[row[key].replace("|e|", "error") for key in ("experiment", "paper", "ours", "precise")] for row in rows]
    lines = (f"| {' | '.join(row)} |".replace("|  |", "| |") for row in shown)
    return "\n".join([HEADING, "|---|---|---|---|", *lines])


def paper(folder: Path) -> None:
    """The table of docs/law.md."""
    done = subprocess.run([*JOINTCTL, "paper", "--json"], cwd=folder, check=True, capture_output=True, text=True)
    text = LAW.read_text(encoding="utf-8")
    before, _, after = text.partition(HEADING)
    table, rest = paper_table(json.loads(done.stdout)["rows"]), after.partition("\n\n")[2]
    LAW.write_text(f"{before}{table}\n\n{rest}", encoding="utf-8")


PARTS: dict[str, Callable[[Path], None]] = {
    "notebook": notebook, "demo": demo, "first_hour": first_hour, "page": page, "paper": paper,
}  # fmt: skip

if __name__ == "__main__":
    for part in sys.argv[1:] or PARTS:
        with tempfile.TemporaryDirectory() as work:
            PARTS[part](Path(work))

"""What `mkdocs` adds to the pages of this folder: the API reference, and the files of the repository that they link to.

The Markdown stays as a forge shows it: a link to `../configs/` or `../README.md` leads to that file there, and to a
page of its own in the site.
"""

from __future__ import annotations

import inspect
import json
import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pygments.formatters import HtmlFormatter

import jointctl
from jointctl.verbs import VERBS

ROOT = Path(__file__).resolve().parent.parent
DOCS, COPIES = "docs", "repository"  # of the repository; of the site, for what is not in DOCS
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#|/)([^)\s#]+)")
FENCE = re.compile(r"^```(\w+) .*$", re.MULTILINE)  # with a reason why a test does not run it

# the theme breaks no line in a table and leaves half of a wide window empty
WIDE = ".wy-nav-content {max-width: 1100px} .wy-table-responsive table td {white-space: normal}\n"


def uri_of(path: str) -> str:
    """Where the site has a file or folder of the repository."""
    if path.startswith(f"{DOCS}/"):
        return path.removeprefix(f"{DOCS}/") + ("/README.md" if (ROOT / path).is_dir() else "")
    return f"{COPIES}/{path}" + ("" if path.endswith(".md") else ".md")


def path_of(uri: str) -> str:
    """The file of the repository behind a page."""
    if not uri.startswith(f"{COPIES}/"):
        return f"{DOCS}/{uri}"
    path = uri.removeprefix(f"{COPIES}/")
    return path if (ROOT / path).exists() else path.removesuffix(".md")


def is_text(path: str) -> bool:
    """Whether what looks like a link there is one: it is no program."""
    return path.endswith((".md", ".ipynb")) or (ROOT / path).is_dir()


def linked(path: str, text: str) -> list[str]:
    """What is linked to, as paths in the repository."""
    return [posixpath.normpath(posixpath.join(posixpath.dirname(path), target)) for target in LINK.findall(text)]


def copied(path: str) -> str:
    """The page for a file or folder outside of DOCS."""
    source = ROOT / path
    if source.is_dir():
        files = sorted(file.name for file in source.iterdir() if file.is_file())
        return f"# {path}\n\n" + "\n".join(f"- [{name}]({source.name}/{name})" for name in files)
    text = source.read_text()
    if source.suffix == ".md":
        return text
    if source.suffix == ".ipynb":
        cells = [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"]]
        return "\n\n".join(words if kind == "markdown" else f"```python\n{words}\n```" for kind, words in cells)
    language = {".py": "python", ".toml": "toml", ".json": "json", ".c": "c", ".h": "c"}.get(source.suffix, "text")
    return f"# {path}\n\n~~~~{language}\n{text}\n~~~~\n"


def option_rows(name: str) -> str:
    """The options of a verb as rows of a table."""
    function = getattr(jointctl, name)
    words = (inspect.getdoc(function) or "").rpartition("\n\n")[2]
    helped = dict(line.split(": ", 1) for line in words.splitlines())
    rows = []
    for key, option in inspect.signature(function).parameters.items():
        kind = inspect.formatannotation(option.annotation).removesuffix(" | None").replace("pathlib.", "")
        default = "" if option.default is option.empty else f"`{option.default}`"
        rows.append(f"| `{key}` | `{kind}` | {default} | {helped.get(key, '')} |\n")
    return "".join(rows)


def api_page() -> str:
    """`jointctl.__all__`: classes and functions from their docstrings, commands with their options, results, errors."""
    names = [name for name in jointctl.__all__ if name not in (*VERBS, "__version__")]
    errors = [name for name in names if name.endswith(("Error", "Fault"))]
    results = {"Identification", "RunLog"}
    text = "# API reference\n\nWhat `jointctl.__all__` names; it stays from version to version.\n\n"
    text += "".join(f"::: jointctl.{name}\n\n" for name in names if name not in errors)
    text += "## Commands as functions\n\nThe options of each command by name ([Python](python.md#commands)).\n\n"
    for name in sorted(VERBS):
        function = getattr(jointctl, name)
        result = str(inspect.signature(function).return_annotation)
        results |= set(re.findall(r"[A-Z]\w+", result)) - {"None", "Any", "Path"}
        what = (inspect.getdoc(function) or "").rpartition("\n\n")[0]
        text += f"### {name}\n\nReturns `{result}`. {what}\n\n"
        text += f"| option | type | default | |\n|---|---|---|---|\n{option_rows(name)}\n"
    for title, listed in (("Results", [f"verbs.{name}" for name in sorted(results)]), ("Errors", errors)):
        text += f"## {title}\n\n"
        text += "".join(f"::: jointctl.{name}\n    options: {{heading_level: 3}}\n\n" for name in listed)
    return text


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in the folder."""
    files.append(File.generated(config, "api.md", content=api_page()))
    files.append(File.generated(config, "added.css", content=WIDE + str(HtmlFormatter().get_style_defs(".codehilite"))))
    todo = [path for file in files.documentation_pages() for path in linked(path_of(file.src_uri), file.content_string)]
    while todo:
        path = todo.pop()
        if files.get_file_from_path(uri_of(path)) is None and (ROOT / path).exists():
            content = copied(path)
            files.append(File.generated(config, uri_of(path), content=content))
            if is_text(path):
                todo += linked(path, content)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links lead to where the site has what they lead to."""
    uri, path = page.file.src_uri, path_of(page.file.src_uri)
    if not is_text(path):
        return markdown

    def moved(match: re.Match[str]) -> str:
        (target,) = linked(path, f"]({match[1]})")
        return posixpath.relpath(uri_of(target), posixpath.dirname(uri)) if (ROOT / target).exists() else match[1]

    return FENCE.sub(r"```\1", LINK.sub(moved, markdown))

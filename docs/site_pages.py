"""Pages of the site that are written elsewhere: README.md and its neighbours, the notebook, what the command
line says of itself, and the Python reference.

mkdocs calls `on_files` before it reads any page (mkdocs.yml, hooks).
"""

from __future__ import annotations

import io
import json
import os
import re
from contextlib import redirect_stdout, suppress
from pathlib import Path
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import keyss
from keyss.cli import main
from keyss.cli.entry import MODULES

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "LICENSE": "licence.md",
    "examples/tour.ipynb": "tour.md",
}
TOUR = "examples/tour.ipynb"
LINK = re.compile(r"(?<=\]\()([^)\s#]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that have no file in docs/."""
    for source, page in PAGES.items():
        if source == TOUR:
            continue
        text = (ROOT / source).read_text()
        if source == "LICENSE":
            text = f"# Licence\n\n```text\n{text}```\n"
        files.append(File.generated(config, page, content=LINK.sub(from_the_root, text)))
    for page, content in (("tour.md", tour()), ("commands.md", commands()), ("api.md", reference())):
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links from docs/ to files beside it lead to their pages."""
    return LINK.sub(lambda link: PAGES.get(link[1].removeprefix("../"), link[1]), markdown)


def from_the_root(link: re.Match[str]) -> str:
    """A link of a file in the root as one of a file in docs/."""
    return PAGES.get(link[1], link[1].removeprefix("docs/"))


def tour() -> str:
    """The notebook: its texts, its code, and what that printed and drew when it was last run."""
    parts = []
    for cell in json.loads((ROOT / TOUR).read_text())["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text.replace("](../docs/", "]("))
            continue
        parts.append(f"```python\n{text}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                parts.append(f"![](data:image/png;base64,{''.join(data['image/png']).strip()})")
            else:
                printed = "".join(output.get("text", data.get("text/plain", ""))).rstrip()
                parts.append(f"```text\n{printed}\n```")
    return "\n\n".join(parts) + "\n"


def commands() -> str:
    """What `--help` says of every command, as it is."""
    text = "# Commands\n\nWhat `keyss COMMAND --help` says.\n"
    for command in MODULES:
        said = io.StringIO()
        plain = mock.patch.dict(os.environ, {"COLUMNS": "100", "NO_COLOR": "1"})
        with plain, redirect_stdout(said), suppress(SystemExit):
            main([command, "--help"])
        lines = "\n".join(line.rstrip() for line in said.getvalue().strip().splitlines())
        text += f"\n## {command}\n\n```text\n{lines}\n```\n"
    return text


def reference() -> str:
    """One entry for each public name of the package."""
    text = "# Python reference\n\nThe public names of `keyss`.\n"
    names = [f"keyss.{name}" for name in keyss.__all__ if not name.startswith("_")]
    return text + "".join(f"\n::: {name}\n" for name in names)

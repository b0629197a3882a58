"""Pages of the site that are written elsewhere: README.md and its neighbours, and the Python reference.

mkdocs calls `on_files` before it reads any page (mkdocs.yml, hooks).
"""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "LICENSE": "licence.md",
}
LINK = re.compile(r"(?<=\]\()([^)\s#]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that have no file in docs/."""
    for source, page in PAGES.items():
        text = (ROOT / source).read_text()
        if source == "LICENSE":
            text = f"# Licence\n\n```text\n{text}```\n"
        files.append(File.generated(config, page, content=LINK.sub(from_the_root, text)))
    files.append(File.generated(config, "reference.md", content=reference()))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links from docs/ to files beside it lead to their pages."""
    return LINK.sub(lambda link: PAGES.get(link[1].removeprefix("../"), link[1]), markdown)


def from_the_root(link: re.Match[str]) -> str:
    """A link of a file in the root as one of a file in docs/."""
    return PAGES.get(link[1], link[1].removeprefix("docs/"))


def reference() -> str:
    """One entry for each public name of the package, in the order of `keyss.__all__`."""
    names = re.search(r"__all__ = \[(.*?)\]", (ROOT / "src/keyss/__init__.py").read_text(), re.DOTALL)
    assert names is not None
    public = [name for name in re.findall(r'"(\w+)"', names[1]) if not name.startswith("_")]
    text = "# Python reference\n\nThe public names of `keyss`.\n"
    return text + "".join(f"\n::: keyss.{name}\n" for name in public)

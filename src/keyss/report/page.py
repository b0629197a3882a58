"""The page around the sections: one file that loads nothing and, by its own policy, may not."""

from __future__ import annotations

import hashlib
from base64 import b64encode
from collections.abc import Sequence
from importlib.resources import files

from keyss.report.markup import Html, element, join
from keyss.report.sections import Section


def page(title: str, facts: Html, sections: Sequence[Section]) -> str:
    """A whole HTML document."""
    script = _asset("slider.js")
    style = "".join(_asset(name) for name in ("page.css", "pictures.css", "print.css"))
    # Should markup ever slip through the escaping, browsers run no script but this one and fetch nothing.
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", name="referrer", content="no-referrer"),
        element("title", f"{title} · keyss"),
        element("style", Html(style)),
    )
    links = [element("li", element("a", section.title, href=f"#{section.id}")) for section in sections]
    body = element(
        "body",
        element(
            "header",
            element("h1", title),
            element("p", "This page shows the secret: keep it as you keep the key.", class_="warning"),
            facts,
            element("nav", element("ul", *links), aria_label="Sections"),
        ),
        element("main", *(_section(section) for section in sections)),
        element("script", Html(script)),
    )
    return f"<!doctype html>\n{element('html', head, body, lang='en')}\n"


def _section(section: Section) -> Html:
    heading = element("h2", section.title, id=f"{section.id}-title")
    return element(
        "section", join([heading, section.content]), id=section.id, aria_labelledby=f"{section.id}-title"
    )


def _asset(name: str) -> str:
    return files("keyss.report").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    return b64encode(hashlib.sha256(script.encode()).digest()).decode()

"""HTML that is escaped by construction: text becomes markup in `element` and nowhere else."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

_EMPTY = frozenset({"img", "input", "meta"})  # elements without an end tag


class Html(str):
    """Markup that may go into a page as it is. Any other string is text."""


Content = str | None  # Html is taken as it is, other strings are escaped, None is nothing


def element(tag: str, *children: Content, **attributes: str | bool | None) -> Html:
    """One element. Of attribute names, `class_` means `class` and `aria_label` means `aria-label`.

    True gives a bare attribute; False and None leave it out. Values are escaped even if they are Html.
    """
    start = f"<{tag}{''.join(_attribute(name, value) for name, value in attributes.items())}>"
    return Html(start if tag in _EMPTY else f"{start}{join(children)}</{tag}>")


def join(children: Iterable[Content], between: str = "") -> Html:
    """Children one after another; `between` is escaped as they are."""
    return Html(_markup(between).join(_markup(child) for child in children if child is not None))


def prose(text: str) -> Html:
    """Text in which `backquotes` mark what is typed."""
    return join(element("code", part) if i % 2 else part for i, part in enumerate(text.split("`")))


def _markup(child: str) -> str:
    return child if isinstance(child, Html) else escape(child, quote=False)


def _attribute(name: str, value: str | bool | None) -> str:
    if value is None or value is False:
        return ""
    name = name.rstrip("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{escape(str(value))}"'

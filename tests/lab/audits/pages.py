"""The content of an HTML page, by Python's own parser."""

from __future__ import annotations

from html.parser import HTMLParser

_EMPTY = ("img", "input", "meta")
_LOADING = ("src", "href", "xlink:href", "srcset", "data", "action", "formaction", "poster", "background")


class Parsed(HTMLParser):
    """Tags, attributes, texts and scripts of a page. Fails on elements that are not closed in their order."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.texts: list[str] = []
        self.scripts: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in _EMPTY:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "script":
            self.scripts.append(data)
        elif not self._open or self._open[-1] != "style":
            self.texts.append(data)

    @property
    def text(self) -> str:
        """All text, with single spaces."""
        return " ".join(" ".join(self.texts).split())

    def values(self, name: str) -> list[str]:
        """The values of all attributes of a name."""
        return [value for found, value in self.attributes if found == name]

    def loads(self) -> list[str]:
        """External URLs in attributes."""
        found = [value for name, value in self.attributes if name in _LOADING]
        return [value for value in found if not value.startswith(("#", "data:image/png;base64,"))]

    def handlers(self) -> list[str]:
        """Attributes that hold scripts."""
        return [name for name, _ in self.attributes if name.startswith("on")]

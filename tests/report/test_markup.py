"""Text cannot become markup."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from keyss.report.markup import Html, element, join, prose
from report.pages import Parsed

TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r\0"))


@given(text=TEXT, value=TEXT)
def test_what_goes_in_is_what_a_parser_reads(text: str, value: str) -> None:
    page = Parsed(element("p", text, title=value))
    assert page.tags == ["p"]
    assert "".join(page.texts) == text
    assert page.values("title") == [value]


def test_html_goes_in_as_it_is_but_not_into_attributes() -> None:
    inner = element("b", "1 < 2")
    assert element("p", inner, None, "&") == "<p><b>1 &lt; 2</b>&amp;</p>"
    assert element("p", title=inner) == '<p title="&lt;b&gt;1 &amp;lt; 2&lt;/b&gt;"></p>'


def test_attributes() -> None:
    start = element("input", class_="a", aria_label="b", checked=True, hidden=False, value=None)
    assert start == '<input class="a" aria-label="b" checked>'


def test_join_escapes_what_it_joins() -> None:
    assert join(["<", Html("<br>"), None], between=" & ") == "&lt; &amp; <br>"


def test_backquotes_mark_what_is_typed() -> None:
    assert prose("run `a <b>` now") == "run <code>a &lt;b&gt;</code> now"
    assert prose("<i>") == "&lt;i&gt;"

"""The report of an audit, in Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import astuple
from pathlib import PurePath

from keyss.lab.audits.parts import PARTS
from keyss.lab.audits.record import Audit, headline

_WORDS = (
    "Fine: within the limit. Visible: without the key it may be visible that something is hidden, or what. "
    "Missed: nothing is visible, but the quality of cover or secret is too low. Inconclusive: plain models "
    "of the cover differ from each other as much; more --controls may help. The limits are conventions, and"
    " other measures might find what these do not."
)


def report_of(audit: Audit, pictures: str) -> str:
    """The report; `pictures`: the folder of the pictures, relative to the report."""
    return "\n".join(_lines(audit, pictures))


def _lines(audit: Audit, pictures: str) -> Iterator[str]:
    names = [PurePath(path).name or path for path in (*audit.secrets, audit.cover)]
    yield f"# {_escaped(' and '.join(names[:-1]))}, hidden in {_escaped(names[-1])}\n"
    yield "**This report shows the secret: protect it like the key.**\n"
    facts = {
        "Method": audit.method,
        "Cover": audit.cover,
        "Secrets": ", ".join(audit.secrets),
        "Published": f"{audit.gaussians:,} Gaussians",
        "Controls": f"plain models of the cover with the seeds {', '.join(map(str, audit.controls))}",
        "Not measured": ", ".join(part.title for name, part in PARTS.items() if name not in audit.sections),
        "Audit": f"keyss {audit.keyss}, {audit.seconds:.0f} s",
    }
    yield from (f"- {name}: {_escaped(value)}" for name, value in facts.items() if value)
    yield f"\n## Verdicts\n\n{_escaped(headline(audit.verdicts))}\n"
    rows = [astuple(verdict) for verdict in audit.verdicts]
    if rows:
        yield from _table(("measure", "measured", "baseline or control", "limit", "verdict"), rows)
        yield _WORDS
    for name, section in audit.sections.items():
        yield f"\n## {PARTS[name].title}\n\n{PARTS[name].note}\n"
        for table in section.tables:
            yield from _table(table.heads, table.rows)
        for caption, file in section.pictures.items():
            yield f"{_escaped(caption)}\n\n![{_escaped(caption)}]({pictures}/{file})\n"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(map(_escaped, heads))} |"
    yield "| --- " * len(heads) + "|"
    for row in rows:
        cells = [*map(_escaped, row), *[""] * (len(heads) - len(row))]
        yield f"| {' | '.join(cells)} |"
    yield ""


def _escaped(text: str) -> str:
    """`text` in one line, without markup of Markdown or HTML."""
    return re.sub(r"([\\`*_\[\]<>|#])", r"\\\1", " ".join(text.split()))

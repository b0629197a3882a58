"""All measures of one run: an audit, its record, and its report as an HTML page."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.audits.parts import PARTS as PARTS
    from keyss.audits.record import Audit as Audit, read_audit as read_audit
    from keyss.audits.run import audit as audit
    from keyss.audits.summary import (
        Verdict as Verdict,
        headline as headline,
        verdicts as verdicts,
    )
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.audits.parts": ["PARTS"],
            "keyss.audits.record": ["Audit", "read_audit"],
            "keyss.audits.run": ["audit"],
            "keyss.audits.summary": ["Verdict", "headline", "verdicts"],
        },
    )

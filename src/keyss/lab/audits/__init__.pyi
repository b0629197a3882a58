from .audit_run import Audit as Audit, audit as audit, read_audit as read_audit
from .parts import PARTS as PARTS
from .summary import Verdict as Verdict, headline as headline, verdicts as verdicts

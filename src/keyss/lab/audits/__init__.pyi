from .audit_run import audit as audit
from .parts import PARTS as PARTS
from .record import Audit as Audit, read_audit as read_audit
from .summary import Verdict as Verdict, headline as headline, verdicts as verdicts

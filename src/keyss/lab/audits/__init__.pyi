from .audit_run import audit as audit, read_audit as read_audit
from .parts import PARTS as PARTS
from .record import Audit as Audit, Section as Section, Verdict as Verdict, headline as headline

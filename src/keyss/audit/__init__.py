"""A hiding judged by all measures at once."""

from keyss._callable import make_callable
from keyss.audit.run import audit

__all__ = ["audit"]

make_callable(__name__, audit)

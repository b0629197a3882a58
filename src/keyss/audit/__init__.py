"""A hiding judged by all measures at once."""

from keyss.audit.run import audit

__all__ = ["audit"]

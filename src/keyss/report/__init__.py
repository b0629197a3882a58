"""From an audit to one HTML file that opens from disk."""

from keyss.report.page import write_report

__all__ = ["write_report"]

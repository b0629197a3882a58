"""From an audit to one HTML file that opens from disk."""

from keyss._callable import make_callable
from keyss.report.writing import write_report

__all__ = ["write_report"]

make_callable(__name__, write_report)

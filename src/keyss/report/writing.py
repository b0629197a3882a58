"""From the folder of a run to its report."""

from __future__ import annotations

from pathlib import Path

from keyss.core.errors import InputError
from keyss.files.atomic import write_bytes
from keyss.report.page import page
from keyss.report.untrusted import AuditPictures, check_bounds
from keyss.runs.audit_record import read_audit

REPORT = "report.html"


def write_report(run_folder: Path | str) -> Path:
    """Write RUN/report.html from RUN/audit, atomically, and return its path.

    One file that needs no network: pictures, figures, style and script are in it, and so it shows the secret.
    The same audit gives the same bytes. Raises InputError when there is no audit, or it is broken, too large
    or names pictures outside RUN/audit; OutputError when the file cannot be written.
    """
    run = Path(run_folder)
    audit = read_audit(run)
    try:
        check_bounds(audit)
    except RecursionError as error:
        raise InputError(f"{run}: the audit's configuration is nested too deeply") from error
    write_bytes(run / REPORT, page(audit, AuditPictures(run)).encode())
    return run / REPORT

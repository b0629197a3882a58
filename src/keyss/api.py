"""The verbs a person would say, over files or over objects: what the command line calls.

Each takes paths or what they hold, and writes files only where `out` is given. They are loaded at first use
(PEP 562): who reveals a secret need not wait for what trains and audits.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from keyss._verbs.asking import Secret
    from keyss._verbs.comparing import compare, plan_comparison
    from keyss._verbs.converting import Conversion, convert
    from keyss._verbs.filing import HideFilesResult, SecretFile, hide_files, reveal_file
    from keyss._verbs.filming import render_video
    from keyss._verbs.fitting import fit
    from keyss._verbs.hiding import HideResult, hide
    from keyss._verbs.looking import evaluate, render
    from keyss._verbs.opening import reveal, reveal_counted, verify
    from keyss._verbs.planning import plan
    from keyss._verbs.reproducing import download_scenes, plan_reproduction, reproduce
    from keyss.audit.run import audit
    from keyss.report.page import write_report
    from keyss.reproduction.asking import PaperTable
    from keyss.sweeps.batch import BatchResult, hide_batch
    from keyss.sweeps.sweep import SweepResult, sweep

__all__ = ["Conversion", "HideResult", "Secret", "audit", "convert", "evaluate", "fit", "hide", "plan"]
__all__ += ["render", "render_video", "reveal", "reveal_counted", "verify", "write_report"]
__all__ += ["PaperTable", "compare", "download_scenes", "plan_comparison", "plan_reproduction", "reproduce"]
__all__ += ["HideFilesResult", "SecretFile", "hide_files", "reveal_file"]
__all__ += ["BatchResult", "SweepResult", "hide_batch", "sweep"]

_HOMES = {
    "BatchResult": "sweeps.batch",
    "Conversion": "_verbs.converting",
    "HideFilesResult": "_verbs.filing",
    "HideResult": "_verbs.hiding",
    "PaperTable": "reproduction.asking",
    "SweepResult": "sweeps.sweep",
    "Secret": "_verbs.asking",
    "SecretFile": "_verbs.filing",
    "audit": "audit.run",
    "compare": "_verbs.comparing",
    "convert": "_verbs.converting",
    "download_scenes": "_verbs.reproducing",
    "evaluate": "_verbs.looking",
    "fit": "_verbs.fitting",
    "hide": "_verbs.hiding",
    "hide_batch": "sweeps.batch",
    "hide_files": "_verbs.filing",
    "plan": "_verbs.planning",
    "plan_comparison": "_verbs.comparing",
    "plan_reproduction": "_verbs.reproducing",
    "render": "_verbs.looking",
    "render_video": "_verbs.filming",
    "reproduce": "_verbs.reproducing",
    "reveal": "_verbs.opening",
    "reveal_counted": "_verbs.opening",
    "reveal_file": "_verbs.filing",
    "sweep": "sweeps.sweep",
    "verify": "_verbs.opening",
    "write_report": "report.page",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'keyss.api' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"keyss.{_HOMES[name]}"), name)
    return value

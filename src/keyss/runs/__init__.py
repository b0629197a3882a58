"""The folder of a run: what is written to it, and opening it again."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.runs.config import (
        FitRunConfig as FitRunConfig,
        RunConfig as RunConfig,
        read_config as read_config,
    )
    from keyss.runs.files import (
        CONFIG as CONFIG,
        METRICS as METRICS,
        MODEL as MODEL,
        REPORT as REPORT,
        STEGO as STEGO,
        stego_in as stego_in,
    )
    from keyss.runs.folder import (
        MANIFEST as MANIFEST,
        Manifest as Manifest,
        PRIVATE as PRIVATE,
        RunFolder as RunFolder,
        read_manifest as read_manifest,
    )
    from keyss.runs.metrics import FitMetrics as FitMetrics, HideMetrics as HideMetrics
    from keyss.runs.opening import HidingRun as HidingRun, open_run as open_run
    from keyss.methods.plan import Plan as Plan
    from keyss.runs.records import (
        read_record as read_record,
        record_bytes as record_bytes,
        write_record as write_record,
    )
    from keyss.runs.revealing import Revealed as Revealed, reveal_model as reveal_model
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.runs.config": ["FitRunConfig", "RunConfig", "read_config"],
            "keyss.runs.files": ["CONFIG", "METRICS", "MODEL", "REPORT", "STEGO", "stego_in"],
            "keyss.runs.folder": ["MANIFEST", "Manifest", "PRIVATE", "RunFolder", "read_manifest"],
            "keyss.runs.metrics": ["FitMetrics", "HideMetrics"],
            "keyss.runs.opening": ["HidingRun", "open_run"],
            "keyss.methods.plan": ["Plan"],
            "keyss.runs.records": ["read_record", "record_bytes", "write_record"],
            "keyss.runs.revealing": ["Revealed", "reveal_model"],
        },
    )

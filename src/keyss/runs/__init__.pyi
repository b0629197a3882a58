from .config import (
    FitMetrics as FitMetrics,
    FitRunConfig as FitRunConfig,
    HideMetrics as HideMetrics,
    RunConfig as RunConfig,
    read_config as read_config,
    secret_ids as secret_ids,
)
from .describe import ModelInfo as ModelInfo
from .files import (
    CONFIG as CONFIG,
    METRICS as METRICS,
    MODEL as MODEL,
    REPORT as REPORT,
    STEGO as STEGO,
    stego_in as stego_in,
)
from .folder import (
    MANIFEST as MANIFEST,
    PRIVATE as PRIVATE,
    Manifest as Manifest,
    RunFolder as RunFolder,
    clear as clear,
    read_manifest as read_manifest,
    write_again as write_again,
)
from .opening import HidingRun as HidingRun, open_run as open_run
from .records import read_record as read_record, record_bytes as record_bytes, write_record as write_record
from .revealing import Revealed as Revealed, reveal_model as reveal_model

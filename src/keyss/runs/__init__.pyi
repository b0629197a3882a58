from .describe import ModelInfo as ModelInfo
from .files import STEGO as STEGO, stego_in as stego_in
from .folder import (
    MANIFEST as MANIFEST,
    Manifest as Manifest,
    RunFolder as RunFolder,
    clear as clear,
    read_manifest as read_manifest,
    write_again as write_again,
)
from .json_records import (
    read_record as read_record,
    record_bytes as record_bytes,
    write_record as write_record,
)
from .run_records import (
    FitMetrics as FitMetrics,
    HideMetrics as HideMetrics,
    read_config as read_config,
    secret_ids as secret_ids,
)

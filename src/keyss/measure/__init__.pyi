from .hide_quality import (
    BaselineQuality as BaselineQuality,
    PsnrRange as PsnrRange,
    RenderFidelity as RenderFidelity,
    WrongKeys as WrongKeys,
    in_cover as in_cover,
    measure_without_keys as measure_without_keys,
)

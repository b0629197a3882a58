from .hide_quality import (
    BaselineQuality as BaselineQuality,
    HidingQuality as HidingQuality,
    PsnrRange as PsnrRange,
    RenderFidelity as RenderFidelity,
    WrongKeys as WrongKeys,
    in_cover as in_cover,
    measure_hiding as measure_hiding,
)

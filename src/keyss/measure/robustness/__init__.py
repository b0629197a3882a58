"""What is left of a cover and of its secrets when the published model has been changed."""

from keyss.measure.robustness.changes import Change
from keyss.measure.robustness.conversions import converters
from keyss.measure.robustness.reopening import Reopened, Reopener
from keyss.measure.robustness.survival import (
    BreakdownPoint,
    ChangeResult,
    breakdown_points,
    default_changes,
    mean_over_draws,
    robustness,
)

__all__ = [
    "BreakdownPoint",
    "Change",
    "ChangeResult",
    "Reopened",
    "Reopener",
    "breakdown_points",
    "converters",
    "default_changes",
    "mean_over_draws",
    "robustness",
]

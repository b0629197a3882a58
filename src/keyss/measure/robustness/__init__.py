"""What is left of a cover and of its secrets when the published model has been changed."""

from keyss.measure.robustness.changes import Change
from keyss.measure.robustness.conversions import converters
from keyss.measure.robustness.reopening import Opened, Reopener
from keyss.measure.robustness.survival import default_changes, robustness, verdicts

__all__ = ["Change", "Opened", "Reopener", "converters", "default_changes", "robustness", "verdicts"]

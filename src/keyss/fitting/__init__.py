"""Plain 3DGS: losses, density control, the training loop, checkpoints."""

from keyss.fitting.config import FitConfig
from keyss.fitting.loop import Interrupted, Reporter
from keyss.fitting.plain import FitResult, fit_scene

__all__ = ["FitConfig", "FitResult", "Interrupted", "Reporter", "fit_scene"]

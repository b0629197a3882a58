from .comparison import ComparedMethod as ComparedMethod, Comparison as Comparison, compare as compare
from .reproduction import Reproduction as Reproduction, reproduce as reproduce
from .sweep_spec import sweep as sweep
from .trial_folder import Forecast as Forecast, Outcome as Outcome

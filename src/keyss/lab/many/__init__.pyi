from .batch import hide_batch as hide_batch
from .comparison import ComparedMethod as ComparedMethod, Comparison as Comparison, compare as compare
from .engine import ManyResult as ManyResult
from .paper import Reproduction as Reproduction
from .reproduction import reproduce as reproduce
from .sweep_spec import sweep as sweep
from .trial_folder import Forecast as Forecast

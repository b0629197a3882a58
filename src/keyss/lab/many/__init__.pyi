from .batch import hide_batch as hide_batch
from .cell_folder import Forecast as Forecast, ManyResult as ManyResult
from .comparison import ComparedMethod as ComparedMethod, Comparison as Comparison, compare as compare
from .paper import Reproduction as Reproduction
from .reproduction import reproduce as reproduce
from .sweep_spec import sweep as sweep

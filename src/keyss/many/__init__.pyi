from .batch import hide_batch as hide_batch
from .cell_folder import Forecast as Forecast, ManyResult as ManyResult
from .comparison import compare as compare
from .comparison_table import ComparedMethod as ComparedMethod, Comparison as Comparison
from .paper import Reproduction as Reproduction
from .reproduction import reproduce as reproduce
from .sweep_spec import sweep as sweep

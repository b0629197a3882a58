from .batch import hide_batch as hide_batch
from .comparing import compare as compare
from .comparison import ComparedMethod as ComparedMethod, Comparison as Comparison
from .folder import Forecast as Forecast
from .paper import Reproduction as Reproduction
from .reproducing import reproduce as reproduce
from .running import ManyResult as ManyResult
from .sweeping import sweep as sweep

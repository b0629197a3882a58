from .batch import hide_batch as hide_batch
from .comparing import ComparedMethod as ComparedMethod, Comparison as Comparison, compare as compare
from .paper import Reproduction as Reproduction
from .reproducing import reproduce as reproduce
from .running import Forecast as Forecast, ManyResult as ManyResult
from .sweeping import sweep as sweep

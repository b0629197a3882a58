"""Many runs: one engine, and four specifications for it.

A *cell* is a plain fit, or a hiding and its measures, in a folder of its own (`keyss.many.cell`). Cells run
in processes of this machine, on a cluster, or in this process (`keyss.many.running`); a cell that is done is
never run again. A sweep (YAML), a batch (CSV), a comparison of methods and a table of the paper add cells to
a folder (`keyss.many.folder`), and make tables of their numbers.
"""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.many.batch import hide_batch as hide_batch
    from keyss.many.comparing import compare as compare
    from keyss.many.comparison import ComparedMethod as ComparedMethod, Comparison as Comparison
    from keyss.many.folder import Forecast as Forecast
    from keyss.many.paper.layout import Reproduction as Reproduction
    from keyss.many.reproducing import reproduce as reproduce
    from keyss.many.running import ManyResult as ManyResult
    from keyss.many.sweeping import sweep as sweep
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.many.batch": ["hide_batch"],
            "keyss.many.comparing": ["compare"],
            "keyss.many.comparison": ["ComparedMethod", "Comparison"],
            "keyss.many.folder": ["Forecast"],
            "keyss.many.paper.layout": ["Reproduction"],
            "keyss.many.reproducing": ["reproduce"],
            "keyss.many.running": ["ManyResult"],
            "keyss.many.sweeping": ["sweep"],
        },
    )

"""Many runs: sweeps, batches, comparisons of methods, and the paper's tables.

A *trial* is a plain fit, or a hiding and its measures, in a folder of its own (`trial`). Trials run one after
the other in this process, or on a Ray cluster (`engine`), and never run again once they are done. A sweep
(YAML), a comparison of methods and a table of the paper each add trials to a folder (`trial_folder`) and
tabulate the results; a batch (CSV) runs on the same engine.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

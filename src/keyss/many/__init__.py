"""Many runs: one engine and four kinds of specification.

A *cell* is a plain fit, or a hiding and its measures, in a folder of its own (`keyss.many.cell`). Cells run
in processes of this machine, on a cluster, or in this process (`keyss.many.running`), and never run again
once they are done. A sweep (YAML), a batch (CSV), a comparison of methods and a table of the paper each add
cells to a folder and tabulate the results.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

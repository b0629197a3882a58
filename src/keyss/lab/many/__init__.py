"""Many runs: sweeps, comparisons of methods, and the paper's tables.

A *trial* is a plain fit, or a hiding and its measures, in a folder of its own (`trial`). A sweep (YAML), a
comparison of methods and a table of the paper each add trials to a folder, which runs them and never runs
them again once they are done (`trial_folder`), and tabulate the results.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

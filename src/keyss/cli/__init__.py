"""The command line: one subcommand per verb, a thin layer over the functions of the same names."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Lets torch's idle threads sleep. Imported before torch, because its thread pool reads this once.

By default the threads of OpenMP spin while they wait for each other. On a machine with something else
to do that makes training several times slower: a waiting thread takes the core that the last worker
needs, and the kernels of `keyss.rendering.cpu` have threads of their own. A value that the user has set
stays.
"""

import os
import sys

# Whether torch was imported before, so that its threads spin in this process.
spinning = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

"""Makes torch's idle threads sleep. Imported before torch, whose thread pool reads the setting once.

By default, OpenMP's threads spin while they wait for each other. Beside other work that makes training
several times slower: a waiting thread takes the core that the last worker needs, and the kernels of
`keyss.rendering.cpu` have threads of their own. A value that the user has set is kept.
"""

import os
import sys

# True if torch was imported before, and its threads spin in this process.
spinning = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

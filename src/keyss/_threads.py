"""Makes torch's idle threads sleep, and its memory huge pages. Imported before torch, which reads both once.

By default, OpenMP's threads spin while they wait for each other. Beside other work that makes training
several times slower: a waiting thread takes the core that the last worker needs, and the kernels of
`keyss.rendering.cpu` have threads of their own. Large tensors in pages of 4 kB cost models of millions of
Gaussians a second of page faults (Linux only). Values that the user has set are kept.
"""

import os
import sys

# True if torch was imported before, and its threads spin in this process.
spinning = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")

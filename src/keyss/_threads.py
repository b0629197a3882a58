"""Lets torch's idle threads sleep. Imported before torch, because its thread pool reads this once.

By default the threads of OpenMP spin while they wait for each other. On a machine with something else
to do that makes training several times slower: a waiting thread takes the core that the last worker
needs. A value that the user has set stays.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

"""Many hidings: grids for research (`keyss sweep`) and batches of assets (`keyss hide --batch`).

A *job* is one hiding and its evaluation. What it is told lies in a folder of its own (`keyss.sweeps.job`),
where a process of its own does it (`keyss.sweeps.worker`), and an engine starts such processes on this
machine (`keyss.sweeps.local`) or on a cluster (`keyss.sweeps.cluster`).
"""

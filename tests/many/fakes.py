"""Workers that do next to nothing, and small sweeps for them."""

from __future__ import annotations

import sys
from pathlib import Path

import keyss
from tiny_scenes import random_gaussians, tiny_scene

TESTS = str(Path(__file__).parents[1])

# Takes a moment, and publishes what follows from the job alone. A job whose cover has "broken" in its name is
# refused; one with "mortal" dies in its first two attempts.
PROGRAM = """
import hashlib, os, signal, sys, time, types
sys.modules["torch"] = types.SimpleNamespace(Tensor=None)  # which takes long to load
from dataclasses import dataclass
from pathlib import Path
from keyss._processes import end_with_parent
from keyss.core.errors import InputError
from keyss.many import cell
from keyss.many.worker import attempt

def perform(job, folder):
    if "broken" in Path(job.cover).name:
        raise InputError(f"{job.cover}: nothing of it can be read")
    if "mortal" in Path(job.cover).name:
        deaths = folder / "deaths"
        count = len(deaths.read_text()) if deaths.exists() else 0
        if count < 2:
            deaths.write_text("x" * (count + 1))
            os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(SECONDS)
    run = Path(os.path.normpath(folder.absolute() / job.run))
    (run / "publish").mkdir(parents=True, exist_ok=True)
    seed = job.options["fit"]["seed"] or 0
    data = f"{Path(job.cover).name} {seed}".encode()
    (run / "publish" / "model.ply").write_bytes(data)
    published = os.path.relpath(run / "publish" / "model.ply", folder.absolute())
    digest = hashlib.sha256(data).hexdigest()
    numbers = {"cover.psnr": 30.0 + seed}
    return cell.Result(name=job.name, seconds=0.1, published=published, sha256=digest, numbers=numbers)

end_with_parent()
sys.exit(attempt(Path(sys.argv[1]), perform))
"""


def fake(seconds: float = 0.0) -> tuple[str, ...]:
    """The command of such a worker."""
    return (sys.executable, "-c", PROGRAM.replace("SECONDS", repr(seconds)))


# The real one, with keys at almost no cost.
REAL = (
    sys.executable,
    "-c",
    f"import sys; sys.path.append({TESTS!r}); import argon2.low_level, cheap_keys; "
    "argon2.low_level.hash_secret_raw = cheap_keys.hash_secret_raw; "
    "from keyss.many.worker import main; sys.exit(main(sys.argv[1:]))",
)

# A driver, to be killed: `python -c DRIVER SPEC OUT MASTER real`, or "fake", or "ray" for such on a cluster.
DRIVER = f"""
import sys
sys.path[:0] = [{TESTS!r}]
import argon2.low_level, cheap_keys
argon2.low_level.hash_secret_raw = cheap_keys.hash_secret_raw
from many.fakes import REAL, fake
from keyss.core import BackendError
from keyss.many import engines, sweep
kind = sys.argv[4]
engines.WORKER = REAL if kind == "real" else fake(0.5)
ray = "local" if kind == "ray" else None
try:
    sweep(sys.argv[1], sys.argv[2], master_key_file=sys.argv[3], jobs=2, ray=ray)
except BackendError as error:
    print("error:", error, file=sys.stderr)
    sys.exit(error.exit_status)
"""


def write_spec(folder: Path, covers: list[str], seeds: int, more: str = "") -> Path:
    """A sweep of files that need not be models."""
    for name in (*covers, "secret.ply"):
        if not (folder / name).exists():
            (folder / name).write_text(name)
    pairs = "\n".join(f"  - {{cover: {name}, secrets: [secret.ply]}}" for name in covers)
    (folder / "sweep.yaml").write_text(
        f"pairs:\n{pairs}\nmethods:\n  - {{method: carry, options: {{publish: any}}}}\n"
        f"seeds: {list(range(seeds))}\n{more}"
    )
    (folder / "master.txt").write_text("q7Rv2LxT9bWm4KzDq7Rv2L\n")
    return folder / "sweep.yaml"


def real_spec(folder: Path, seeds: int) -> Path:
    """A sweep of real models, of almost no size."""
    keyss.write_model(folder / "a.ply", random_gaussians(300, seed=0))
    keyss.write_model(folder / "secret.ply", random_gaussians(40, seed=1))
    return write_spec(folder, ["a.ply"], seeds, "width: 32\n")


def training_spec(folder: Path) -> Path:
    """A sweep of one cell that trains for long."""
    from test_api import write_nerfstudio  # not for drivers, which import this file

    write_nerfstudio(folder / "scene", tiny_scene())
    keyss.write_model(folder / "secret.ply", random_gaussians(40, seed=1))
    (folder / "master.txt").write_text("q7Rv2LxT9bWm4KzDq7Rv2L\n")
    (folder / "sweep.yaml").write_text(
        "pairs:\n  - {cover: scene, secrets: [secret.ply]}\n"
        "methods:\n  - method: carry\n"
        "    options: {publish: any, fit.iterations: 40000, fit.max_gaussians: 500}\n"
    )
    return folder / "sweep.yaml"

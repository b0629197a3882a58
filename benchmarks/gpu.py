"""What a GPU does: gsplat's kernels, the tests marked `cuda`, and every method at full size.

    python benchmarks/gpu.py ../shared/data --results out/gpu
    python benchmarks/gpu.py ../shared/data --device cpu --gaussians 2000 --width 120 --seconds 60

gsplat's wheel has sources, which the first stage compiles for the GPU that is there: that takes nvcc, and
minutes on 16 cores. A wheel compiled elsewhere (`TORCH_CUDA_ARCH_LIST=9.0 pip wheel --no-deps
--no-build-isolation` of gsplat's source archive, with the same Python and torch) skips that.

A machine without a network takes what it lacks from `pip download -c requirements/constraints.txt`, by `pip
install --no-index --no-deps --target site *.whl` and `PYTHONPATH=site:src`.

Stages are processes that follow one another: `kernels`, `tests`, `pilot`, which measures a step of every
method at the full number of Gaussians and chooses how many fit into `--seconds`, `plain`, the designs of
KeySS, `carry`. The results are written after each: `gpu.json`, a picture for each method (cover, its photo,
secret, its photo), and what a failed stage said. What does not begin within `--limit` is left out, and what
has not ended then is stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

from keyss import (
    CarryOptions,
    FitConfig,
    Gaussians,
    KeyssOptions,
    Secret,
    fit,
    hide,
    load_scene,
    read_model,
    reveal,
)
from keyss.core import Scene
from keyss.progress import Reporter
from keyss.rendering import render, resolve_device

import torch
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
COVER, SECRET = "bonsai", "fox"
DESIGNS = ("published", "released")
STAGES = ("kernels", "tests", "pilot", "plain", *DESIGNS, "carry")
KEY = "the key of the benchmark: 7Vw3-Qp"
PILOT_STEPS = 30
LEAST_SECONDS = 10.0  # a stage does not begin with less
HEIGHT = 266  # pixels of a picture: 400 wide for a photo of the cover


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help=f"folder of the scenes {COVER} and {SECRET}")
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--gaussians", type=int, default=500_000, help="of a model, at most")
    parser.add_argument("--width", type=int, help="of the photos in pixels, if not all")
    parser.add_argument("--seconds", type=float, default=300, help="for all trainings together")
    parser.add_argument("--limit", type=float, default=540, help="seconds for everything")
    parser.add_argument("--steps", type=int, help="of each training, instead of as many as fit")
    parser.add_argument("--stages", nargs="+", default=STAGES, choices=STAGES)
    parser.add_argument("--results", type=Path, default=Path("out/gpu"))
    parser.add_argument("--work", type=Path, help="folder for models; by default a temporary one")
    parser.add_argument("--stage", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.stage:
        (options.work / f"{options.stage}.json").write_text(json.dumps(run_stage(options.stage, options)))
        return
    with tempfile.TemporaryDirectory() as folder:
        options.work = options.work or Path(folder)
        for each in (options.work, options.results):
            each.mkdir(parents=True, exist_ok=True)
        sys.exit(run_all(options))


def run_all(options: argparse.Namespace) -> int:
    """Run the stages, and write the results after each; returns 1 if one failed."""
    if options.device == "cuda":  # otherwise gsplat is compiled for all architectures
        capability = "{}.{}".format(*torch.cuda.get_device_capability())
        os.environ.setdefault("TORCH_CUDA_ARCH_LIST", capability)
        # Where the toolkit is little more than nvcc, torch's packages have the other headers it includes.
        headers = sorted(map(str, Path(torch.__file__).parents[1].glob("nvidia/*/include")))
        os.environ.setdefault("CPLUS_INCLUDE_PATH", os.pathsep.join(headers))
    os.environ.setdefault("MAX_JOBS", str(os.cpu_count()))
    began, failed = time.monotonic(), 0
    numbers: dict[str, float] = {}
    card = torch.cuda.get_device_name() if options.device == "cuda" else platform.machine()
    machine = {"device": card, "python": platform.python_version(), "torch": torch.__version__}
    for stage in options.stages:
        started = time.monotonic()
        left = options.limit - (started - began)
        if left < LEAST_SECONDS:
            print(f"{stage}: left out, for {options.limit:g} seconds are over", flush=True)
            failed = 1
            continue
        steps = options.steps or numbers.get("pilot: steps of each training, 1")
        command = [sys.executable, *sys.argv, "--work", str(options.work), "--stage", stage]
        command += ["--steps", str(int(steps))] if steps else []
        log = options.results / f"{stage}.txt"
        with log.open("w") as output:
            try:
                code = subprocess.run(
                    command, timeout=left, stdout=output, stderr=output, check=False
                ).returncode
                status = f"failed with exit status {code}" if code else ""
            except subprocess.TimeoutExpired:
                status = "stopped, for the time is over"
        if (found := options.work / f"{stage}.json").exists():
            numbers |= {f"{stage}: {name}": value for name, value in json.loads(found.read_text()).items()}
        numbers[f"{stage}: all of it, s"] = time.monotonic() - started
        (options.results / "gpu.json").write_text(json.dumps(machine | numbers, indent=1) + "\n")
        print(f"{stage}: {status or 'done'}, {time.monotonic() - started:.1f} s", flush=True)
        if status:
            print(log.read_text()[-2000:], flush=True)
            failed = 1
        else:
            log.unlink()
    return failed


def run_stage(stage: str, options: argparse.Namespace) -> dict[str, float]:
    """What a stage measures, by name and unit."""
    own = {"kernels": kernels, "tests": tests, "pilot": pilot, "plain": plain}
    found = own[stage](options) if stage in own else hidden(stage, options)
    found["memory, GiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    if options.device == "cuda":
        found["memory of the GPU, GiB"] = torch.cuda.max_memory_allocated() / 2**30
    return found


def kernels(options: argparse.Namespace) -> dict[str, float]:
    """Compile gsplat's kernels or load them, and render with them."""
    started = time.monotonic()
    resolve_device(options.device)
    seconds = time.monotonic() - started
    subprocess.run([sys.executable, "-m", "keyss", "doctor", "--device", options.device], check=True)
    return {"compiled or loaded, s": seconds}


def tests(options: argparse.Namespace) -> dict[str, float]:
    """Run the tests marked `cuda`, from files that have some: others may import what is not installed."""
    files = [each for each in (ROOT / "tests").rglob("test_*.py") if "mark.cuda" in each.read_text()]
    pytest = [sys.executable, "-m", "pytest", "-m", "cuda", "-W", "default", "-p", "no:cacheprovider"]
    subprocess.run([*pytest, *map(str, files)], cwd=ROOT, check=True)
    return {}


def pilot(options: argparse.Namespace) -> dict[str, float]:
    """Seconds of a step of every training with all Gaussians, and how many steps fit."""
    cover, secret = (dense(scene, options.gaussians) for scene in scenes(options))
    config = replace(fit_config(options, PILOT_STEPS), grow_every=10**6)  # the number of Gaussians stays
    plains: list[Gaussians] = []
    found: dict[str, float] = {}
    for name, scene in {"plain cover": cover, "plain secret": secret}.items():
        clock = Clock(options.device, every_step=True)
        plains.append(fit(scene, config=config, device=options.device, reporter=clock).gaussians)
        found[f"{name}, s/step"] = clock.typical()
    for name in DESIGNS:
        clock = Clock(options.device, every_step=True)
        # The last step raises, and spares what follows the training.
        longer = replace(config, iterations=PILOT_STEPS + 1)
        with suppress(Enough):
            hide(
                cover, [Secret(secret, KEY, plains[1])], method=method_of(name, longer),
                cover_model=plains[0], device=options.device, reporter=clock,
            )  # fmt: skip
        found[f"{name}, s/step"] = clock.typical()
    return found | {"steps of each training, 1": max(PILOT_STEPS, int(options.seconds / sum(found.values())))}


def plain(options: argparse.Namespace) -> dict[str, float]:
    """The bounds: plain 3DGS of each scene alone, with as many Gaussians and steps."""
    found, models = {}, []
    for role, scene in zip(("cover", "secret"), scenes(options), strict=True):
        clock, folder = Clock(options.device), options.work / role
        config = fit_config(options, options.steps)
        fit(scene, config=config, device=options.device, out=folder, overwrite=True, reporter=clock)
        metrics = json.loads((folder / "private" / "metrics.json").read_text())
        models.append(read_model(folder / "model.ply"))
        found |= {f"{role}, {name}": value for name, value in clock.numbers().items()}
        found |= {f"{role}, dB": metrics["psnr"], f"{role}, Gaussians": metrics["gaussians"]}
    draw("plain", options, *models)
    return found


def hidden(name: str, options: argparse.Namespace) -> dict[str, float]:
    """One hiding from photos to the published file, and what it reveals."""
    (cover, secret), clock = scenes(options), Clock(options.device)
    plains, out = [options.work / role / "model.ply" for role in ("cover", "secret")], options.work / name
    began = time.monotonic()
    metrics = hide(
        cover, [Secret(secret, KEY, plains[1])], method=method_of(name, fit_config(options, options.steps)),
        cover_model=plains[0], device=options.device, out=out, overwrite=True, min_psnr=0, reporter=clock,
    ).metrics  # fmt: skip
    assert metrics is not None
    found = {"hide, s": time.monotonic() - began, **clock.numbers()}
    (published,) = (out / "publish").iterdir()
    began = time.monotonic()
    revealed = reveal(published, KEY, device=options.device).gaussians
    found |= {"reveal, s": time.monotonic() - began, "Gaussians": metrics.gaussians}
    draw(name, options, read_model(published), revealed)
    bounds = [metrics.baseline.cover, metrics.baseline.secrets[0]]
    for role, own, bound in zip(
        ("cover", "secret"), (metrics.cover, metrics.secrets[0]), bounds, strict=True
    ):
        assert bound is not None
        found |= {f"{role}, dB": own.psnr, f"{role} against plain, dB": own.psnr - bound.psnr}
    return found


def draw(name: str, options: argparse.Namespace, *models: Gaussians) -> None:
    """Save renders of both scenes, each beside the photo, in one row."""
    parts = []
    for model, scene in zip(models, scenes(options), strict=True):
        view = scene.test[len(scene.test) // 2]
        with torch.no_grad():
            image = render(model.to(options.device), view.camera, scene.background.to(options.device))
        parts += [(image.clamp(0, 1).cpu() * 255).round().byte(), view.image]
    pictures = [Image.fromarray(part.numpy()) for part in parts]
    pictures = [picture.resize((picture.width * HEIGHT // picture.height, HEIGHT)) for picture in pictures]
    row = Image.new("RGB", (sum(picture.width for picture in pictures), HEIGHT))
    for index, each in enumerate(pictures):
        row.paste(each, (sum(before.width for before in pictures[:index]), 0))
    row.save(options.results / f"{name}.jpg", quality=85)


def scenes(options: argparse.Namespace) -> list[Scene]:
    """The cover's and the secret's."""
    return [load_scene(options.data / name, width=options.width) for name in (COVER, SECRET)]


def dense(scene: Scene, count: int) -> Scene:
    """The scene with so many sparse points that trainings begin with `count` Gaussians."""
    chosen = torch.arange(count) % len(scene.points)
    spread = 1e-3 * scene.extent * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return replace(scene, points=scene.points[chosen] + spread, colors=scene.colors[chosen])


def fit_config(options: argparse.Namespace, steps: int) -> FitConfig:
    return FitConfig(iterations=steps, max_gaussians=options.gaussians, seed=0, evaluate_every=0)


def method_of(name: str, config: FitConfig) -> Any:
    return CarryOptions(fit=config) if name == "carry" else KeyssOptions(fit=config, design=name)


class Enough(Exception):
    """A pilot knows how long a step takes."""


class Clock(Reporter):
    """Measures a training."""

    def __init__(self, device: str, *, every_step: bool = False) -> None:
        self.device, self.every_step = device, every_step
        self.times: list[float] = []
        self.steps = 0

    def tick(self) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()
        self.times.append(time.perf_counter())

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.tick()

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        self.steps = iteration
        if self.every_step:
            self.tick()
            if iteration > PILOT_STEPS:
                raise Enough

    def finish(self) -> None:
        self.tick()

    def note(self, line: str) -> None:
        print(line, flush=True)

    def typical(self) -> float:
        """The median of seconds a step, without the first ten."""
        times = self.times[10 : PILOT_STEPS + 1]
        return median(after - before for before, after in pairwise(times))

    def numbers(self) -> dict[str, float]:
        """Of the whole training; nothing without one."""
        seconds = self.times[-1] - self.times[0] if self.steps else 0.0
        return {"steps, 1": self.steps, "s/step": seconds / self.steps} if self.steps else {}


if __name__ == "__main__":
    main()

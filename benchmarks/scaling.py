"""Scaling of run times: measured sizes, a model fitted to them, and its prediction for a larger size.

    python benchmarks/scaling.py                # some minutes on 2 cores
    python benchmarks/scaling.py --only step    # one kind of work

The model is a sum of nonnegative costs per call, Gaussian, pixel, secret or photo, by nonnegative least
squares of relative errors. `predicted` is its value at a held-out size, four times as large in everything
that grows.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from keyss import read_model, write_model
from benchmark_record import processor_name
from keyss.channels import LOW_BITS
from keyss.core import Gaussians
from keyss.files.images import read_image
from keyss.fitting.config import FitConfig
from keyss.fitting.losses import Target, photometric_loss
from keyss.fitting.parameters import make_optimizers, to_gaussians, to_parameters
from keyss.methods import embed_models
from keyss.rendering import render
from keyss.runs.revealing import reveal_model
from rasterizer import camera_before, load_kernels, synthetic_model

import numpy as np
import torch
from PIL import Image
from scipy.optimize import nnls

Size = dict[str, float]


@dataclass(frozen=True)
class Work:
    """A kind of work, its sizes, and the terms of its cost."""

    name: str
    terms: tuple[str, ...]  # terms computed from a size; a constant is always added
    sizes: tuple[Size, ...]
    larger: Size  # four times the largest
    seconds: Callable[[Size], float]


def best_of(repeats: int, call: Callable[[], object]) -> float:
    """Seconds of the fastest of `repeats` calls, after a warm-up."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def step_seconds(size: Size) -> float:
    """A training step: render, loss, backward, Adam."""
    torch.set_num_threads(int(size.get("threads", torch.get_num_threads())))
    model = synthetic_model(int(size["Gaussian"]))
    width = round((size["pixel"] * 1.5) ** 0.5)
    camera = camera_before(model.means, width, round(size["pixel"] / width))
    with torch.no_grad():
        target = Target.of(render(model, camera).clamp(0, 1))
    parameters = to_parameters(model, "cpu")
    optimizers = make_optimizers(parameters, FitConfig(), 1.0)

    def step() -> None:
        photometric_loss(render(to_gaussians(parameters), camera), target, 0.2).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    return best_of(5, step)


def picture_seconds(size: Size) -> float:
    """A picture without gradients."""
    model = synthetic_model(int(size["Gaussian"]))
    width = round((size["pixel"] * 1.5) ** 0.5)
    camera = camera_before(model.means, width, round(size["pixel"] / width))
    with torch.no_grad():
        return best_of(5, lambda: render(model, camera))


def trained_like(count: int, seed: int) -> Gaussians:
    """A synthetic model with low bits that look trained."""
    generator = torch.Generator().manual_seed(seed)
    model = synthetic_model(count)
    return model.map(lambda each: each * (1 + 1e-3 * torch.randn(each.shape, generator=generator)))


def carry_seconds(size: Size) -> float:
    """Carry secrets, in total a tenth of the cover, from files to a file, and open them again."""
    count, secrets = int(size["Gaussian"]), int(size.get("secret", 1))
    with tempfile.TemporaryDirectory() as name:
        cover, secret = Path(name) / "cover.ply", Path(name) / "secret.ply"
        write_model(cover, trained_like(count, 0))
        write_model(secret, trained_like(int(size.get("each", count)), 1))
        keys = [f"key {number} of the benchmark, 9fK2" for number in range(secrets)]

        def carry() -> None:
            prepared, hidden = LOW_BITS.prepare(read_model(cover)), read_model(secret)
            stego = embed_models(prepared, keys, [hidden] * secrets).gaussians
            write_model(Path(name) / "stego.ply", stego)

        return best_of(1, carry)


def reveal_seconds(size: Size) -> float:
    """Reveal from file to file."""
    count = int(size["Gaussian"])
    with tempfile.TemporaryDirectory() as name:
        key, stego = "the key of the benchmark, 9fK2", Path(name) / "stego.ply"
        hidden = trained_like(count, 1)
        prepared = LOW_BITS.prepare(trained_like(count, 0))
        write_model(stego, embed_models(prepared, [key], [hidden[:count]]).gaussians)

        def reveal() -> None:
            found = reveal_model(read_model(stego), key, device=torch.device("cpu"))
            write_model(Path(name) / "secret.ply", found.gaussians)

        return best_of(1, reveal)


def photo_seconds(size: Size) -> float:
    """Read JPEG photos like scenes."""
    count, pixels = int(size["photo"]), int(size["pixel"])
    width = round((pixels * 1.5) ** 0.5)
    with tempfile.TemporaryDirectory() as name:
        noise = np.random.default_rng(0).integers(0, 255, (pixels // width // 8, width // 8, 3), np.uint8)
        picture = Image.fromarray(noise).resize((width, pixels // width))
        paths = [Path(name) / f"{index}.jpg" for index in range(count)]
        for path in paths:
            picture.save(path, quality=95)
        return best_of(1, lambda: [read_image(path, np.zeros(3, np.float32)) for path in paths])


COUNTS = (10_000.0, 40_000.0, 160_000.0)
DRAWN = tuple({"Gaussian": gaussians, "pixel": pixels} for gaussians in COUNTS for pixels in COUNTS)
LARGER = {"Gaussian": 640_000.0, "pixel": 640_000.0}
MODELS = tuple({"Gaussian": float(count)} for count in (50_000, 100_000, 200_000, 400_000))
COUNTED = {"secret", "photo"}  # units of one; other terms are in millions
WORKS = (
    Work("step", ("Gaussian", "pixel"), DRAWN, LARGER, step_seconds),
    Work("picture", ("Gaussian", "pixel"), DRAWN, LARGER, picture_seconds),
    Work("carry", ("Gaussian",), MODELS, {"Gaussian": 1_600_000}, carry_seconds),
    Work("reveal", ("Gaussian",), MODELS, {"Gaussian": 1_600_000}, reveal_seconds),
    Work(
        "secrets",
        ("secret",),
        tuple({"secret": float(k), "Gaussian": 200_000.0, "each": 2_000.0} for k in (1, 2, 3, 4)),
        {"secret": 16, "Gaussian": 200_000, "each": 2_000},
        carry_seconds,
    ),
    Work(
        "photos",
        ("photo", "photo x pixel"),
        tuple(
            {"photo": float(n), "pixel": p, "photo x pixel": n * p}
            for n in (4, 8, 16)
            for p in (130_000.0, 520_000.0)
        ),
        {"photo": 64, "pixel": 2_080_000, "photo x pixel": 64 * 2_080_000},
        photo_seconds,
    ),
)


def fit_costs(sizes: list[Size], terms: tuple[str, ...], seconds: list[float]) -> dict[str, float]:
    """Nonnegative seconds per call and per unit of each term."""
    rows = np.array([[1.0, *(size[term] for term in terms)] for size in sizes]) / np.array(seconds)[:, None]
    scale = rows.max(0)
    found, _ = nnls(rows / scale, np.ones(len(sizes)))
    return dict(zip(("a call", *terms), found / scale, strict=True))


def predict(costs: dict[str, float], size: Size) -> float:
    return sum(cost * size.get(term, 1.0) for term, cost in costs.items())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", choices=[work.name for work in WORKS], help="these kinds of work"
    )
    options = parser.parse_args()
    load_kernels()
    print(f"{processor_name()}, {torch.get_num_threads()} threads\n")
    print("| work | seconds | misfit | predicted | measured | ratio |")
    print("| --- | --- | --- | --- | --- | --- |")
    for work in WORKS:
        if options.only and work.name not in options.only:
            continue
        seconds = [work.seconds(size) for size in work.sizes]
        costs = fit_costs(list(work.sizes), work.terms, seconds)
        pairs = zip(work.sizes, seconds, strict=True)
        misfit = max(abs(predict(costs, size) / took - 1) for size, took in pairs)
        expected, took = predict(costs, work.larger), work.seconds(work.larger)
        parts = [f"{costs['a call']:.3g} a call"]
        for term in work.terms:
            unit, cost = (term, costs[term]) if term in COUNTED else (f"million {term}", 1e6 * costs[term])
            parts.append(f"{cost:.3g} a {unit}")
        print(
            f"| {work.name} | {', '.join(parts)} | {misfit:.0%} | {expected:.3g} | {took:.3g} | "
            f"{took / expected:.2f} |",
            flush=True,
        )
    if not options.only or "step" in options.only:
        for size in (DRAWN[4], DRAWN[-1]):
            one, two = (step_seconds(size | {"threads": threads}) for threads in (1, 2))
            print(
                f"\nstep of {size}: {one:.4f} s on 1 thread, {two:.4f} s on 2, {one / two:.2f} times as fast"
            )


if __name__ == "__main__":
    main()

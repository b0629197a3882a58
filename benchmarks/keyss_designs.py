"""What the designs of KeySS keep of both scenes, beside plain 3DGS of as many steps fitted in the same run.

    python benchmarks/keyss_designs.py ../shared/data --pairs bonsai,fox fox,bonsai --designs carriers mlp
    python benchmarks/keyss_designs.py ../shared/data --steps 30000 --gaussians 9000 --width 120

Every pair, seed and design is a row of the JSON file given by `--results`. Rows that are there are kept, so
that a run that was stopped goes on; delete rows to measure trained models again. Runs with one thread. All
figures are PSNR in dB on all test photos, differences to plain 3DGS at the whole cap and (`half`) at half of
it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import keyss  # noqa: F401  before torch, see `ruff.toml`
from keyss import FitConfig, Gaussians, KeyssOptions, read_model, write_model
from keyss.core import Scene, Similarity
from keyss.core.similarity import align
from keyss.files.scenes import load_scene
from keyss.fitting import PlainRun, load_checkpoint, mean_psnr, save_checkpoint
from keyss.keys import random_embeddings
from keyss.measure import opacity_pruning, stealth_statistics
from keyss.methods import PlacedScene
from keyss.rendering import Viewpoints, psnr_between

import torch

WRONG_KEYS = 32
PAIRS = ["bonsai,fox", "fox,bonsai", "lego,miku", "miku,lego"]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of scenes")
    parser.add_argument("--pairs", nargs="+", default=PAIRS, metavar="COVER,SECRET[,SECRET]")
    parser.add_argument("--designs", nargs="+", default=["carriers"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[7, 8])
    parser.add_argument("--results", type=Path, default=Path("out/keyss-designs.json"))
    for name, value in {"steps": 3000, "gaussians": 20_000, "width": 200}.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = json.loads(options.results.read_text()) if options.results.exists() else []
    size = {"steps": options.steps, "gaussians": options.gaussians, "width": options.width}
    options.results.parent.mkdir(parents=True, exist_ok=True)
    for seed in options.seeds:
        for pair in options.pairs:
            for design in options.designs:
                wanted = {"pair": pair, "seed": seed, "design": design, **size}
                if any(row.items() >= wanted.items() for row in rows):
                    continue
                row = wanted | measured(options, pair.split(","), seed, design)
                rows.append(row)
                options.results.write_text(json.dumps(rows, indent=1) + "\n")
                print(json.dumps(row), flush=True)
    print_means([row for row in rows if row.items() >= size.items()])


def measured(options: argparse.Namespace, names: Sequence[str], seed: int, design: str) -> dict[str, float]:
    """One hiding and its bounds."""
    scenes = [load_scene(options.data / name, width=options.width) for name in names]
    fit = FitConfig(iterations=options.steps, max_gaussians=options.gaussians, seed=seed)
    chosen = replace(KeyssOptions(design=design), fit=fit)
    halves = [1] if design == "carriers" else [1, 2]
    plains, seconds = {}, 0.0
    for part in halves:
        for scene in scenes:
            cut = replace(fit, max_gaussians=fit.max_gaussians // part)
            plains[scene.name, part], took = plain(options.results.parent, scene, cut, options.width)
            seconds += took if part == 1 else 0
    cameras = [[view.camera for view in scene.train] for scene in scenes]
    frames = [Similarity(), *(align(each, cameras[0]) for each in cameras[1:])]
    placed = [
        PlacedScene.of(scene, plains[scene.name, 1], frame)
        for scene, frame in zip(scenes, frames, strict=True)
    ]
    keys = random_embeddings(len(scenes) - 1, torch.Generator().manual_seed(1000 + seed))
    run = chosen.settings.training(placed, list(keys), chosen, torch.device("cpu"))
    trained = options.results.parent / f"{'-'.join(names)}-{design}-{size_of(fit, options.width)}.safetensors"
    if trained.exists():  # only measure again
        tensors, meta = load_checkpoint(trained)
        run.load(tensors, meta)
    else:
        started = time.process_time()
        for _ in range(fit.iterations):
            run.step()
        tensors, meta = run.state()
        meta["seconds"] = time.process_time() - started
        save_checkpoint(trained, tensors, meta)
    found = {"cost": meta["seconds"] / seconds}
    stego, secrets = run.publish(bytes(32))

    def psnr(model: Gaussians, index: int) -> float:
        return mean_psnr(model, placed[index].scene.test, placed[index].scene.background)

    for part in halves:
        for index, scene in enumerate(scenes):
            role, suffix = f"secret {index}" if index else "cover", " half" if part == 2 else ""
            found[f"{role} bound{suffix}"] = mean_psnr(plains[scene.name, part], scene.test, scene.background)
    found["cover"], found["published"] = psnr(stego, 0), len(stego)
    if design == "carriers":
        in_order = run.density["born"].argsort(stable=True)
        found["statistic"] = noticed(run.scene_gaussians(0).detach()[in_order], stego)
        for index in range(1, len(scenes)):  # before rows and quantisation cost anything
            found[f"secret {index} trained"] = psnr(run.scene_gaussians(index).detach(), index)
    pruned = opacity_pruning(0.25).apply(stego)
    found["cover pruned"] = psnr(pruned, 0)
    for name, model in (("", stego), (" bound", plains[names[0], 1])):
        seen = psnr_between(model, opacity_pruning(0.25).apply(model), Viewpoints.of(scenes[0]))
        found[f"seen when pruned{name}"] = seen
    wrong = random_embeddings(WRONG_KEYS, torch.Generator().manual_seed(99))
    for index, secret in enumerate(secrets, 1):
        found[f"secret {index}"] = psnr(secret.reveal(stego, frame="cover"), index)
        found[f"secret {index} pruned"] = psnr(secret.reveal(pruned, frame="cover"), index)
        shown = [secret.decode(stego, each) for each in wrong]
        losses = [0.0 if each is stego else found["cover"] - psnr(each, 0) for each in shown]
        chance = psnr(stego, index)
        gains = [0.0 if each is stego else psnr(each, index) - chance for each in shown]
        found |= {"wrong mean": sum(losses) / len(losses), "wrong worst": max(losses)}
        found |= {f"secret {index} chance": chance, f"secret {index} wrong": max(gains)}
    return {name: round(value, 3) for name, value in found.items()}


def noticed(cover: Gaussians, stego: Gaussians) -> float:
    """By how many standard errors the most changed statistic of `keyss.measure.stealth` differs.

    Between the published model and its Gaussians before anything was written into their harmonics.
    """
    before = stealth_statistics(cover[cover.opacities >= FitConfig().prune_opacity])
    after = stealth_statistics(stego)
    return max(
        abs(each.value - before[name].value) / each.error
        for name, each in after.items()
        if name in before and each.error
    )


def plain(folder: Path, scene: Scene, fit: FitConfig, width: int) -> tuple[Gaussians, float]:
    """The bound, fitted once for all designs, and its processor seconds."""
    name = f"{scene.name}-{size_of(fit, width)}"
    path, record = folder / f"{name}.ply", folder / f"{name}.json"
    if record.exists():
        return read_model(path), json.loads(record.read_text())
    run = PlainRun(scene, fit, torch.device("cpu"))
    started = time.process_time()
    for _ in range(fit.iterations):
        run.step()
    took = time.process_time() - started
    model = run.gaussians()
    write_model(path, model[model.opacities >= fit.prune_opacity])
    record.write_text(json.dumps(took))
    return read_model(path), took


def size_of(fit: FitConfig, width: int) -> str:
    """What results depend on, in names of files."""
    return f"{width}-{fit.iterations}-{fit.max_gaussians}-{fit.seed}"


def print_means(rows: Sequence[dict[str, Any]]) -> None:
    """A table of differences, one line per row, and their means by design."""
    print("\n| pair, seed, design | cover | secret | wrong keys: mean, worst | pruned quarter | cost |")
    print("| --- | --- | --- | --- | --- | --- |")
    for design in dict.fromkeys(row["design"] for row in rows):
        own = [row for row in rows if row["design"] == design]
        for row in own:
            print(line(f"{row['pair']} {row['seed']} {design}", row))
        numbers = {name for row in own for name, value in row.items() if isinstance(value, int | float)}
        means = {
            name: sum(row[name] for row in own if name in row) / sum(name in row for row in own)
            for name in numbers
        }
        print(line(f"**mean of {len(own)}, {design}**", means))


def line(name: str, row: dict[str, float]) -> str:
    """A line of the table of one row or of means."""

    def against(role: str) -> str:
        text = f"{row[role]:.2f}: {row[role] - row[f'{role} bound']:+.2f}"
        half = row.get(f"{role} bound half")
        return text if half is None else f"{text} (half {row[role] - half:+.2f})"

    roles = sorted(each for each in row if each.startswith("secret") and f"{each} bound" in row)
    pruned = ", ".join(f"{row[f'{role} pruned'] - row[role]:+.2f}" for role in ("cover", *roles))
    secrets = "; ".join(against(role) for role in roles)
    wrong = f"{row['wrong mean']:.2f}, {row['wrong worst']:.2f}"
    return f"| {name} | {against('cover')} | {secrets} | {wrong} | {pruned} | {row['cost']:.2f} |"


if __name__ == "__main__":
    main(sys.argv[1:])

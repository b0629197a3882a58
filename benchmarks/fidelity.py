"""What hiding costs cover and secrets, preset against preset: `make benchmark-fidelity ARGS="..."`.

    python benchmarks/fidelity.py --data FOLDER --hide bonsai,fox miku,lego,fox --write docs/fidelity.md

Each `--hide` names folders of `--data`: a cover, then its secrets. Plain models (the baselines) are fitted
once and kept in `--work`, and so is every result: a run that was cut short goes on where it was. Everything
is measured through the written files, on test photos.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import statistics
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import keyss
from benchmark_record import make_record, write_record
from keyss.core import Scene, WrongKeyError
from keyss.core.alignment import align
from keyss.core.similarity import Similarity
from keyss.files.atomic import write_bytes
from keyss.files.models import read_model
from keyss.files.scenes import load_scene
from keyss.fitting.loop import Interrupted
from keyss.fitting.parameters import make_optimizers, to_parameters
from keyss.fitting.plain import PlainRun
from keyss.keys import DerivedKey, KeyDerivation, random_embeddings
from keyss.measure.hiding import what_wrong_keys_show
from keyss.methods import registry
from keyss.methods.learned.joint import JointRun
from keyss.methods.learned.method import training_salt
from keyss.methods.learned.options import PRESETS, LearnedOptions
from keyss.methods.poses import PlacedScene
from keyss.progress import reporter

import msgspec
import torch

START, END = "<!-- measured by `make benchmark-fidelity` -->", "<!-- end of what was measured -->"
KEY = "Xq7Rf2LmZ9aT{:03d}"  # 16 characters
WRONG_KEYS, NEAR_KEYS = 64, 16
TIMED_STEPS = 40


class Watch:
    """A reporter that remembers when each evaluation was made."""

    loss_every = 0

    def __init__(self) -> None:
        self.shown = reporter()
        self.history: list[tuple[int, float, dict[str, float]]] = []
        self.title = ""

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.title, self.began = title, time.monotonic()
        self.shown.start(title, iterations, iteration)

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if self.title == "hide" and numbers and (not self.history or self.history[-1][2] != numbers):
            self.history.append((iteration, time.monotonic() - self.began, dict(numbers)))
        self.shown.update(iteration, gaussians, numbers)

    def note(self, line: str) -> None:
        self.shown.note(line)

    def finish(self) -> None:
        self.shown.finish()


def near_keys(key: str) -> list[str]:
    """NEAR_KEYS keys that a slip of the finger makes: a character changed, left out, twice, swapped case."""
    changed = [key[:i] + ("x" if key[i] != "x" else "y") + key[i + 1 :] for i in range(len(key))]
    others = [key.swapcase(), key[:-1], key + key[-1], key[1] + key[0] + key[2:]]
    return (others + changed)[:NEAR_KEYS]


def baseline(data: Path, name: str, work: Path, settings: argparse.Namespace, seed: int) -> Path:
    """The plain model of a scene, fitted unless it is there."""
    out = work / f"plain-{name}-{seed}"
    if not (out / "model.ply").exists():
        config = schedule(PRESETS["best"], settings, seed).fit
        keyss.fit(
            data / name,
            config=config,
            width=settings.width,
            out=out,
            resume=out.exists(),
            reporter=reporter(),
        )
    return out / "model.ply"


def schedule(config: LearnedOptions, settings: argparse.Namespace, seed: int) -> LearnedOptions:
    """The preset at the sizes that are asked for."""
    return config.with_fit(
        iterations=settings.iterations,
        max_gaussians=settings.max_gaussians,
        seed=seed,
        evaluate_every=max(1, settings.iterations // 30),
    )


def measure(names: Sequence[str], preset: str, seed: int, settings: argparse.Namespace) -> dict[str, Any]:
    """One hiding and everything the table says of it; kept in `work`."""
    work, data = settings.work, settings.data
    out = work / f"{'-'.join(names)}-{preset}-{seed}"
    if (out / "fidelity.json").exists():
        found: dict[str, Any] = json.loads((out / "fidelity.json").read_text())
        return found
    config = schedule(PRESETS[preset], settings, seed)
    models = [baseline(data, name, work, settings, seed) for name in names]
    keys = [KEY.format(index) for index in range(1, len(names))]
    watch = Watch()
    metrics = keyss.hide(
        data / names[0],
        [
            keyss.Secret(data / name, key, model)
            for name, key, model in zip(names[1:], keys, models[1:], strict=True)
        ],
        method=config,
        width=settings.width,
        cover_model=models[0],
        bound=True,
        out=out,
        overwrite=True,
        reporter=watch,
    ).metrics
    scenes = [load_scene(data / name, width=settings.width) for name in names]
    result = {
        "names": list(names),
        "preset": preset,
        "seed": seed,
        "metrics": msgspec.to_builtins(metrics),
        "history": watch.history,
        "near": near_and_wrong(out, keys, scenes, seed),
        "cost": None if config.start == "warm" else step_cost(scenes, models, config),
    }
    write_bytes(out / "fidelity.json", json.dumps(result, indent=1).encode())
    return result


def near_and_wrong(out: Path, keys: Sequence[str], scenes: Sequence[Scene], seed: int) -> dict[str, Any]:
    """What near and random keys show to somebody who holds the decoders, and how many the files refuse."""
    stego = read_model(out / "publish" / "stego.ply")
    opened = [registry.open_model(stego, key) for key in keys]
    derivation = KeyDerivation(salt=training_salt(scenes[0], seed))
    near = [other for key in keys for other in near_keys(key)]
    embeddings = torch.stack([DerivedKey(key, derivation).embedding() for key in near])
    refused = 0
    for key in near:
        try:
            registry.open_model(stego, key)
        except WrongKeyError:
            refused += 1
    wrong = random_embeddings(WRONG_KEYS, torch.Generator().manual_seed(seed + 1))
    return {
        "refused": refused,
        "keys": len(near),
        "near": msgspec.to_builtins(what_wrong_keys_show(stego, opened, scenes, embeddings)),
        "wrong": msgspec.to_builtins(what_wrong_keys_show(stego, opened, scenes, wrong)),
    }


def step_cost(scenes: Sequence[Scene], models: Sequence[Path], config: LearnedOptions) -> float:
    """Time of a hiding step over that of a plain step of the cover, with as many Gaussians, in one run."""
    plains = [read_model(path) for path in models]
    cameras = [view.camera for view in scenes[0].train]
    frames = [Similarity.identity()]
    frames += [align([view.camera for view in scene.train], cameras) for scene in scenes[1:]]
    placed = [PlacedScene.of(*each) for each in zip(scenes, plains, frames, strict=True)]
    embeddings = list(random_embeddings(len(scenes) - 1, torch.Generator().manual_seed(0)))
    device = torch.device("cpu")
    joint = JointRun(placed, embeddings, config.with_fit(grow_stop=0.0), device)
    plain = PlainRun(scenes[0], config.with_fit(grow_stop=0.0).fit, device)
    plain.parameters = to_parameters(plains[0], device)
    plain.optimizers = make_optimizers(plain.parameters, plain.config, scenes[0].extent)
    plain.iteration = plain.iterations // 2  # all spherical harmonics are in use
    times: dict[str, list[float]] = {"joint": [], "plain": []}
    for _ in range(TIMED_STEPS):
        for name, run in (("joint", joint), ("plain", plain)):
            began = time.perf_counter()
            run.step()  # type: ignore[attr-defined]
            times[name].append(time.perf_counter() - began)
    return statistics.median(times["joint"][5:]) / statistics.median(times["plain"][5:])


def row(result: dict[str, Any]) -> list[str]:
    """One line of the table."""
    metrics, near = result["metrics"], result["near"]
    cover = metrics["baseline"]["cover"]["psnr"] - metrics["cover"]["psnr"]
    secrets = [
        plain["psnr"] - each["psnr"]
        for plain, each in zip(metrics["baseline"]["secrets"], metrics["secrets"], strict=True)
    ]

    def against(which: str) -> str:
        shown = near[which]
        if shown is None:
            return "no decoder"
        mean = metrics["cover"]["psnr"] - shown["vs_cover"]["mean"]
        worst = metrics["cover"]["psnr"] - shown["vs_cover"]["min"]
        above = max(
            each["max"] - level
            for each, level in zip(shown["vs_secrets"], metrics["chance_level"], strict=True)
        )
        return f"{mean:.2f}, {worst:.2f}, {above:.2f}"

    return [
        f"{result['names'][0]} hides {', '.join(result['names'][1:])}",
        result["preset"],
        f"{metrics['cover']['psnr']:.2f} ({round(cover, 2) + 0.0:+.2f})",  # no -0.00
        ", ".join(
            f"{each['psnr']:.2f} ({round(loss, 2) + 0.0:+.2f})"
            for each, loss in zip(metrics["secrets"], secrets, strict=True)
        ),
        against("wrong"),
        against("near"),
        f"{near['refused']} of {near['keys']}",
        f"{result['cost']:.2f}" if result["cost"] else "as plain",
        f"{metrics['seconds']:.0f}",
    ]


def table(results: Iterable[dict[str, Any]]) -> str:
    """The Markdown table of all results."""
    head = [
        "hiding",
        "preset",
        "cover (loss)",
        "secrets (loss)",
        f"{WRONG_KEYS} wrong keys: mean, worst, above chance level",
        "near keys: the same",
        "near keys refused",
        "step / plain step",
        "s",
    ]
    lines = [head, ["---"] * len(head), *(row(result) for result in results)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def sooner(results: Sequence[dict[str, Any]]) -> str:
    """How much sooner `best` has the secret as good as `paper` has it at last, where both were run."""
    lines = []
    for ours, paper in itertools.permutations(results, 2):
        same = ours["names"] == paper["names"] and ours["seed"] == paper["seed"]
        if not (same and ours["preset"] == "best" and paper["preset"] == "paper" and paper["history"]):
            continue
        name = "secret" if len(ours["names"]) == 2 else "secret 1"
        goal, needed = paper["history"][-1][2][name], paper["history"][-1][1]
        reached = [seconds for _, seconds, numbers in ours["history"] if numbers[name] >= goal]
        if reached:
            lines.append(
                f"- {ours['names'][0]} hides {', '.join(ours['names'][1:])}: `paper` shows the secret with "
                f"{goal:.2f} dB after {needed:.0f} s, `best` is past that at its first look, after "
                f"{reached[0]:.0f} s: {needed / reached[0]:.0f} times sooner\n"
            )
    return "".join(lines)


def numbers_and_ratios(results: Iterable[dict[str, Any]]) -> tuple[dict[str, float], dict[str, float]]:
    """What the record of the benchmark keeps: decibels, seconds, and the cost of a step."""
    numbers, ratios = {}, {}
    for result in results:
        name = f"{', '.join(result['names'])}, {result['preset']}, seed {result['seed']}"
        metrics = result["metrics"]
        numbers[f"{name}: cover, dB"] = metrics["cover"]["psnr"]
        for index, each in enumerate(metrics["secrets"], 1):
            numbers[f"{name}: secret {index}, dB"] = each["psnr"]
        numbers[f"{name}: hiding, s"] = metrics["seconds"]
        if result["cost"]:
            ratios[f"{name}: step / plain step"] = result["cost"]
    return numbers, ratios


def write_between_marks(path: Path, text: str) -> None:
    """Replace what stands between the marks in a document."""
    document = path.read_text()
    before, _, rest = document.partition(START)
    _, _, after = rest.partition(END)
    write_bytes(path, f"{before}{START}\n{text}{END}{after}".encode())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of scene folders")
    parser.add_argument("--hide", nargs="+", default=["bonsai,fox", "fox,bonsai", "miku,lego"])
    parser.add_argument("--presets", nargs="+", choices=sorted(PRESETS), default=["best"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--width", type=int, default=260)
    parser.add_argument("--max-gaussians", type=int, default=30_000)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--work", type=Path, default=Path("out/fidelity"))
    parser.add_argument("--write", type=Path, help="document whose marked part is replaced by the table")
    settings = parser.parse_args()
    results = []
    try:
        for seed, names, preset in itertools.product(settings.seeds, settings.hide, settings.presets):
            results.append(measure(names.split(","), preset, seed, settings))
            print(table(results))
    except Interrupted:
        print("interrupted: the same command goes on with what is missing")
        raise SystemExit(130) from None
    text = (
        f"{settings.max_gaussians:,} Gaussians, {settings.width} px, {settings.iterations:,} steps, "
        f"{torch.get_num_threads()} threads of {platform.machine()}.\n\n{table(results)}"
    )
    if later := sooner(results):
        text += f"\n{later}"
    print(text)
    print(write_record(make_record("fidelity", *numbers_and_ratios(results))))
    if settings.write is not None:
        write_between_marks(settings.write, text)


if __name__ == "__main__":
    main()

"""Short fits with boosted rates against 3DGS's rates: PSNR on test photos, and processor time of training.

    python benchmarks/recipe.py ../shared/data                      # the default of 1,000 steps against 3,000
    python benchmarks/recipe.py ../shared/data --steps 500 --against 1000 --gaussians 10000 --width 200

Scenes are the folders of photos in DATA, and rings of cameras around the models in DATA/splats; all of them
also in hard variants (`VARIANTS`): cropped to the other orientation, in other units, with few photos, without
points, with one photo of noise, from too near, from far with a narrow field of view. Rows are saved in the
file `--results`, from which an interrupted run resumes. Runs with one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from statistics import mean
from typing import Any

from keyss import FitConfig, Gaussians, read_model
from keyss.core import SH_C0, Camera, Scene, View
from keyss.files import load_scene
from keyss.fitting import PlainRun, mean_psnr, own_randomness
from keyss.fitting.plain import without_faint
from keyss.rendering import frame_of, render
from keyss.rendering.orbit import look_at

import torch

THREEDGS: dict[str, Any] = {"boost": 1.0, "grow_start": 1 / 6, "grow_every": 100}
VIEWS = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of scenes")
    parser.add_argument("--scenes", nargs="+", help="only those with one of these words in their names")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--results", type=Path, default=Path("out/recipe.json"))
    for name, value in {"steps": 1000, "against": 3000, "gaussians": 7000, "width": 120}.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = json.loads(options.results.read_text()) if options.results.exists() else []
    options.results.parent.mkdir(parents=True, exist_ok=True)
    compiled = False  # the kernels
    size = {name: getattr(options, name) for name in ("steps", "against", "gaussians", "width")}
    for name, load in scenes(options.data, options.width).items():
        if options.scenes and not any(word in name for word in options.scenes):
            continue
        for seed in options.seeds:
            wanted = {"scene": name, "seed": seed, **size}
            if any(row.items() >= wanted.items() for row in rows):
                continue
            scene, common = load(), {"max_gaussians": options.gaussians, "seed": seed}
            if not compiled:
                fit_and_score(scene, FitConfig(iterations=50, **common))
                compiled = True
            ours, seconds = fit_and_score(scene, FitConfig(iterations=options.steps, **common))
            theirs, before = fit_and_score(scene, FitConfig(iterations=options.against, **common, **THREEDGS))
            found = {"psnr": ours, "3dgs": theirs, "gain": ours - theirs, "time": seconds / before}
            rows.append(wanted | {key: round(value, 3) for key, value in found.items()})
            options.results.write_text(json.dumps(rows, indent=1) + "\n")
            print(json.dumps(rows[-1]), flush=True)
    chosen = [row for row in rows if row.items() >= size.items()]
    gains = sorted(row["gain"] for row in chosen)
    print(
        f"{len(chosen)} fits: gain {sum(gains) / len(gains):+.2f} dB in the mean, {gains[0]:+.2f} at worst; "
        f"time {sum(row['time'] for row in chosen) / len(chosen):.2f}"
    )
    if len(options.seeds) > 1:
        by_seed(chosen)


def by_seed(rows: list[dict[str, Any]]) -> None:
    """Print the effect of seeds: means of scenes, and 3DGS's rates against themselves."""
    every = [[row for row in rows if row["scene"] == name] for name in sorted({row["scene"] for row in rows})]
    means = [(mean(row["gain"] for row in own), own[0]["scene"]) for own in every]
    print(f"lowest mean of a scene: {min(means)[0]:+.2f} dB ({min(means)[1]})")
    pairs = [b["3dgs"] - a["3dgs"] for own in every for a, b in permutations(own, 2)]
    below, ours = sum(pair < -1 for pair in pairs), sum(row["gain"] < -1 for row in rows)
    print(f"more than 1 dB below: {ours} of {len(rows)}; 3DGS's with another seed {below} of {len(pairs)}")


def fit_and_score(scene: Scene, config: FitConfig) -> tuple[float, float]:
    """PSNR on the test photos, and processor seconds of training."""
    run = PlainRun(scene, config, torch.device("cpu"))
    started = time.process_time()
    with own_randomness(config.known_seed):
        while run.iteration < run.iterations:
            run.step()
    seconds = time.process_time() - started
    model = without_faint(run.gaussians(), config.prune_opacity)
    return mean_psnr(model, scene.test, scene.background), seconds


def scenes(data: Path, width: int) -> dict[str, Callable[[], Scene]]:
    """Functions that load each scene, by name."""
    found: dict[str, Callable[[], Scene]] = {}
    for folder in sorted(path for path in data.iterdir() if path.is_dir()):
        if any((folder / name).exists() for name in ("sparse", "transforms_train.json", "transforms.json")):
            for name, change in VARIANTS.items():
                found[f"{folder.name}, {name}"] = lambda folder=folder, change=change: change(
                    load_scene(folder, width=width)
                )
    for path in sorted((data / "splats").glob("*.ply")):
        for name, given in RINGS.items():
            found[f"{path.stem}, {name}"] = lambda path=path, given=given: ring(
                read_model(path), path.stem, width, **given
            )
    return found


def on_views(scene: Scene, change: Callable[[View], View]) -> Scene:
    return replace(scene, train=tuple(map(change, scene.train)), test=tuple(map(change, scene.test)))


def scale(scene: Scene, factor: float) -> Scene:
    """The scene in other units of length."""

    def moved(view: View) -> View:
        pose = view.camera.viewmat.clone()
        pose[:3, 3] *= factor
        return View(replace(view.camera, viewmat=pose), view.image)

    return replace(on_views(scene, moved), points=scene.points * factor)


def crop(scene: Scene) -> Scene:
    """The middle half of the photos along their longer side."""

    def half(view: View) -> View:
        camera, (height, width) = view.camera, view.image.shape[:2]
        x, y = (width // 4, 0) if width >= height else (0, height // 4)
        image = view.image[y : height - y, x : width - x].contiguous()
        K = camera.K.clone()
        K[:2, 2] -= torch.tensor([x, y])
        return View(replace(camera, K=K, width=width - 2 * x, height=height - 2 * y), image)

    return on_views(scene, half)


def keep_photos(scene: Scene, count: int) -> Scene:
    return replace(scene, train=scene.train[:: max(1, len(scene.train) // count)][:count])


def with_points(scene: Scene, count: int) -> Scene:
    chosen = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(1))[:count]
    return replace(scene, points=scene.points[chosen], colors=scene.colors[chosen])


def with_noise(scene: Scene) -> Scene:
    """Replace one photo by noise."""
    train, middle = list(scene.train), len(scene.train) // 2
    size, generator = train[middle].image.shape, torch.Generator().manual_seed(2)
    noise = torch.randint(0, 256, size, generator=generator, dtype=torch.uint8)
    train[middle] = View(train[middle].camera, noise)
    return replace(scene, train=tuple(train))


VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "as it is": lambda scene: scene,
    "cropped": crop,
    "1,000 times larger": lambda scene: scale(scene, 1000.0),
    "20 times smaller": lambda scene: scale(scene, 0.05),
    "20 photos": lambda scene: keep_photos(scene, 20),
    "one photo of noise": with_noise,
    "300 points": lambda scene: with_points(scene, 300),
    "no points": lambda scene: with_points(scene, 0),
}
# Distances of the cameras in radii of the model, fields of view in degrees along the longer side.
RINGS: dict[str, dict[str, Any]] = {
    "near, portrait": {"distance": 1.05, "aspect": 1.78},
    "inside, portrait": {"distance": 0.7, "aspect": 1.78},
    "wide field of view": {"distance": 1.0, "aspect": 1.78, "field": 90},
    "landscape": {"distance": 1.2, "aspect": 0.56},
    "narrow field of view": {"distance": 4.0, "field": 20},
    "300 points": {"distance": 1.5, "aspect": 1.78, "points": 300},
    "half a ring, far background": {"distance": 1.3, "aspect": 1.78, "turn": 0.5, "far": True},
}


def ring(
    model: Gaussians,
    name: str,
    width: int,
    *,
    distance: float,
    aspect: float = 1.0,  # height over width
    field: float = 60.0,
    points: int = 2500,
    turn: float = 1.0,
    far: bool = False,
) -> Scene:
    """Renders of a model from a ring of cameras, and some of its means as points."""
    frame = frame_of(model)
    middle, radius = torch.from_numpy(frame.middle).float(), frame.radius
    generator = torch.Generator().manual_seed(5)
    if far:
        model = Gaussians.cat([model, sphere(middle, 30 * radius, model.sh.shape[1], generator)])
    wide, high = (width, round(width * aspect)) if aspect <= 1 else (round(width / aspect), width)
    focal = 0.5 * max(wide, high) / math.tan(math.radians(field / 2))
    K = torch.tensor([[focal, 0, wide / 2], [0, focal, high / 2], [0, 0, 1.0]])
    views = []
    for index in range(VIEWS):
        azimuth, elevation = 2 * math.pi * turn * index / VIEWS, math.radians(15 + 20 * (index % 7) / 6)
        flat = math.cos(elevation)
        outward = torch.tensor([flat * math.cos(azimuth), -math.sin(elevation), flat * math.sin(azimuth)])
        pose = look_at(middle + outward * radius * distance, -outward, torch.tensor([0.0, -1.0, 0.0]))
        camera = Camera(pose, K, wide, high, f"{index:03d}")
        image = render(model, camera, torch.zeros(3)).clamp(0, 1)
        views.append(View(camera, (image * 255).round().to(torch.uint8)))
    visible = (model.opacities > 0.3).nonzero()[:, 0]
    chosen = visible[torch.randperm(len(visible), generator=generator)[:points]]
    colors = ((model.sh[chosen, 0] * SH_C0 + 0.5).clamp(0, 1) * 255).round().to(torch.uint8)
    train = tuple(view for index, view in enumerate(views) if index % 8)
    return Scene(name, train, tuple(views[::8]), model.means[chosen], colors)


def sphere(middle: torch.Tensor, radius: float, harmonics: int, generator: torch.Generator) -> Gaussians:
    """A coloured background far away."""
    count = 4000
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    sh = torch.zeros(count, harmonics, 3)
    sh[:, 0] = torch.sin(3 * directions + torch.rand(count, 3, generator=generator)) / (2 * SH_C0)
    return Gaussians(
        middle + radius * directions,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), math.log(0.06 * radius)),
        torch.full((count,), 4.0),
        sh,
    )


if __name__ == "__main__":
    main()

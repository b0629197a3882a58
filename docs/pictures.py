"""The pictures of the documents, all from the demo: `make pictures`.

demo.jpg is the demo's own comparison; wipe.webp a film around the published model, over which the secret
comes and goes, each seen from the cameras of its own scene.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from keyss import load_scene, read_model
from keyss._verbs.filming import shown, wiped
from keyss.demo.run import COMPARISON, COVER, SCENES, SECRET, SECRET_PLY
from keyss.rendering.paths import around
from keyss.rendering.view import render as picture_of
from keyss.runs.files import STEGO

FOLDER = Path(__file__).parent
FRAMES, MILLISECONDS = 60, 100


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the pictures of the documents from a run of the demo.")
    parser.add_argument("demo", type=Path, help="what `make demo` wrote")
    parser.add_argument("-o", type=Path, default=FOLDER, help="folder for the pictures")
    arguments = parser.parse_args()
    with Image.open(arguments.demo / COMPARISON) as comparison:
        comparison.convert("RGB").save(arguments.o / "demo.jpg", quality=85, optimize=True)
    frames = film(arguments.demo)
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(
        arguments.o / "wipe.webp",
        save_all=True,
        append_images=others,
        duration=MILLISECONDS,
        loop=0,
        quality=50,
        method=6,
    )


@torch.no_grad()
def film(demo: Path) -> list[np.ndarray]:
    """Frames [H, W, 3]."""
    sides = []
    for model, name in ((STEGO, COVER), (SECRET_PLY, SECRET)):
        gaussians, scene = read_model(demo / model), load_scene(demo / SCENES / name)
        cameras = around([view.camera for view in scene.views], FRAMES)
        cameras = [camera.resized(2 * camera.width, 2 * camera.height) for camera in cameras]
        pictures = [picture_of(gaussians, camera, scene.background) for camera in cameras]
        sides.append([(each.clamp(0, 1) * 255).round().to(torch.uint8).numpy() for each in pictures])
    return [wiped(*pair, shown(index / FRAMES)) for index, pair in enumerate(zip(*sides, strict=True))]


if __name__ == "__main__":
    main()

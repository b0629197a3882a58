"""`keyss fit` beside OpenSplat's CPU build: time, processor time, and PSNR on the same test photos.

    python benchmarks/opensplat.py ../shared/data/fox PATH/OF/opensplat
    python benchmarks/opensplat.py ../shared/data/fox PATH/OF/opensplat --sizes 200,12000,200 400,12000,500

OpenSplat (github.com/pierotofy/OpenSplat) is not a part of keyss. On Debian, with libopencv-dev and cmake:

    cmake -B build -DGPU_RUNTIME=CPU -DCMAKE_BUILD_TYPE=Release \\
        -DCMAKE_PREFIX_PATH=$(python -c 'import torch; print(torch.utils.cmake_prefix_path)')
    make -C build

Sizes are the width of the photos in pixels, the number of points, which is also the limit for keyss's
Gaussians, and the number of steps. Both use two threads, start from the scene's points, and read and write
files. OpenSplat gets the training photos in their final size (`--num-downscales 0`); keyss renders its
models, over the colour that OpenSplat trains with. The third row of a size is keyss with as many steps as
take the processor time of OpenSplat, but at most 30,000.

gsplat's trainer needs a CUDA GPU and is not among its wheel's files; `benchmarks/gpu.py` measures a GPU.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from keyss import read_model
from keyss.core import Scene
from keyss.files import load_scene
from keyss.fitting import mean_psnr
from large import Cost, run

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from files.scene_files import PINHOLE, camera_bytes, counted, image_bytes, point_bytes

SIZES = ("200,12000,200", "300,12000,400", "400,12000,150")
TWO_THREADS = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"}
MOST_STEPS = 30_000
BACKGROUND = (0.6130, 0.0101, 0.3984)  # OpenSplat's


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder of photos with cameras")
    parser.add_argument("opensplat", type=Path, help="the program")
    parser.add_argument("--sizes", nargs="+", default=SIZES, metavar="WIDTH,POINTS,STEPS")
    parser.add_argument("--results", type=Path, default=Path("out/opensplat.json"))
    options = parser.parse_args()
    rows = []
    print("| photos, points | program | steps | seconds | processor seconds | Gaussians | PSNR |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for size in options.sizes:
        width, points, steps = map(int, size.split(","))
        scene = load_scene(options.scene, width=width)
        with tempfile.TemporaryDirectory() as name:
            folder, found = Path(name), {}
            write_colmap(scene, points, folder / "scene")
            fit(options.scene, folder / "warm", width, points, 20)  # compiles kernels
            theirs = run(
                [options.opensplat, folder / "scene", "-n", steps, "-o", folder / "splat.ply", *PLAIN],
                TWO_THREADS,
            )
            found["OpenSplat"] = steps, theirs, folder / "splat.ply"
            ours = fit(options.scene, folder / "ours", width, points, steps)
            found["keyss"] = steps, ours, folder / "ours/model.ply"
            more = min(MOST_STEPS, int(steps * theirs.processor / ours.processor))
            longer = fit(options.scene, folder / "longer", width, points, more)
            found["keyss, equal time"] = more, longer, folder / "longer/model.ply"
            for program, (count, cost, path) in found.items():
                model = read_model(path)
                behind = torch.tensor(BACKGROUND) if program == "OpenSplat" else scene.background
                psnr = mean_psnr(model, scene.test, behind)
                numbers = (
                    f"{count:,} | {cost.seconds:.1f} | {cost.processor:.1f} | {len(model):,} | {psnr:.2f}"
                )
                print(f"| {width} px, {points:,} | {program} | {numbers} |", flush=True)
                rows.append({"size": size, "program": program, "steps": count, "psnr": psnr, **vars(cost)})
    options.results.parent.mkdir(parents=True, exist_ok=True)
    options.results.write_text(json.dumps(rows, indent=1) + "\n")


PLAIN = ("--keep-crs", "--cpu", "--num-downscales", "0")


def fit(scene: Path, out: Path, width: int, gaussians: int, steps: int) -> Cost:
    """`keyss fit`, with a seed."""
    options = ["--width", width, "--max-gaussians", gaussians, "--iterations", steps, "--seed", 0]
    return run([sys.executable, "-m", "keyss", "fit", scene, *options, "-o", out], TWO_THREADS)


def write_colmap(scene: Scene, points: int, folder: Path) -> None:
    """The training photos as a binary COLMAP model, with evenly sampled points."""
    (folder / "images").mkdir(parents=True)
    cameras, images = [], []
    for index, view in enumerate(scene.train):
        camera, name = view.camera, f"{index:05d}.png"
        Image.fromarray(view.image.numpy()).save(folder / "images" / name)
        params = [float(camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]
        cameras.append(camera_bytes(index + 1, PINHOLE[0], params, camera.width, camera.height))
        x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3].double().numpy()).as_quat()
        at = camera.viewmat[:3, 3].tolist()
        images.append(image_bytes(index + 1, name, (w, x, y, z), at, index + 1, observations=0))
    every = np.linspace(0, len(scene.points) - 1, min(points, len(scene.points))).astype(int)
    positions, colors = scene.points[every].tolist(), scene.colors[every].tolist()
    rows = [point_bytes(1, at, rgb, track=()) for at, rgb in zip(positions, colors, strict=True)]
    for file, records in (("cameras", cameras), ("images", images), ("points3D", rows)):
        (folder / f"{file}.bin").write_bytes(counted(*records))


if __name__ == "__main__":
    main()

"""What the monkey works on: scenes, models and keys, sound and broken."""

from __future__ import annotations

import os
import random
from pathlib import Path

import numpy as np
import torch

from files.scene_files import photo, save, write_blender, write_colmap, write_nerfstudio
from keyss.core.gaussians import Gaussians
from keyss.files.ply import write_ply
from tiny_scenes import random_gaussians

KEYS = ("q7Rv2LxT9bWm4KzD", "fedcba9876543210", "Zm3nB8vC1xK5jH7g")
SCENES = [
    "in/a",
    "in/b",
    "in/c",
    "in/one-missing",
    "in/broken-json",
    "in/no-points",
    "in/empty",
    "in/not-images",
]
MODELS = [
    *("in/cover.ply", "in/large.ply", "in/secret.ply", "in/sh0.ply", "in/half.ply", "in/one.ply"),
    *("in/huge.ply", "in/outlier.ply", "in/nan.ply", "in/inf.ply", "in/transparent.ply", "in/zero-quats.ply"),
    *("in/cut.ply", "in/head.ply", "in/flipped.ply", "in/flipped-2.ply", "in/none.ply", "in/many.ply"),
    *("in/same.ply", "in/model.spz", "in/text.ply", "in/folder.ply", "in/link.ply", "in/dangling.ply"),
    *("in/loop.ply", "in/fifo.ply", "in/ascii.ply", "in/zero-bytes.ply"),
]
KEY_FILES = [
    *("in/key-0.txt", "in/spaced.txt", "in/blank.txt", "in/binary.txt", "in/long.txt", "in/open.txt"),
    *("in/a", "nowhere.txt", "in/cover.ply", ""),
]
INPUTS = [*SCENES, *MODELS, *KEY_FILES[:-3]]
ODD_OUTS = [
    *("in", "in/a", "in/cover.ply", "in/empty", "nowhere/deep/out", "", ".", "/dev/null", "in/link-out"),
    *("in/dangling.ply", "in/mine", "out-odd\nname", "-", "-x", "out-link"),
]


def make_inputs(folder: Path) -> None:
    """Scenes, models and keys, sound and broken, in `in/`."""
    here = folder / "in"
    write_blender(here / "a", count=3, channels=3)
    write_nerfstudio(here / "b", count=4)
    write_colmap(here / "c", count=4)
    write_colmap(here / "one-missing", count=5)
    (here / "one-missing" / "images" / "02.png").unlink()
    write_colmap(here / "no-points", count=4)
    (here / "no-points" / "sparse" / "0" / "points3D.bin").unlink()
    (here / "broken-json").mkdir()
    (here / "broken-json" / "transforms.json").write_text('{"frames": [{"file_path": 3}], "w": 1e999}')
    (here / "empty").mkdir()
    save(here / "not-images" / "one.png", photo(1))
    (here / "not-images" / "two.png").write_bytes((here / "not-images" / "one.png").read_bytes()[:60])
    (here / "not-images" / "three.png").write_text("no image")
    (here / "mine" / "publish").mkdir(parents=True)
    for name in ("publish/stego.ply", "model.ply", "000.png"):
        (here / "mine" / name).write_text("mine")

    sound = random_gaussians(1200, seed=1)
    models: dict[str, Gaussians] = {
        "cover": random_gaussians(400, seed=2),
        "large": sound,
        "secret": random_gaussians(150, seed=3),
        "sh0": random_gaussians(300, seed=4, sh_degree=0),
        "one": random_gaussians(1, seed=5),
        "transparent": changed(sound[:200], "opacity_logits", slice(None), -30.0),
        "zero-quats": changed(sound[:200], "quats", slice(None), 0.0),
        "huge": changed(sound[:200], "means", slice(0, 3), 1e30),
        "outlier": changed(sound[:300], "log_scales", slice(0, 1), 60.0),
        "half": sound[:300].map(lambda values: values.half().float()),
        "same": Gaussians.cat([sound[:1]] * 200),
    }
    for name, model in models.items():
        write_ply(here / f"{name}.ply", model)
    data = (here / "cover.ply").read_bytes()
    at = data.index(b"end_header\n") + len(b"end_header\n")
    for name, number in (("nan", np.nan), ("inf", np.inf)):
        bytes_of = np.float32(number).tobytes()
        (here / f"{name}.ply").write_bytes(data[: at + 400] + bytes_of + data[at + 404 :])
    (here / "cut.ply").write_bytes(data[:-100])
    (here / "head.ply").write_bytes(data[:100])
    (here / "none.ply").write_bytes(data[:at].replace(b"vertex 400", b"vertex 0"))
    (here / "many.ply").write_bytes(data.replace(b"vertex 400", b"vertex 99999999999"))
    rng = random.Random(7)
    for name in ("flipped", "flipped-2"):
        flipped = bytearray(data)
        for _ in range(40):
            flipped[rng.randrange(at, len(data))] ^= 1 << rng.randrange(8)
        (here / f"{name}.ply").write_bytes(flipped)
    (here / "model.spz").write_bytes(b"\x1f\x8b" + bytes(50))
    (here / "text.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\nx\n"
    )
    (here / "ascii.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    (here / "zero-bytes.ply").write_bytes(b"")
    (here / "folder.ply").mkdir()
    (here / "link.ply").symlink_to("cover.ply")
    (here / "dangling.ply").symlink_to("nothing.ply")
    (here / "loop.ply").symlink_to("loop.ply")
    (here / "link-out").symlink_to("mine")
    os.mkfifo(here / "fifo.ply")
    keys = {f"key-{number}.txt": f"{key}\n".encode() for number, key in enumerate(KEYS)}
    keys |= {"spaced.txt": f" {KEYS[0]} \n".encode(), "blank.txt": b"\n", "binary.txt": b"\xff\xfe\0x"}
    keys |= {"long.txt": b"x" * 5000, "open.txt": KEYS[1].encode()}
    for name, key in keys.items():
        (here / name).write_bytes(key)
        (here / name).chmod(0o644 if name == "open.txt" else 0o600)


def changed(model: Gaussians, name: str, where: slice, value: float) -> Gaussians:
    """`model` with a number in some rows of one of its tensors."""
    tensors = {each: tensor.clone() for each, tensor in vars(model).items()}
    tensors[name][where] = torch.tensor(value)
    return Gaussians(**tensors)

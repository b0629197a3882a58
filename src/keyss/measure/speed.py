"""What a user feels: how long things take, how large files are, whether other people's programs read them."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from keyss.core.errors import BackendError, KeyssError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.models import read_model, write_model
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.robustness.conversions import find_gsply, transform
from keyss.measure.robustness.reopening import Reopen
from keyss.rendering import render

Columns = dict[str, np.ndarray[Any, Any]]


def speed(
    stego: Path,
    reopen: Sequence[Reopen],  # one for each secret
    scenes: Sequence[Scene],  # the cover, then the secrets
    plains: Sequence[Gaussians],  # plain 3DGS models of the same scenes
    *,
    sidecar: Path | None = None,
    views: int = 4,
    rounds: int = 15,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Times, sizes and readers of the published model and of what the keys reveal. JSON-able.

    "render": for the published model and each revealed one what `render_ratio` says, beside the plain model
    of its scene. "reveal": seconds from file to file for each secret (median of three), reading, key
    derivation and writing included. "files": bytes. "readers": see `readers`, of the published and the
    revealed files. `progress`: called with models done, models in all, and the next one's name. Raises
    KeyssError where a secret does not open.
    """
    names = ["stego", *(f"secret {number}" for number in range(1, len(scenes)))]
    files: dict[str, int] = {}
    if sidecar is not None:
        files["sidecar"] = sidecar.stat().st_size
    rendered, revealed, read = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, scene, plain) in enumerate(zip(names, scenes, plains, strict=True)):
            if progress is not None:
                progress(number, len(names), name)
            file = stego
            if number > 0:
                file = Path(folder) / f"{number}.ply"
                revealed.append({"model": name, "seconds": reveal_seconds(stego, reopen[number - 1], file)})
            files[name] = file.stat().st_size
            ratio = render_ratio(
                read_model(file).to(device), plain.to(device), scene, views=views, rounds=rounds
            )
            rendered.append({"model": name, **ratio})
            read += [{"model": name, **found} for found in readers(file)]
    if progress is not None:
        progress(len(names), len(names), "")
    return {"render": rendered, "reveal": revealed, "files": files, "readers": read}


@torch.no_grad()
def render_ratio(
    model: Gaussians, plain: Gaussians, scene: Scene, *, views: int = 4, rounds: int = 15
) -> dict[str, Any]:
    """How long a picture of `model` takes as a ratio to one of `plain`, from a scene's test cameras.

    Each round draws at most `views` views with both, one right after the other and the first in turns; the
    first round warms up and does not count. "ratio" is the median over pairs of pictures, so that what else
    the machine does cancels; "milliseconds" and "plain_milliseconds" are medians too.
    """
    cameras = [view.camera for view in subsample_views(scene.test, views)]
    background = scene.background.to(model.device)
    times = np.zeros((rounds + 1, len(cameras), 2))
    for number in range(rounds + 1):
        for index, camera in enumerate(cameras):
            for which in (0, 1) if (number + index) % 2 else (1, 0):
                start = time.perf_counter()
                render((model, plain)[which], camera, background)
                if model.device.type == "cuda":
                    torch.cuda.synchronize()
                times[number, index, which] = time.perf_counter() - start
    counted = times[1:].reshape(-1, 2)
    milliseconds, plain_milliseconds = 1000 * np.median(counted, axis=0)
    return {
        "ratio": float(np.median(counted[:, 0] / counted[:, 1])),
        "milliseconds": float(milliseconds),
        "plain_milliseconds": float(plain_milliseconds),
        "gaussians": len(model),
        "plain_gaussians": len(plain),
    }


def reveal_seconds(stego: Path, reopen: Reopen, out: Path, *, repeats: int = 3) -> float:
    """Median of the seconds from the published file to the revealed one at `out`."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        write_model(out, reopen(read_model(stego)).gaussians)
        seconds.append(time.perf_counter() - start)
    return median(seconds)


def readers(path: Path) -> list[dict[str, Any]]:
    """Whether other people's programs read a .ply of ours: plyfile, gsply and splat-transform.

    "gaussians": how many they find, "equal": whether all values are those that we read, to the last bit. One
    that fails says why in "error", and one that is not installed in "skipped".
    """
    expected = _columns_of(read_model(path))
    found: list[dict[str, Any]] = []
    for name, read in (("plyfile", _plyfile), ("gsply", _gsply), ("splat-transform", _splat_transform)):
        try:
            columns = read(path)
        except BackendError as error:
            found.append({"reader": name, "skipped": f"{error}"})
        except (KeyssError, OSError, ValueError, KeyError) as error:
            found.append({"reader": name, "error": f"{error}"})
        else:
            equal = all(np.array_equal(columns[key], values) for key, values in expected.items())
            found.append({"reader": name, "gaussians": len(columns["means"]), "equal": equal})
    return found


def _columns_of(model: Gaussians) -> Columns:
    return {name: values.numpy() for name, values in vars(model).items()}


def _plyfile(path: Path) -> Columns:
    try:
        plyfile = import_module("plyfile")
    except ImportError as error:
        raise BackendError("plyfile is not installed (pip install plyfile)") from error
    vertices = plyfile.PlyData.read(path)["vertex"]

    def columns(*names: str) -> np.ndarray[Any, Any]:
        return np.stack([vertices[name] for name in names], axis=1)

    rest = sum(each.name.startswith("f_rest_") for each in vertices.properties)
    constant = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    higher = columns(*(f"f_rest_{i}" for i in range(rest))) if rest else constant[:, :0, 0]
    return {
        "means": columns("x", "y", "z"),
        "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "log_scales": columns("scale_0", "scale_1", "scale_2"),
        "opacity_logits": np.asarray(vertices["opacity"]),
        "sh": np.concatenate([constant, higher.reshape(len(constant), 3, -1).transpose(0, 2, 1)], axis=1),
    }


def _gsply(path: Path) -> Columns:
    data = find_gsply().plyread(path)
    count = len(data.means)
    return {
        "means": data.means,
        "quats": data.quats,
        "log_scales": data.scales,
        "opacity_logits": data.opacities.reshape(count),
        "sh": np.concatenate([data.sh0[:, None], data.shN.reshape(count, -1, 3)], axis=1),
    }


def _splat_transform(path: Path) -> Columns:
    with tempfile.TemporaryDirectory() as folder:
        return _columns_of(read_model(transform(path, Path(folder) / "copy.ply")))

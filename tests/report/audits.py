"""A small audit with every section, made by hand: its numbers are no measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from PIL import Image

RED, GREEN, BLUE = (220, 30, 30), (30, 160, 60), (30, 60, 220)
_PICTURES = {"photo": RED, "published": BLUE, "plain": GREEN, "leak": (90, 90, 90)}


def audit() -> dict[str, Any]:
    """Two secrets, three plain models; opacities are out of bounds, and so is the second secret's quality."""
    return {
        "version": 1,
        "keyss": "0.2.0",
        "seconds": 90.5,
        "run": {
            "path": "runs/two",
            "method": "learned",
            "cover": "scenes/garden",
            "secrets": ["scenes/treasure", "scenes/map"],
            "width": 320,
            "gaussians": 12345,
            "preset": "best",
            "config": {"fit": {"iterations": 3000, "seed": 7}, "mask": ["op"]},
            "versions": {"python": "3.11.7", "torch": "2.5.0"},
        },
        "null": {"models": 3, "seeds": [11, 12, 13]},
        "images": {
            "cover": _comparison(27.5),
            "cover_bound": _comparison(27.0),
            "secrets": [_comparison(30.0), _comparison(25.5)],
            "secret_bounds": [_comparison(30.5), _comparison(28.0)],
        },
        "wrong_key": {
            "keys": 16,
            "vs_cover": {"mean": 27.5, "min": 27.4},
            "vs_secrets": [{"mean": 7.1, "max": 7.2}, {"mean": 8.0, "max": 8.5}],
            "floor": [7.0, 8.0],
        },
        "sinkhorn": {"stego": _sinkhorn(0.0071), "null": [_sinkhorn(0.0064), _sinkhorn(0.0066)]},
        "distances": {
            "attributes": {
                "position": {"distance": 0.011, "null": 0.01, "ratio": 1.1},
                "opacity": {"distance": 0.09, "null": 0.01, "ratio": 9.0},
            }
        },
        "two_sample": {
            "stego": [{"auc": 0.55, "low": 0.54, "high": 0.56}],
            "null": [{"auc": 0.52, "low": 0.51, "high": 0.53}],
        },
        "stegexpose": {
            "plain": [_scores("a.png"), _scores("b.png")],
            "stego": [_scores("a.png"), _scores("b.png")],
            "roc": {"auc": 0.75, "low": 0.3, "high": 1.0, "fpr": [0, 0.5, 1], "tpr": [0, 1, 1]},
            "detectors": {"primary_sets": 0.5, "chi_square": None, "sample_pairs": 0.5, "rs": 0.75},
        },
        "sealwatch": {"missing": "sealwatch is not installed: `pip install sealwatch`."},
        "leaks": [[_leak("restored", 0.4), _leak("inverted", -0.1)], [_leak("restored", 0.2)]],
        "robustness": [
            _attack("none", 0, 0.0, [0.0, 0.0]),
            _attack("random pruning", 0.1, 1.0, [1.5, 1.6]),
            _attack("random pruning", 0.25, 2.5, [3.5, 3.7]),
            _attack("half floats", None, 0.0, [22.0, 20.0], opens=False),
            {"attack": ".spz", "strength": None, "unit": "", "sentence": "", "skipped": "gsply is missing"},
        ],
        "speed": {
            "render": [{"model": "stego", "seconds": 0.021, "ratio": 1.4}],
            "reveal_seconds": 0.5,
            "files": [{"name": "stego.ply", "bytes": 2961530}],
            "readers": [{"reader": "plyfile", "file": "stego.ply", "loads": True, "gaussians": 12345}],
        },
        "pictures": [
            {
                "title": "Cover",
                "items": [
                    {"label": "photo", "file": "pictures/photo.png"},
                    {"label": "published", "file": "pictures/published.png"},
                    {"label": "plain 3DGS", "file": "pictures/plain.png"},
                ],
            }
        ],
        "histograms": {
            "opacity": {"edges": [-8, 0, 8], "stego": [0.6, 0.4], "plain": [[0.3, 0.7], [0.4, 0.6]]}
        },
    }


def write_run(folder: Path, data: object) -> Path:
    """A run's folder with this audit and its pictures, 8 x 6 pixels of one colour each."""
    pictures = folder / "audit" / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    for name, color in _PICTURES.items():
        Image.new("RGB", (8, 6), color).save(pictures / f"{name}.png")
    (folder / "audit" / "audit.json").write_text(json.dumps(data))
    return folder


def _comparison(psnr: float) -> dict[str, Any]:
    numbers = {"psnr": psnr, "ssim_3dgs": 0.9, "ssim_standard": 0.89, "flip": 0.1}
    return {
        "views": [{"name": "0001.jpg", **numbers}, {"name": "0009.jpg", **numbers}],
        "mean": numbers,
        "missing": {"lpips_alex": "LPIPS needs `pip install lpips`."},
    }


def _sinkhorn(value: float) -> dict[str, float]:
    names = ("opacity", "rotation", "scale", "position", "colour", "mean")
    return {**dict.fromkeys(names, value), "sum": 5 * value}


def _scores(name: str) -> dict[str, Any]:
    return {
        "name": name,
        "primary_sets": None,
        "chi_square": 0.0,
        "sample_pairs": 0.03,
        "rs": 0.02,
        "fusion": 0.02,
    }


def _leak(attack: str, leak: float) -> dict[str, Any]:
    return {
        "attack": attack,
        "sentence": "faint Gaussians are made opaque",
        "psnr": 7.0 + leak,
        "ssim": 0.2,
        "gradient": 0.05,
        "null": {"psnr": 7.0, "ssim": 0.19, "gradient": 0.05},
        "leak": {"psnr": leak, "ssim": 0.01, "gradient": 0.0},
        "picture": "pictures/leak.png",
    }


def _attack(
    name: str, strength: float | None, cover: float, secrets: list[float], opens: bool = True
) -> dict[str, Any]:
    return {
        "attack": name,
        "strength": strength,
        "unit": "share",
        "sentence": f"{name} of the published file",
        "cover": {"psnr": 27.5 - cover, "ssim": 0.8, "loss": cover},
        "secrets": [{"psnr": 30 - loss, "ssim": 0.8, "loss": loss, "opens": opens} for loss in secrets],
    }

"""The verb `info`: what is in a file or a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from keyss.channels.sidecar import read_header
from keyss.core.errors import InputError
from keyss.core.scene import Scene
from keyss.files.models import describe_model, is_model_path
from keyss.files.scenes import load_scene
from keyss.methods.learned.revealing import read_sidecar
from keyss.runs.files import METRICS, MODEL, STEGO, read_json


def info(path: str | Path) -> dict[str, Any]:
    """What is in a PLY, a sealed decoder, a scene folder or a folder of results, as JSON-able facts."""
    path = Path(path)
    if path.is_dir():
        if (path / STEGO).exists():
            return {"kind": "hiding", "path": str(path), "metrics": read_json(path / METRICS)}
        if (path / MODEL).exists():
            return {"kind": "plain model", "path": str(path), "metrics": read_json(path / METRICS)}
        return _describe_scene(load_scene(path))
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if is_model_path(path):
        facts = describe_model(path)
        return {
            "kind": "3DGS model",
            "path": str(path),
            "bytes": facts.bytes,
            "gaussians": facts.count,
            "sh_degree": facts.sh_degree,
            "bounding_box": [[round(x, 4) for x in corner] for corner in (facts.lower, facts.upper)],
            "opacity_below_0.05": round(facts.faint_share, 4),
        }
    try:
        derivation, _, _ = read_header(read_sidecar(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return {
        "kind": "sealed decoder",
        "path": str(path),
        "bytes": path.stat().st_size,
        "key_derivation": {
            "function": "Argon2id",
            "memory_kib": derivation.memory_kib,
            "time_cost": derivation.time_cost,
            "parallelism": derivation.parallelism,
        },
    }


def _describe_scene(scene: Scene) -> dict[str, Any]:
    camera = scene.train[0].camera
    return {
        "kind": "scene",
        "name": scene.name,
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        "image_size": [camera.width, camera.height],
        "points": len(scene.points),
        "extent": round(scene.extent, 4),
        "background": [round(float(x), 4) for x in scene.background],
    }

"""The command `doctor`."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from functools import partial
from importlib import metadata
from typing import Annotated

from keyss._version import __version__
from keyss.cli.arguments import Device, switch
from keyss.core.errors import BackendError, KeyssError

# The first package that each extra of pyproject.toml installs, and its purpose.
EXTRAS = {
    "audit": ("scikit-learn", "keyss audit, compare and reproduce"),
    "clip": ("transformers", "the paper's key encoder"),
    "sweep": ("ray", "sweeps on a cluster"),
}
LIBRARIES = ("torch", "gsplat", "numba", "numpy", "opencv-python-headless", "cryptography", "argon2-cffi")
OPTIONAL = ("GPU", "kernel cache", "splat-transform", *(f"[{name}]" for name in EXTRAS))
_TOLERANCE = 1e-4  # colours are in [0, 1]


def doctor(
    *,
    json_: Annotated[bool, switch("Print JSON.", name="json")] = False,
    device: Device = "auto",
) -> None:
    """Check the installation: versions, devices, optional packages, a test render.

    Exit status: 0 everything required works, 6 something does not. The first call compiles the rasterizer,
    10 to 20 s; on a machine with a GPU, gsplat may compile for minutes.

    example: keyss doctor
    """
    checks: dict[str, Callable[[], str]] = {
        "keyss": lambda: f"{__version__}, Python {platform.python_version()}, {platform.platform()}",
        **{name: partial(_version, name, f"pip install {name}") for name in LIBRARIES},
        "cores": _cores,
        "GPU": _gpu,
        "kernel cache": _cache,
        "test frame": partial(_frame, device),
        **{
            f"[{name}]": partial(_version, package, f"for {purpose}: pip install 'keyss[{name}]'")
            for name, (package, purpose) in EXTRAS.items()
        },
        "splat-transform": _splat_transform,
    }
    results = {name: _result(name, check) for name, check in checks.items()}
    if json_:
        from keyss.cli.tables import print_json

        print_json({name: {"state": state, "says": text} for name, (state, text) in results.items()})
    else:
        width = max(map(len, results))
        for name, (state, text) in results.items():
            print(f"{state:<7}  {name:<{width}}  {text}")
    if broken := [name for name, (state, _) in results.items() if state == "broken"]:
        raise BackendError(f"required components are broken: {', '.join(broken)} (see above)")


def _result(name: str, check: Callable[[], str]) -> tuple[str, str]:
    """The state of a component ("ok", "missing" if it is optional, "broken" otherwise) and a description."""
    try:
        return "ok", check()
    except KeyssError as error:
        return "missing" if name in OPTIONAL else "broken", str(error)
    except Exception as error:
        return "broken", f"{type(error).__name__}: {error}"


def _version(package: str, advice: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        raise BackendError(advice) from None


def _cores() -> str:
    import torch

    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{usable} of {os.cpu_count()} usable, {torch.get_num_threads()} threads"


def _gpu() -> str:
    import torch

    if not torch.cuda.is_available():
        raise BackendError("torch finds no CUDA GPU; the CPU is used")
    properties = torch.cuda.get_device_properties(0)
    return f"{properties.name}, {properties.total_memory / 1e9:.0f} GB, CUDA {torch.version.cuda}"


def _cache() -> str:
    from keyss.kernels.jit import cache_folder

    folder = cache_folder()
    if folder is None:
        raise BackendError(
            "no folder that only this user can write to: every command compiles the kernels again, 10 to 20 s"
        )
    return str(folder)


def _frame(device: Device) -> str:
    """Render one Gaussian, and check a pixel in its middle and one in a corner."""
    import torch

    from keyss.core import SH_C0, Camera, Gaussians
    from keyss.rendering import render, resolve_device

    target = resolve_device(device)
    model = Gaussians(
        means=torch.tensor([[0.0, 0.0, 4.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), -1.5),
        opacity_logits=torch.tensor([2.0]),
        sh=torch.tensor([[[1.0, 0.0, -1.0]]]),
    ).to(target)
    K = torch.tensor([[80.0, 0, 32.5], [0, 80.0, 32.5], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, 65, 65, "doctor.png")
    with torch.no_grad():
        render(model, camera)  # compiles the kernels, unless they are cached
        start = time.perf_counter()
        image = render(model, camera).cpu()
        seconds = time.perf_counter() - start
    expected = (0.5 + SH_C0 * model.sh[0, 0]) * model.opacities
    middle, corner = image[32, 32] - expected.cpu(), image[0, 0]
    if torch.cat([middle, corner]).abs().max() > _TOLERANCE:
        raise BackendError(f"the render on {target} is wrong")
    backend = "gsplat" if target.type == "cuda" else "the CPU rasterizer"
    return f"rendered by {backend} on {target} in {1e3 * seconds:.1f} ms"


def _splat_transform() -> str:
    from keyss.files.file_kinds import find_splat_transform

    return find_splat_transform()

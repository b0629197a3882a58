"""The command `doctor`."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from functools import partial
from importlib import metadata

from keyss._version import __version__
from keyss.cli.arguments import Device
from keyss.core.errors import BackendError, KeyssError
from keyss.files.file_kinds import find_splat_transform

# The first package that each extra of pyproject.toml installs, and its purpose.
_EXTRAS = {
    "audit": ("scikit-learn", "keyss audit, compare and reproduce"),
    "clip": ("transformers", "the paper's key encoder"),
    "sweep": ("ray", "sweeps on a cluster"),
}


def doctor(*, device: Device = "auto") -> None:
    """Check the installation: versions, devices, optional packages, a test render.

    Exit status: 0 everything required works, 6 something does not. The first call compiles the rasterizer,
    10 to 20 s; on a machine with a GPU, gsplat may compile for minutes.

    example: keyss doctor
    """
    required: dict[str, Callable[[], str]] = {
        "keyss": lambda: f"{__version__}, Python {platform.python_version()}, {platform.platform()}",
        **{name: partial(metadata.version, name) for name in ("torch", "gsplat", "numba", "numpy")},
        "test frame": partial(_frame, device),
    }
    optional: dict[str, Callable[[], str]] = {
        "GPU": _gpu,
        "kernel cache": _cache,
        **{f"[{name}]": partial(_extra, name, *extra) for name, extra in _EXTRAS.items()},
        "splat-transform": find_splat_transform,
    }
    broken = []
    for name, check in (required | optional).items():
        try:
            state, text = "ok", check()
        except KeyssError as error:
            state, text = "missing" if name in optional else "broken", str(error)
        except Exception as error:
            state, text = "broken", f"{type(error).__name__}: {error}"
        print(f"{state:<7}  {name:<15}  {text}", flush=True)
        broken += [name] if state == "broken" else []
    if broken:
        raise BackendError(f"required components are broken: {', '.join(broken)} (see above)")


def _extra(name: str, package: str, purpose: str) -> str:
    try:
        return f"{package} {metadata.version(package)}"
    except metadata.PackageNotFoundError:
        raise BackendError(f"for {purpose}: pip install 'keyss[{name}]'") from None


def _gpu() -> str:
    import torch

    if not torch.cuda.is_available():
        raise BackendError("torch finds no CUDA GPU; the CPU is used")
    return f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"


def _cache() -> str:
    from keyss.kernels.jit import cache_folder

    if (folder := cache_folder()) is None:
        raise BackendError("no folder that only you can write to: every command compiles for 10 to 20 s")
    return str(folder)


def _frame(device: Device) -> str:
    """Render one Gaussian, and check a pixel in its middle and one in a corner."""
    import torch

    from keyss.core import SH_C0, Camera, Gaussians
    from keyss.rendering import render, resolve_device

    target = resolve_device(device)
    values = [[0.0, 0.0, 4.0]], [[1.0, 0.0, 0.0, 0.0]], [[-1.5] * 3], [2.0], [[[1.0, 0.0, -1.0]]]
    model = Gaussians(*map(torch.tensor, values)).to(target)
    camera = Camera(torch.eye(4), torch.tensor([[80.0, 0, 32.5], [0, 80.0, 32.5], [0, 0, 1]]), 65, 65)
    with torch.no_grad():
        render(model, camera)  # compiles the kernels, unless they are cached
        start = time.perf_counter()
        image = render(model, camera).cpu()
        milliseconds = 1e3 * (time.perf_counter() - start)
    expected = (0.5 + SH_C0 * model.sh[0, 0]) * model.opacities
    errors = torch.cat([image[32, 32] - expected.cpu(), image[0, 0]])
    if errors.abs().max() > 1e-4:  # colours are in [0, 1]
        raise BackendError(f"the render on {target} is wrong")
    return f"rendered on {target} in {milliseconds:.1f} ms, {torch.get_num_threads()} threads"

"""The command `doctor`."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Annotated, Literal

from keyss.cli.arguments import Device, switch

if TYPE_CHECKING:
    import torch

# What each extra of pyproject.toml installs, and what that is for.
EXTRAS = {
    "audit": ("scikit-learn", "keyss audit, compare and reproduce"),
    "clip": ("transformers", "the paper's key encoder"),
    "reproduce": ("pooch", "downloading the paper's scenes"),
    "sweep": ("ray", "sweeps and batches on a cluster"),
    "tensorboard": ("tensorboard", "losses during training"),
    "video": ("av", "keyss render --video"),
}
_LIBRARIES = ("torch", "gsplat", "numba", "numpy", "opencv-python-headless", "cryptography", "argon2-cffi")
_TOLERANCE = 1e-4  # of a pixel's value from 0 to 1


@dataclass(frozen=True)
class Finding:
    """The state of one component: "missing" if it is optional, "broken" if it is required."""

    name: str
    state: Literal["ok", "missing", "broken"]
    says: str


def doctor(
    *,
    json_: Annotated[bool, switch("Print JSON.", name="json")] = False,
    device: Device = "auto",
) -> None:
    """Check the installation: versions, GPU, extras, a test render, a key derivation.

    Exit status: 0 everything required works, 6 something does not. The first call compiles the rasterizer,
    10 to 20 s; on a machine with a GPU, gsplat may compile for minutes.

    example: keyss doctor
    """
    from keyss.core.errors import BackendError

    found = list(findings(device))
    if json_:
        from keyss.cli.tables import print_json

        print_json({each.name: {"state": each.state, "says": each.says} for each in found})
    else:
        width = max(len(each.name) for each in found)
        for each in found:
            print(f"{each.state:<7}  {each.name:<{width}}  {each.says}")
    if broken := [each.name for each in found if each.state == "broken"]:
        raise BackendError(f"required components do not work: {', '.join(broken)} (see above)")


def findings(device: Literal["auto", "cpu", "cuda"]) -> Iterator[Finding]:
    """What `keyss doctor` prints, in order."""
    from keyss import __version__

    python, system = platform.python_version(), platform.platform()
    yield Finding("keyss", "ok", f"{__version__}, Python {python}, {system}")
    yield from map(_library, _LIBRARIES)
    yield from _checks(
        ("cores", _cores), ("GPU", _gpu), ("kernel cache", _cache), ("key derivation", _derivation)
    )
    yield from _checks(("test frame", lambda: _frame(device)))
    for extra, (package, use) in EXTRAS.items():
        version = _version(package)
        hint = f"for {use}: pip install 'keyss[{extra}]'"
        says = f"{package} {version}, for {use}" if version else hint
        yield Finding(f"[{extra}]", "ok" if version else "missing", says)
    yield from _checks(("splat-transform", _program))


def _checks(*checks: tuple[str, Callable[[], tuple[bool, str]]]) -> Iterator[Finding]:
    """Run checks, each of which returns whether its component is there, and a description."""
    for name, check in checks:
        try:
            there, says = check()
            yield Finding(name, "ok" if there else "missing", says)
        except Exception as error:
            yield Finding(name, "broken", f"{type(error).__name__}: {error}")


def _version(package: str) -> str | None:
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


def _library(package: str) -> Finding:
    version = _version(package)
    return Finding(package, "ok" if version else "broken", version or f"pip install {package}")


def _cores() -> tuple[bool, str]:
    import torch

    from keyss._processes import usable_cores

    return True, f"{usable_cores()} of {os.cpu_count()} usable, {torch.get_num_threads()} threads"


def _gpu() -> tuple[bool, str]:
    import torch

    if not torch.cuda.is_available():
        return False, "torch finds no CUDA GPU; the CPU is used"
    properties = torch.cuda.get_device_properties(0)
    return True, f"{properties.name}, {properties.total_memory / 1e9:.0f} GB, CUDA {torch.version.cuda}"


def _cache() -> tuple[bool, str]:
    from keyss.rendering.cpu.jit import cache_folder

    folder = cache_folder()
    if folder is None:
        return False, "no writable folder: every command compiles the kernels again, 10 to 20 s"
    return True, str(folder)


def _derivation() -> tuple[bool, str]:
    from keyss.keys import DerivedKey, KeyDerivation

    start = time.perf_counter()
    derivation = KeyDerivation(salt=bytes(16))
    DerivedKey("doctor", derivation)
    return True, f"Argon2id with {derivation.memory_kib >> 10} MiB in {time.perf_counter() - start:.2f} s"


def _frame(device: Literal["auto", "cpu", "cuda"]) -> tuple[bool, str]:
    """Render one Gaussian, and check a pixel in its middle and one in a corner."""
    import torch

    from keyss.core import BackendError, Camera, Gaussians
    from keyss.core.gaussians import SH_C0
    from keyss.rendering import render, resolve_device

    size, color = 65, torch.tensor([0.9, 0.5, 0.1])
    chosen = resolve_device(device)
    logit = 2.0
    model = Gaussians(
        means=torch.tensor([[0.0, 0.0, 4.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), -1.5),
        opacity_logits=torch.tensor([logit]),
        sh=((color - 0.5) / SH_C0)[None, None],
    )
    K = torch.tensor([[80.0, 0, size / 2], [0, 80.0, size / 2], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, size, size, "doctor.png")
    moved = model.to(chosen)
    with torch.no_grad():
        render(moved, camera)  # compiles the kernels, unless they are cached
        start = time.perf_counter()
        image = render(moved, camera).cpu()
        seconds = time.perf_counter() - start
    meant = color * torch.sigmoid(torch.tensor(logit))
    if not _near(image[size // 2, size // 2], meant) or not _near(image[0, 0], torch.zeros(3)):
        raise BackendError(f"the render on {chosen} is wrong")
    who = "gsplat" if chosen.type == "cuda" else "the CPU rasterizer"
    return True, f"rendered by {who} on {chosen} in {1e3 * seconds:.1f} ms"


def _near(found: torch.Tensor, meant: torch.Tensor) -> bool:
    return bool(((found - meant).abs() <= _TOLERANCE).all())


def _program() -> tuple[bool, str]:
    """The third-party converter that audits use."""
    from keyss.core.errors import BackendError
    from keyss.measure.robustness.conversions import find_splat_transform

    try:
        return True, find_splat_transform()
    except BackendError as error:
        return False, f"for conversions in audits: {error}"

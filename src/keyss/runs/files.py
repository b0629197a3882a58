"""Names of the files in a folder of results."""

from __future__ import annotations

import os
from pathlib import Path

from keyss.channels import SUFFIXES, suffix_of
from keyss.core.decoded import DecodedGaussians
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.files.models import DECODED_SUFFIX
from keyss.methods.handed import SUFFIX
from keyss.runs.folder import PRIVATE, PUBLISH

STEGO = f"{PUBLISH}/stego.ply"
# In any format.
STEGOS = (STEGO, *(f"{PUBLISH}/stego{suffix}" for suffix in (*SUFFIXES.values(), DECODED_SUFFIX)))
MODEL = "model.ply"  # of a plain fit
CONFIG, METRICS, REPORT = f"{PRIVATE}/config.json", f"{PRIVATE}/metrics.json", f"{PRIVATE}/report.html"
HANDED = f"{PRIVATE}/hand-over"  # for those who may see a secret
CONTROLS = f"{PRIVATE}/controls"  # plain models of the cover from other seeds, for audits


def is_run(folder: Path) -> bool:
    """True for the folder of a run; False if it cannot be read."""
    return os.path.isfile(folder / CONFIG)


def model_in(folder: Path) -> Path | None:
    """The resulting model of a run; `folder` is the run's, or its `publish/`."""
    names = (*STEGOS, MODEL, *(Path(name).name for name in (*STEGOS, MODEL)))
    return next((folder / name for name in names if os.path.isfile(folder / name)), None)


def stego_name(stego: Gaussians) -> str:
    """The name of the file of a published model in the folder of a run."""
    if isinstance(stego, DecodedGaussians):
        return f"{PUBLISH}/stego{DECODED_SUFFIX}"
    return f"{PUBLISH}/stego{suffix_of(stego)}"


def stego_in(folder: Path) -> Path:
    """The path of a run's published model, or its usual path if there is none."""
    return folder / next((name for name in STEGOS if os.path.isfile(folder / name)), STEGO)


def run_folder(path: Path) -> Path:
    """`path`, if it is the folder of a run.

    Otherwise raises InputError, which names the run that contains `path` if there is one.
    """
    if is_run(path):
        return path
    try:
        (path / CONFIG).stat()
    except PermissionError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except OSError:
        pass
    expected = f"{path}: expected the folder of a run, as `keyss hide` writes it"
    if not os.path.lexists(path):
        raise InputError(f"{expected}; there is nothing of that name")
    kind = "a folder" if os.path.isdir(path) else "a file"
    run = next((parent for parent in path.absolute().parents[:2] if is_run(parent)), None)
    if run is not None:
        raise InputError(f"{expected}, found {kind} in one; give {run}")
    raise InputError(f"{expected}, found {kind} without {CONFIG}")


def plain_names(secrets: int) -> list[str]:
    """Files of the plain models of the cover and of the secrets."""
    return [f"{PRIVATE}/cover.ply"] + [f"{PRIVATE}/secret-{index}.ply" for index in range(1, secrets + 1)]


def bound_names(secrets: int) -> list[str]:
    """Files of plain 3DGS with as many steps as the scenes, if these are more than those of plain models."""
    return [f"{PRIVATE}/bound-{index}.ply" for index in ("cover", *range(1, secrets + 1))]


def handed_names(secrets: int) -> list[str]:
    """Files to hand over for the secrets, with methods that need them."""
    return [f"{HANDED}/secret-{index}{SUFFIX}" for index in range(1, secrets + 1)]

"""`reveal` and `verify`: from a stego model and a key to the secret."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Unpack

from keyss.core.errors import KeyssWarning
from keyss.core.gaussians import Gaussians
from keyss.files.models import check_model_output, write_model
from keyss.files.streams import is_standard
from keyss.methods.base import Frame
from keyss.rendering import Backend, resolve_device
from keyss.runs.config import PathLike
from keyss.runs.folder import check_not_published
from keyss.runs.opening import as_model
from keyss.runs.revealing import RevealOptions, RevealResult, reveal_model
from keyss.runs.verifying import Verification, check_model, check_secret


def reveal(
    stego: PathLike | Gaussians,
    key: str | None = None,
    *,
    handed: PathLike | None = None,
    frame: Frame = "secret",
    decoy: bool = False,
    force: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> Gaussians:
    """The secret that `key` opens in a stego model, as an ordinary model.

    Which method hid it shows itself. `frame`: "secret" gives it in its own frame, so that its cameras fit it;
    "cover" leaves it where it was hidden, which a carried one never was. If Gaussians were lost, the others
    make up for them (`keyss.core.pruning_compensation`). `force` is for models that were quantised or pruned:
    it skips the check that a decoder is used with the model it was trained with, and takes as little of the
    secret as there is. `handed`: the file that was handed over for this secret, for methods that do so
    (`keyss.methods.handed`); some of them have no keys, and some give what a network decodes
    (`keyss.core.decoded`), which is no 3DGS model.

    `out` (a file) gets the revealed model. Raises WrongKeyError for a key that opens nothing (with `decoy`
    the cover comes instead, see `keyss.methods.decoy`), InputError for a file that is not what it should
    be, and where less than a tenth of the secret is left. Warns (KeyssWarning) of more than a hundredth that
    is missing. `reveal_counted` and `verify` tell how much there is.
    """
    found = reveal_counted(
        stego,
        key,
        handed=handed,
        frame=frame,
        decoy=decoy,
        force=force,
        device=device,
        out=out,
        overwrite=overwrite,
    )
    return found.gaussians


def reveal_counted(
    stego: PathLike | Gaussians,
    key: str | None = None,
    *,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    **options: Unpack[RevealOptions],
) -> RevealResult:
    """`reveal`, with the number of Gaussians that were hidden in the result."""
    target = resolve_device(device)
    inputs = [] if isinstance(stego, Gaussians) else [Path(stego)]
    path = None if out is None else check_model_output(out, overwrite, inputs)
    if path is not None and not is_standard(path):
        check_not_published(path)
    found = reveal_model(as_model(stego), key, device=target, **options)
    if not options.get("force"):
        found.check_usable()
    for sentence in found.warnings:
        warnings.warn(sentence, KeyssWarning, stacklevel=2)
    if path is not None:
        write_model(path, found.gaussians)
    return found


def verify(
    model: PathLike | Gaussians,
    key: str | None = None,
    *,
    device: Backend = "auto",
) -> Verification:
    """Whether a model is sound and, with a key, whether all is there that the key opens; nothing is written.

    Without a key, nothing that comes back says whether something is hidden. Raises InputError for a file that
    is no whole and finite model, WrongKeyError for a key that opens nothing.
    """
    target = resolve_device(device)
    name = "model" if isinstance(model, Gaussians) else str(model)
    gaussians = as_model(model)
    secret = None if key is None else check_secret(reveal_model(gaussians, key, device=target))
    return Verification(name, check_model(gaussians), secret)

"""`reveal` and `verify`: from a stego model and a key to the secret."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Unpack

from keyss.core.errors import KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.models import check_model_output, write_model
from keyss.files.streams import is_standard
from keyss.methods.base import Frame
from keyss.rendering import Backend, resolve_device
from keyss.runs.config import PathLike
from keyss.runs.folder import check_not_published
from keyss.runs.opening import as_model, sidecar_beside
from keyss.runs.revealing import RevealOptions, RevealResult, reveal_model
from keyss.runs.verifying import Verification, check_model, check_secret


def reveal(
    stego: PathLike | Gaussians,
    key: str,
    *,
    decoder: PathLike | bytes | None = None,
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
    make up for them (`keyss.core.pruning_compensation`). `force` is for models that were quantised: it skips
    the check that the secret belongs to this one, and takes as little of it as there is.

    `decoder`: a sidecar, or its bytes; by default the one beside the model's file if it opens and belongs to
    it, else what lies in the model's low bits. `out` (a file) gets the revealed PLY. Raises WrongKeyError for
    a key that opens nothing (with `decoy` the cover comes instead, see `keyss.methods.decoy`), InputError for
    files that are not what they should be or do not belong together, and where less than a tenth of the
    secret is left. Warns (KeyssWarning) of more than a hundredth that is missing, and of a sidecar beside
    the file that was passed over. `reveal_counted` and `verify` tell how much there is.
    """
    found = reveal_counted(
        stego,
        key,
        decoder=decoder,
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
    key: str,
    *,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    **options: Unpack[RevealOptions],
) -> RevealResult:
    """`reveal`, with the number of Gaussians that were hidden in the result."""
    target = resolve_device(device)
    beside = None if isinstance(stego, Gaussians) else sidecar_beside(Path(stego))
    read = (stego, options.get("decoder"), beside)
    inputs = [Path(each) for each in read if isinstance(each, str | Path)]
    path = None if out is None else check_model_output(out, overwrite, inputs)
    if path is not None and not is_standard(path):
        check_not_published(path)
    found = reveal_model(as_model(stego), key, device=target, beside=beside, **options)
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
    decoder: PathLike | bytes | None = None,
    device: Backend = "auto",
) -> Verification:
    """Whether a model is sound and, with a key, whether all is there that the key opens; nothing is written.

    Without a key, nothing that comes back says whether something is hidden. `decoder`: see `reveal`. Raises
    InputError for a file that is no whole and finite model or not the one the secret was hidden in,
    WrongKeyError for a key that opens nothing, UsageError for a decoder without a key.
    """
    if key is None and decoder is not None:
        raise UsageError("a sidecar is verified with its key: give `key`, or leave out `decoder`")
    target = resolve_device(device)
    name = "model" if isinstance(model, Gaussians) else str(model)
    gaussians = as_model(model)
    secret = None
    if key is not None:
        beside = None if isinstance(model, Gaussians) else sidecar_beside(Path(model))
        found = reveal_model(gaussians, key, device=target, decoder=decoder, beside=beside)
        secret = check_secret(found)
    return Verification(name, check_model(gaussians), secret)

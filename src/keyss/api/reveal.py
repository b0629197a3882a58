"""`reveal` and `verify`: from a stego model and a key to the secret."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from keyss.channels import open_payload
from keyss.core.errors import KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.atomic import check_not_an_input, check_output_file, write_bytes
from keyss.files.inputs import is_standard
from keyss.files.models import check_model_output, is_model_path, write_model
from keyss.methods.hidden import Frame, HiddenFile, OpensAFileError
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import PathLike, as_model
from keyss.runs.folder import check_not_published
from keyss.runs.revealing import (
    Revealed,
    Verification,
    check_model,
    check_secret,
    reveal_any,
    reveal_model,
    revealed_file,
)


def reveal(
    stego: PathLike | Gaussians,
    key: str | None = None,
    *,
    companion: PathLike | None = None,
    frame: Frame = "secret",
    force: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> Revealed:
    """Reveal the secret that `key` opens in a stego model: a scene, as an ordinary model, or a file.

    The model determines the method. `frame`: "secret" gives a scene in its own frame, in which its cameras
    are valid; "cover" leaves it in the cover's, in which carried secrets have no position. `force` is for
    quantised or pruned models with a secret of the method `keyss`: it skips the check that a decoder belongs
    to the model, and accepts any loss. `companion`: the companion file of this secret, for methods without
    keys (`keyss.methods.companion`). Some of these methods give a model that a network decodes
    (`keyss.core.picture_network`), which is no 3DGS model.

    `out` (a file) gets the secret: a scene for the suffix of a model (.ply, .spz, ...), else a file. Raises
    WrongKeyError for a key that opens nothing, InputError for a damaged file or if less than 10 % of the
    secret is left. Warns (KeyssWarning) of losses and of foreign Gaussians.
    """
    target = resolve_device(device)
    inputs = [] if isinstance(stego, Gaussians) else [Path(stego)]
    if out is not None and not is_standard(out) and not is_model_path(out):
        if key is None or companion or force or frame != "secret":
            raise UsageError(
                f"{out}: expected the name of a model, such as one that ends in .ply; `companion`, `force` "
                "and `frame` are not for hidden files"
            )
        return _reveal_file(stego, key, Path(out), overwrite, inputs)
    path = None if out is None else check_model_output(out, overwrite, inputs)
    if path is not None and not is_standard(path):
        check_not_published(path)
    try:
        found = reveal_model(
            as_model(stego), key, device=target, frame=frame, force=force, companion=companion
        )
    except OpensAFileError as error:
        if path is not None:
            raise
        return _with_warnings(revealed_file(error.file))
    if not force:
        found.check_usable()
    if path is not None:
        write_model(path, found.gaussians)
    return _with_warnings(found)


def _reveal_file(
    stego: PathLike | Gaussians, key: str, out: Path, overwrite: bool, inputs: list[Path]
) -> Revealed:
    """`reveal` of a hidden file into `out`."""
    check_not_an_input(out, inputs)
    path = check_output_file(out, overwrite)
    check_not_published(path)
    file = HiddenFile.of(open_payload(as_model(stego), key))
    write_bytes(path, file.data)
    return _with_warnings(revealed_file(file))


def _with_warnings(found: Revealed) -> Revealed:
    """Warn (KeyssWarning) of what is missing."""
    for sentence in found.warnings:
        warnings.warn(sentence, KeyssWarning, stacklevel=3)
    return found


def verify(
    model: PathLike | Gaussians,
    keys: str | Sequence[str] = (),
    *,
    device: Backend = "auto",
) -> Verification:
    """Check that a model is sound and, with keys, that their secrets are complete; writes nothing.

    Without keys, the result does not reveal whether something is hidden. Raises InputError for a file that
    is not a complete and finite model, WrongKeyError for a key that opens nothing.
    """
    target = resolve_device(device)
    name = "model" if isinstance(model, Gaussians) else str(model)
    gaussians = as_model(model)
    secrets = []
    given = [keys] if isinstance(keys, str) else keys
    for number, key in enumerate(given, 1):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", KeyssWarning)
            try:
                revealed = reveal_any(gaussians, key, target)
            except WrongKeyError as error:
                which = f"key {number} of {len(given)}: " if len(given) > 1 else ""
                raise WrongKeyError(f"{which}{error}") from error
        problems = [str(each.message) for each in caught if issubclass(each.category, KeyssWarning)]
        secrets.append(check_secret(revealed, problems))
    return Verification(name, check_model(gaussians), tuple(secrets))

"""`reveal` and `verify`: from a stego model and a key to the secret."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from keyss.core.errors import KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.atomic import check_not_an_input, check_output_file, write_bytes
from keyss.files.inputs import check_standard_output, is_standard, write_standard_output
from keyss.files.models import is_model_path, write_model
from keyss.methods.hidden import Frame
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import PathLike, as_model
from keyss.runs.folder import check_not_published
from keyss.runs.revealing import Revealed, SecretCheck, Verification, check_model, count_of, reveal_secret


def reveal(
    stego: PathLike | Gaussians,
    key: str | None = None,
    *,
    companion: PathLike | None = None,
    frame: Frame = "secret",
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> Revealed:
    """Reveal the secret that `key` opens in a stego model: a scene, as an ordinary model, or a file.

    The model determines the method. `frame`: "secret" gives a scene in its own frame, in which its cameras
    are valid; "cover" leaves it in the cover's, in which carried secrets have no position. `companion`: the
    companion file of this secret, for methods without keys (`keyss.methods.hidden`). Some of these methods
    give a model that a network decodes (`keyss.core.picture_network`), which is no 3DGS model.

    `out` (a file) gets the secret: a scene in the format of the suffix (.ply, .spz, ...), or the bytes of a
    file. Raises UsageError for a suffix of the wrong kind, WrongKeyError for a key that opens nothing,
    InputError for a damaged file or if less than 10 % of the secret is left. Warns
    (KeyssWarning) of losses and of foreign Gaussians.
    """
    target = resolve_device(device)
    path = None if out is None else Path(out)
    if path is not None and is_standard(path):
        check_standard_output()
    elif path is not None:
        check_not_an_input(path, [] if isinstance(stego, Gaussians) else [Path(stego)])
        check_output_file(path, overwrite)
        check_not_published(path)
    revealed = reveal_secret(as_model(stego), key, target, frame=frame, companion=companion)
    revealed.check_usable()
    if path is not None:
        _write(revealed, path)
    for sentence in revealed.warnings:
        warnings.warn(sentence, KeyssWarning, stacklevel=2)
    return revealed


def _write(revealed: Revealed, path: Path) -> None:
    """Write the secret. Raises UsageError for the name of another kind of file."""
    file = revealed.file
    if file is None:
        if not (is_standard(path) or is_model_path(path)):
            raise UsageError(
                f"this key opens a scene of {revealed.recovered.found:,} Gaussians: name the output as a "
                f"model, such as {path.stem}.ply, not {path.name}"
            )
        write_model(path, revealed.gaussians)
    elif is_standard(path):
        write_standard_output(file.data)
    elif is_model_path(path) and path.suffix.lower() != Path(file.name).suffix.lower():
        raise UsageError(
            f"this key opens a file of {len(file.data):,} bytes, {file.name!r}: name the output like it, not "
            f"{path.name}"
        )
    else:
        write_bytes(path, file.data)


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
    checked, secrets = check_model(gaussians), []
    given = [keys] if isinstance(keys, str) else keys
    for number, key in enumerate(given, 1):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", KeyssWarning)
            try:
                revealed = reveal_secret(gaussians, key, target)
            except WrongKeyError as error:
                which = f"key {number} of {len(given)}: " if len(given) > 1 else ""
                state = "; ".join(checked.problems) or "sound"
                raise WrongKeyError(f"{which}{error}; the model itself: {state}") from error
        problems = [str(warning.message) for warning in caught if issubclass(warning.category, KeyssWarning)]
        problems += revealed.warnings
        recovered, unit = revealed.recovered, "Gaussians" if revealed.file is None else "bytes"
        if revealed.file is None and not recovered.whole and not problems:
            problems.append(count_of(recovered))
        secrets.append(SecretCheck(recovered.found, recovered.hidden, unit, tuple(problems)))
    return Verification(name, checked, tuple(secrets))

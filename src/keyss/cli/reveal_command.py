"""The commands that open a published model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from keyss.cli.arguments import (
    Device,
    KeyFilesToCheck,
    OneKeyFile,
    Overwrite,
    check_exists,
    optional,
    switch,
    waiting_for,
)
from keyss.cli.keys import given_keys, keys
from keyss.core.errors import InputError
from keyss.files.atomic import check_not_an_input, check_output_file
from keyss.files.inputs import is_standard


def reveal(
    stego: Annotated[Positional[Path], arg(metavar="FILE", help="Published model, or - for stdin.")],
    *,
    key_file: OneKeyFile = (),
    out: Annotated[
        Path,
        arg(
            aliases=["-o"],
            metavar="FILE",
            help="Model to write (.ply, .spz, ...), or - for stdout; any other name for a hidden file.",
        ),
    ],
    companion: Annotated[
        Path | None, optional("FILE", "Companion file of the model, for methods that need one.")
    ] = None,
    frame: Annotated[
        Literal["secret", "cover"], arg(help="Coordinates: the secret's own, or those it was hidden in.")
    ] = "secret",
    overwrite: Overwrite = False,
    device: Device = "auto",
) -> None:
    """Reveal the secret that a key opens.

    example: keyss reveal runs/hidden/publish/model.ply --key-file key.txt -o revealed.ply

    example: keyss reveal - --key-file key.txt -o - < model.ply > revealed.ply
    """
    check_exists(stego, companion, keys=key_file)
    if not is_standard(out):  # before a key is asked for and torch is imported
        check_not_an_input(out, [stego])
        check_output_file(out, overwrite)
    import keyss

    key: str | None = None
    if companion is None or key_file:
        (key,) = keys(key_file, 1)
    from keyss.cli.tables import print_written

    with waiting_for("reveal", "opening", stego):
        revealed = keyss.reveal(
            stego,
            key,
            companion=companion,
            frame=frame,
            device=device,
            out=out,
            overwrite=overwrite,
        )
    if revealed.file is not None:
        print_written(out, f"{revealed.file.name!r}, {len(revealed.file.data):,} bytes")
        return
    recovered = revealed.recovered
    of = f" of {recovered.hidden:,}" if recovered.hidden else ""
    print_written(out, f"{recovered.found:,}{of} Gaussians")


def verify(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="Model (.ply, .spz, ...), or - for stdin.")],
    *,
    key_file: KeyFilesToCheck = (),
    json_: Annotated[bool, switch("Print JSON.", name="json")] = False,
    device: Device = "auto",
) -> None:
    """Check that a model is sound and, with a key, that its secret is complete.

    Exit status: 0 sound and as published, 3 the key opens nothing, 4 not sound, changed or not complete.

    example: keyss verify model.ply --key-file key.txt
    """
    check_exists(model, keys=key_file)
    import keyss
    from keyss.cli.tables import print_json, print_verification

    given = given_keys(key_file)
    with waiting_for("reveal" if given else "verify", "checking", model):
        checked = keyss.verify(model, given, device=device)
    (print_json if json_ else print_verification)(checked)
    if checked.problems:
        raise InputError(f"{model}: {'; '.join(checked.problems)}")

"""The commands that open what was hidden.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import Device, Overwrite, optional


def reveal(
    stego: Annotated[Positional[Path], arg(metavar="FILE", help="The published model, or - for stdin.")],
    *,
    key_file: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("FILE", "File with the key.", "KEYSS_KEY, or a hidden prompt"),
    ] = (),
    out: Annotated[
        Path,
        arg(
            aliases=["-o"],
            metavar="FILE",
            help="The model to write (.ply, .spz, ...), or - for stdout; a hidden file gets any other name.",
        ),
    ],
    handed: Annotated[
        Path | None,
        optional("FILE", "What was handed over beside the model, for methods that do so.", "there is none"),
    ] = None,
    frame: Annotated[
        Literal["secret", "cover"], arg(help="Whose coordinates: the secret's own, or where it was hidden.")
    ] = "secret",
    decoy: Annotated[bool, arg(help="With a wrong key, write the cover instead of failing.")] = False,
    force: Annotated[
        bool,
        arg(
            help="For a model that was quantised or pruned: skip the check that a decoder belongs to it, "
            "and write what there is."
        ),
    ] = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
) -> None:
    """Bring a secret back with its key.

    example: keyss reveal runs/hidden/publish/stego.ply --key-file key.txt -o secret.ply

    example: keyss reveal - --key-file key.txt -o - < stego.ply > secret.ply
    """
    from keyss import api
    from keyss.cli.keys import hinting_at_white_space, keys
    from keyss.core.errors import UsageError
    from keyss.files.models import is_model_path
    from keyss.files.streams import is_standard
    from keyss.runs.opening import is_sealed

    key: str | None = None
    if handed is None or key_file or is_sealed(handed):
        (key,) = keys(key_file, 1)
    if not is_standard(out) and not is_model_path(out):
        if key is None or handed or decoy or force or frame != "secret":
            raise UsageError(
                f"{out} is not the name of a model: expected one that ends in .ply, or a hidden file's, for "
                "which there is no --handed, --decoy, --force or --frame"
            )
        with hinting_at_white_space([key]):
            found = api.reveal_file(stego, key, out=out, overwrite=overwrite)
        print(f"{out}: {found.name!r}, {len(found.data):,} bytes")
        return
    with hinting_at_white_space([key] if key else []):
        revealed = api.reveal_counted(
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
    remains = revealed.remains
    of = f" of {remains.hidden:,}" if remains.hidden else ""
    print(f"{out}: {remains.found:,}{of} Gaussians", file=sys.stderr if is_standard(out) else sys.stdout)


def verify(
    model: Annotated[
        Positional[Path], arg(metavar="FILE", help="A 3DGS model (.ply, .spz, ...), or - for stdin.")
    ],
    *,
    key_file: Annotated[
        Path | None, optional("FILE", "File with a key: check what it opens.", "the model alone is checked")
    ] = None,
    json_: Annotated[bool, arg(name="json", help="Print JSON.")] = False,
    device: Device = "auto",
) -> None:
    """Check that a model is sound and, with a key, that all of its secret is there.

    Exit status 0 says so, 3 that the key opens nothing, 4 that something is wrong.

    example: keyss verify stego.ply --key-file key.txt
    """
    from msgspec import to_builtins

    from keyss import api
    from keyss.cli.keys import hinting_at_white_space, key_of_file
    from keyss.cli.tables import print_facts
    from keyss.core.errors import InputError
    from keyss.runs.records import record_bytes

    key = key_of_file(key_file) if key_file else None
    with hinting_at_white_space([key] if key else []):
        found = api.verify(model, key, device=device)
    if json_:
        print(record_bytes(found).decode(), end="")
    else:
        facts = to_builtins(found)
        print_facts(facts if found.secret else facts | {"secret": "not looked for, as no key was given"})
    if found.problems:
        raise InputError(f"{model}: {'; '.join(found.problems)}")

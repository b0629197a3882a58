"""All commands, and those of them that need no module of their own: a key, and the demo.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from keyss import __version__
from keyss.cli.arguments import Device, OutFolder, Overwrite, checked_seed, optional
from keyss.cli.comparing import compare
from keyss.cli.doctor import doctor
from keyss.cli.hiding import hide
from keyss.cli.measuring import audit, evaluate, report, steganalyze
from keyss.cli.models import convert, fit, info, render
from keyss.cli.reproducing import reproduce
from keyss.cli.revealing import reveal, verify
from keyss.cli.sweeping import key_of, sweep
from keyss.cli.viewing import export_html, view


def keygen(
    *,
    length: Annotated[
        int | None, optional("N", "Number of characters, 5.95 bits each.", "16, or what --bits needs")
    ] = None,
    bits: Annotated[int | None, optional("N", "Strength in bits instead of a length.", "none")] = None,
    out: Annotated[
        Path | None,
        optional(
            "FILE", "New file for the key, which nobody else can read.", "the standard output", aliases=["-o"]
        ),
    ] = None,
) -> None:
    """Make a new random key.

    example: keyss keygen -o key.txt
    """
    from keyss.cli.keys import write_new_key
    from keyss.core.errors import UsageError
    from keyss.keys import generate_key, length_for

    if length is not None and bits is not None:
        raise UsageError("give --length or --bits, not both")
    if bits is not None and bits < 1:
        raise UsageError(f"--bits: expected at least 1, got {bits}")
    if length is None:
        length = 16 if bits is None else length_for(bits)
    key = generate_key(length)
    if out is None:
        print(key)
        return
    write_new_key(out, key)
    print(f"{out}: a key of {length} characters; keep a copy, for nothing is opened without it")


def demo(
    *,
    out: OutFolder = Path("out/demo"),
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of everything random, the demo's key included.")] = 0,
) -> None:
    """Hide one made-up scene in another and open it again: everything in about two minutes.

    Both are compared with plain 3DGS of as many Gaussians and as many training steps.

    example: keyss demo -o out/demo
    """
    from keyss.cli.tables import print_files, print_hiding
    from keyss.demo.run import WRONG_KEYS, run_demo
    from keyss.progress import reporter

    result = run_demo(out, seed=checked_seed(seed), device=device, overwrite=overwrite, reporter=reporter())
    print_hiding(result.metrics)
    print(f"Of {len(WRONG_KEYS)} wrong keys tried at the door, {result.refused} were refused.")
    print_files(
        out,
        {
            "comparison.png": "all of it in one picture: look here first",
            "index.html": "what would be published, in a browser: type the key there",
            "publish/stego.ply": "what would be published: opens in any 3DGS viewer",
            "secret.ply": "what the key brought back from it",
            "web.spz": "both for the web: hidden to survive conversion, and converted",
            "key.txt": "the key of this demo, known to everybody",
            "scenes": "the photos",
            "private/metrics.json": "the numbers",
        },
    )


def completion(
    shell: Annotated[Positional[Literal["bash", "zsh"]], arg(metavar="{bash,zsh}", help="Which.")],
) -> None:
    """Print what makes a shell complete commands and options.

    bash loads it at its start; zsh looks for a file _keyss in the folders of its fpath.

    example: keyss completion bash >> ~/.bash_completion

    example: keyss completion zsh > ~/.zfunc/_keyss
    """
    from keyss.cli.entry import application

    application(["completion"], whole=True).run(["--tyro-print-completion", shell])


def version() -> None:
    """Print the version, as `keyss --version` does.

    example: keyss version
    """
    print(__version__)


ALL = (
    *(keygen, key_of, fit, hide, reveal, verify, render, convert, view, export_html),
    *(
        sweep,
        evaluate,
        audit,
        report,
        compare,
        reproduce,
        steganalyze,
        info,
        demo,
        doctor,
        completion,
        version,
    ),
)

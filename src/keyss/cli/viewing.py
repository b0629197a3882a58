"""The commands that show a published model in a browser.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from keyss.cli.arguments import Overwrite, optional

Up = Annotated[
    Literal["-y", "z", "y"], arg(help="Which way is up at first: -y as in COLMAP, z as in Blender.")
]


def view(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="The published model, of any format.")],
    *,
    port: Annotated[int, optional("N", "Port to serve on.", "any that is free")] = 0,
    host: Annotated[
        str, arg(metavar="ADDRESS", help="Address to serve on; any other than this one lets others look too.")
    ] = "127.0.0.1",
    up: Up = "-y",
) -> None:
    """Look at a published model in a browser, where its key can be typed.

    The page comes from this machine and asks nobody else for anything; keys stay in the browser.

    example: keyss view runs/hidden/publish/stego.ply
    """
    from keyss.core.errors import UsageError
    from keyss.viewer import ModelServer

    if not 0 <= port < 1 << 16:
        raise UsageError(f"--port: expected 0 to {(1 << 16) - 1}, got {port}")
    server = ModelServer(model, host, port, up)
    who = "only this machine" if host in ("127.0.0.1", "localhost", "::1") else f"whoever reaches {host}"
    print(f"{server.address} shows {model}, to {who}; Ctrl-C ends it", flush=True)
    server.run()


def export_html(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="The published model, of any format.")],
    *,
    out: Annotated[
        Path,
        arg(
            aliases=["-o"],
            metavar="PAGE",
            help="A name that ends in .html: one file that opens from disk; any other: a folder.",
        ),
    ],
    up: Up = "-y",
    overwrite: Overwrite = False,
) -> None:
    """Write a page that shows a published model and has a field for its key; no secret is in it.

    example: keyss export-html runs/hidden/publish/stego.ply -o page.html
    """
    from keyss.viewer import export_html

    written = export_html(model, out, up=up, overwrite=overwrite)
    size = sum(path.stat().st_size for path in written) / 1e6
    what = "opens in any browser" if len(written) == 1 else f"{len(written)} files for a web server"
    print(f"{out}: {size:.1f} MB; {what}")

"""The commands that open, show and measure published models."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from keyss.cli.arguments import (
    PHOTOS,
    Device,
    KeyFiles,
    KeyFilesToCheck,
    OneKeyFile,
    Overwrite,
    Photos,
    Run,
    check_exists,
    optional,
    switch,
    verb,
    waiting_for,
)
from keyss.cli.keys import given_keys, keys, keys_of_run
from keyss.core.errors import InputError, UsageError
from keyss.files.atomic import check_not_an_input, check_output_file
from keyss.files.inputs import is_standard

_VECTOR = r"[-+.\de]+(,[-+.\de]+){2}"
_POSE = rf"#?eye={_VECTOR}&target={_VECTOR}(&up=({_VECTOR}|-?[xyz]))?(&fov=[\d.]+,[\d.]+)?"


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


def view(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="Published model, of any format.")],
    *,
    out: Annotated[
        Path | None,
        optional(
            "PAGE",
            "Write the page instead of serving it: a name that ends in .html or .htm becomes one file that "
            "opens from disk, any other name a folder for a web server.",
            aliases=["-o"],
        ),
    ] = None,
    port: Annotated[int, optional("N", "Port to serve on.", "any free port")] = 0,
    host: Annotated[
        str, arg(metavar="ADDRESS", help="Address to serve on; 0.0.0.0 lets other machines connect.")
    ] = "127.0.0.1",
    pose: Annotated[str | None, optional("POSE", "First view, as in the page's address.", "found")] = None,
    up: Annotated[
        Literal["-y", "z", "y", "-z", "x", "-x"] | None,
        optional("AXIS", "Up axis: -y as in COLMAP, z as in Blender.", "found from the model"),
    ] = None,
    title: Annotated[str | None, optional("TEXT", "Title of the page.", "the file's name")] = None,
    allow_host: Annotated[
        str | None, optional("ORIGIN", "Host of models that addresses of the page may name.", "none")
    ] = None,
    embed_in: Annotated[
        str | None,
        optional("ORIGIN", "Site that may frame the page, and receives an event when a key opens.", "none"),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Show a published model in a browser, on a page where a key can be typed.

    Keys never leave the browser, and the page makes no requests to others than --allow-host.

    example: keyss view runs/hidden/publish/model.ply

    example: keyss view runs/hidden/publish/model.ply -o page.html
    """
    check_exists(model)
    from keyss.cli.tables import print_written

    if pose and not re.fullmatch(_POSE, pose):
        raise UsageError(f"--pose: expected eye=X,Y,Z&target=X,Y,Z as in the page's address, got {pose}")
    given = {"pose": pose, "up": up, "title": title, "host": allow_host, "embedder": embed_in}
    changed = {name: value for name, value in given.items() if value}
    if out is not None:
        if port or host != "127.0.0.1":
            raise UsageError("--port and --host are for serving: leave them out with -o")
        with waiting_for("export", "exporting", model):
            from keyss.viewer import export_html

            written = export_html(model, out, look=_look(model, changed), overwrite=overwrite)
        size = sum(path.stat().st_size for path in written) / 1e6
        what = "opens in any browser" if len(written) == 1 else f"{len(written)} files for a web server"
        print_written(out, f"{size:.1f} MB; {what}")
        return
    if overwrite or allow_host or embed_in:
        raise UsageError("--overwrite, --allow-host and --embed-in are for -o: leave them out")
    if not 0 <= port < 1 << 16:
        raise UsageError(f"--port: expected 0 to {(1 << 16) - 1}, got {port}")
    with waiting_for("export", "reading", model):
        from keyss.viewer import ModelServer

        server = ModelServer(model, host, port, _look(model, changed))
    who = "only on this machine" if server.is_local else f"to all who can reach {host} and know this address"
    print(f"{server.address} shows {model} {who}; press Ctrl-C to stop", flush=True)
    server.run()


def _look(model: Path, changed: dict[str, str]) -> dict[str, str]:
    """The look of a model's page with the values that are given."""
    from keyss.viewer import look_of_model

    look = look_of_model(model)
    if "up" in changed:
        look.pop("pose", None)
    return look | changed


def render(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="Model (.ply, .spz, ...), or - for stdin.")],
    *,
    cameras: Annotated[
        Path | None, optional("SCENE", "Scene whose cameras are used.", "60 around the model")
    ] = None,
    out: Annotated[
        Path,
        arg(metavar="OUT", help="Folder for the images, or an animation that ends in .webp.", aliases=["-o"]),
    ],
    split: Annotated[Literal["test", "train", "all"], arg(help="Which cameras of the scene.")] = "test",
    photos: OmitArgPrefixes[Photos] = PHOTOS,
    overwrite: Overwrite = False,
    device: Device = "auto",
) -> None:
    """Render a model to images, from all around or from the cameras of a scene.

    example: keyss render model.ply -o turn.webp

    example: keyss render secret.ply --cameras SCENE_B -o images/
    """
    check_exists(model, cameras)
    import keyss
    from keyss.cli.tables import print_written

    with waiting_for("render", "rendering", model):
        images = keyss.render(
            model, cameras, split=split, views=photos.views(), device=device, out=out, overwrite=overwrite
        )
    listed = "; private/ lists them for --overwrite" if out.is_dir() else ""
    print_written(out, f"{len(images)} image{'' if len(images) == 1 else 's'}{listed}")


def info(
    path: Annotated[
        Positional[Path],
        arg(metavar="FILE", help="Model (- for stdin), scene folder or result folder."),
    ],
    *,
    capacity: Annotated[
        bool, switch("Also what each format and channel can hide: bytes, and about how many Gaussians.")
    ] = False,
    json_: Annotated[bool, switch("Print JSON.", name="json")] = False,
) -> None:
    """Describe a model, a scene or a run.

    example: keyss info cover.ply --capacity

    example: keyss info runs/hidden/publish/model.ply
    """
    from keyss.cli.tables import print_info, print_json
    from keyss.runs.describe import info as describe

    with waiting_for("info --capacity" if capacity else "info", "reading", path):
        described = describe(path, capacity=capacity)
    (print_json if json_ else print_info)(described)


def evaluate(
    run: Run,
    *,
    key_file: KeyFiles = (),
    wrong_keys: Annotated[
        int | None, optional("N", "Number of random wrong keys, for methods with a decoder.", "32")
    ] = None,
    device: Device = "auto",
) -> None:
    """Measure PSNR, SSIM and LPIPS of a run again, with the right keys and wrong ones.

    Test views are photos held out of training or, for a model, renders of it. Each measurement is compared
    with its upper bound, plain 3DGS of as many Gaussians and training steps (`keyss hide --bound` fits it),
    or with the plain model from which training started. Keys of the method keyss steer a decoder: wrong ones
    give renders too, which should show no more of the secret than the published model does.

    example: keyss evaluate runs/hidden --key-file key.txt
    """
    check_exists(run, keys=key_file)
    from keyss import progress
    from keyss.cli.tables import print_files, print_hiding

    measure = verb("evaluate")
    from keyss.fitting.image_metrics import HOW_TO_GET, MIN_SIZE

    metrics = measure(
        run, keys_of_run(run, key_file), wrong_keys=wrong_keys, device=device, reporter=progress.reporter()
    )
    if progress.level >= 0:
        print_hiding(metrics)
    if metrics.cover.lpips is None:
        progress.say(f"{HOW_TO_GET}; photos must have at least {MIN_SIZE} x {MIN_SIZE} pixels.")
    print_files(run, {"private/metrics.json": "the measurements"})

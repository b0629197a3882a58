"""The commands that make models, scenes and keys; `hide` has a module of its own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from keyss.cli.arguments import (
    PHOTOS,
    TRAINING,
    Device,
    KeyFilesToCheck,
    OutFolder,
    Overwrite,
    Photos,
    Preset,
    Resume,
    Training,
    check_exists,
    optional,
    switch,
    verb,
    waiting_for,
)
from keyss.cli.keys import given_keys, key_of_file
from keyss.core.errors import UsageError
from keyss.files.model_formats import known_suffixes

ENOUGH_BITS = 64  # of a random key, which Argon2id makes as slow to find as 2^80 plain hashes


def demo(
    *,
    out: OutFolder = Path("out/demo"),
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of all random numbers, the demo's key included.")] = 0,
) -> None:
    """Hide one synthetic scene in another and open it again, in about a minute.

    Compares both with plain 3DGS of equal numbers of Gaussians and training steps.

    example: keyss demo -o out/demo
    """
    from keyss import progress
    from keyss.cli.tables import print_files, print_hiding
    from keyss.demo import WRONG_KEYS, run_demo

    metrics = run_demo(out, seed=seed, device=device, overwrite=overwrite, reporter=progress.reporter())
    if progress.level >= 0:
        print_hiding(metrics)
    progress.say(f"Wrong keys refused: {len(WRONG_KEYS)}.")
    print_files(
        out,
        {
            "comparison.png": "everything in one picture: look here first",
            "index.html": "the published model in a browser: type the key there",
            "publish/model.ply": "the published model: opens in any 3DGS viewer",
            "secret.ply": "the secret that the key revealed from it",
            "web.spz": "both for the web: hidden to survive conversion, then converted",
            "key.txt": "the key of this demo, which is public",
            "scenes": "the photos",
            "private/metrics.json": "the measurements",
        },
    )


def fit(
    scene: Annotated[Positional[Path], arg(metavar="SCENE", help="Folder of posed photos.")],
    *,
    out: OutFolder,
    preset: Preset = "default",
    dry_run: Annotated[bool, switch("Print estimates of time, memory and disk.")] = False,
    resume: Resume = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
    photos: OmitArgPrefixes[Photos] = PHOTOS,
    training: OmitArgPrefixes[Training] = TRAINING,
) -> None:
    """Fit a plain 3DGS model to the photos of a scene.

    example: keyss fit SCENE -o runs/cover
    """
    check_exists(scene)
    from dataclasses import replace

    from keyss import progress
    from keyss.cli.tables import print_cost, print_files, print_fit

    run = verb("fit")
    from keyss.fitting.config import preset_for
    from keyss.rendering import resolve_device
    from keyss.runs.files import METRICS, as_scene
    from keyss.runs.json_records import read_record
    from keyss.runs.planning import cost_of_fit
    from keyss.runs.run_records import FitMetrics

    target = resolve_device(device)
    config = replace(preset_for(preset, target.type), **training.schedule())
    if dry_run:
        size = f"up to {config.max_gaussians:,} Gaussians of SH degree {config.sh_degree}"
        print_cost(cost_of_fit(as_scene(scene, photos.views()), config, target), [("model", size)])
        return
    run(
        scene,
        config=config,
        views=photos.views(),
        device=device,
        out=out,
        overwrite=overwrite,
        resume=resume,
        reporter=progress.reporter(),
    )
    if progress.level >= 0:
        print_fit(read_record(out / METRICS, FitMetrics))
    print_files(out, {"model.ply": "the model", "private": "measurements and configuration"})


def keygen(
    *,
    out: Annotated[
        Path | None,
        optional(
            "FILE",
            "New key file, readable only by you (on Windows: by all who can read its folder).",
            "the standard output",
            aliases=["-o"],
        ),
    ] = None,
    bits: Annotated[int, arg(metavar="N", help="Strength in bits; each character has 5.95.")] = 95,
    asset: Annotated[str | None, optional("NAME", "Derive the key of this name from a master key.")] = None,
    master_key_file: Annotated[Path | None, optional("FILE", "Key file with that master key.")] = None,
) -> None:
    """Make a random key, or derive a key from a master key and a name.

    example: keyss keygen -o key.txt

    example: keyss keygen --asset statue-7 --master-key-file master.txt -o statue-7.key
    """
    from keyss.cli.tables import print_written
    from keyss.keys import generate_key, length_for
    from keyss.keys.key_file import write_new_key

    if (asset is None) != (master_key_file is None):
        raise UsageError("--asset and --master-key-file need each other: give both or neither")
    if master_key_file is not None and asset is not None:
        if bits != 95:
            raise UsageError("--bits is for random keys: leave it out with --asset")
        from keyss.keys import MasterKey

        key = MasterKey(key_of_file(master_key_file)).key_of(asset)
        what = f"the key of {asset}"
    else:
        if bits < 1:
            raise UsageError(f"--bits: expected at least 1, got {bits}")
        key = generate_key(length_for(bits))
        if bits < ENOUGH_BITS:
            weak = (
                f"a key of {bits} bits is found by 2^{bits} guesses: at least {ENOUGH_BITS} are out of reach"
            )
            print(f"keyss: warning: {weak}", file=sys.stderr)
        what = f"a key of {len(key)} characters; keep a copy, as without it the secret is lost"
    if out is None:
        print(key)
        return
    write_new_key(out, key)
    print_written(out, what)


def convert(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="Model of any format, or - for stdin.")],
    *,
    out: Annotated[
        Path,
        arg(metavar="FILE", help=f"Model to write ({known_suffixes()}), or - for stdout.", aliases=["-o"]),
    ],
    key_file: KeyFilesToCheck = (),
    force: Annotated[bool, switch("Write the model even if a secret is lost.")] = False,
    dry_run: Annotated[bool, switch("Report the cost, and write nothing.")] = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
) -> None:
    """Convert a model to another format, and report the cost.

    The suffix of --out selects the format. All formats but .ply round values, which destroys what is hidden
    in low bits, and most reorder Gaussians. The cost is the PSNR between renders before and after.

    example: keyss convert cover.ply -o cover.spz

    example: keyss convert model.ply -o model.sog --key-file key.txt --dry-run
    """
    check_exists(model, keys=key_file)
    import keyss
    from keyss.cli.tables import print_conversion

    given = given_keys(key_file)
    with waiting_for("convert, checking a key" if given else "convert", "converting", model):
        conversion = keyss.convert(
            model,
            out,
            given,
            force=force,
            dry_run=dry_run,
            overwrite=overwrite,
            device=device,
        )
    print_conversion(out, conversion, dry_run=dry_run)

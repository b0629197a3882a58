"""The commands: what each takes, which function it calls, and what it prints.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import (
    Background,
    Device,
    Iterations,
    KeyFiles,
    MaxGaussians,
    OutFolder,
    Overwrite,
    Resume,
    Seed,
    UnusedDevice,
    UnusedSeed,
    Width,
    checked_seed,
    optional,
)
from keyss.cli.measuring import audit, report, steganalyze

if TYPE_CHECKING:
    from keyss.fitting.config import FitConfig


def keygen(
    *,
    length: Annotated[
        int | None, optional("N", "Number of characters, 5.95 bits each.", "16, or what --bits needs")
    ] = None,
    bits: Annotated[int | None, optional("N", "Strength in bits instead of a length.", "none")] = None,
    seed: Annotated[
        int | None, optional("N", "Refused: a key is drawn from the system's random source.", "none")
    ] = None,
    device: UnusedDevice = "auto",
) -> None:
    """Print a new random key.

    example: keyss keygen > key.txt
    """
    from keyss.core.errors import UsageError
    from keyss.keys import generate_key, length_for

    if length is not None and bits is not None:
        raise UsageError("give --length or --bits, not both")
    if bits is not None and bits < 1:
        raise UsageError(f"--bits: expected at least 1, got {bits}")
    if seed is not None:
        raise UsageError("keygen takes no --seed: a key that can be drawn again is no secret")
    if length is None:
        length = 16 if bits is None else length_for(bits)
    print(generate_key(length))


def fit(
    scene: Annotated[Positional[Path], arg(metavar="SCENE", help="Folder of posed photos.")],
    *,
    out: OutFolder,
    preset: Annotated[
        Literal["quick", "default", "paper"], arg(help="Size and length of the run.")
    ] = "default",
    iterations: Iterations = None,
    max_gaussians: MaxGaussians = None,
    width: Width = None,
    background: Background = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = None,
) -> None:
    """Fit a plain 3DGS model to the photos of a scene.

    example: keyss fit SCENE -o runs/cover
    """
    from keyss import api as verbs
    from keyss.cli.tables import print_files, print_fit
    from keyss.fitting.config import PRESETS
    from keyss.progress import reporter

    verbs.fit(
        scene,
        config=_schedule(PRESETS[preset], iterations, max_gaussians, seed),
        width=width,
        background=background,
        device=device,
        out=out,
        overwrite=overwrite,
        resume=resume,
        reporter=reporter(),
    )
    print_fit(_metrics(out))
    print_files(out, {"model.ply": "the model", "metrics.json": "its numbers", "config.json": "what ran"})


def hide(
    *,
    cover: Annotated[Path, arg(metavar="SCENE", help="Scene that everybody may see, or a .ply model.")],
    secret: Annotated[
        UseAppendAction[tuple[Path, ...]],
        arg(metavar="SCENE", help="Scene or .ply model to hide in it; at least one."),
    ],
    method: Annotated[
        Literal["learned", "carry"],
        arg(help="Train one model that shows both, or carry one model in the low bits of the other."),
    ] = "learned",
    key_file: KeyFiles = (),
    out: OutFolder,
    preset: Annotated[
        Literal["best", "quick", "paper", "released"],
        arg(help="Size and kind of the run; paper and released: the publication, for comparison."),
    ] = "best",
    iterations: Iterations = None,
    max_gaussians: MaxGaussians = None,
    width: Width = None,
    background: Background = None,
    mask: Annotated[
        str | None,
        optional(
            "op,ro,sc,xyz,sh",
            "Attributes that the decoder changes, some of these; more than op take a network.",
            "the preset's",
        ),
    ] = None,
    start: Annotated[
        Literal["warm", "points"] | None,
        optional("{warm,points}", "Start from plain models, or from sparse points.", "the preset's"),
    ] = None,
    cover_model: Annotated[
        Path | None, optional("FILE", "Plain 3DGS model of the cover.", "one is fitted")
    ] = None,
    secret_model: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("FILE", "Plain 3DGS model of a secret, once for each secret.", "they are fitted"),
    ] = (),
    sidecar: Annotated[
        bool, arg(help="Write what a key opens to decoder.sealed, not into the low bits of stego.ply.")
    ] = False,
    key_encoder: Annotated[
        Literal["argon2", "clip"], arg(help="What conditions the decoder; the seal is always Argon2id's.")
    ] = "argon2",
    clip_model: Annotated[
        Path | None, optional("FOLDER", "CLIP for --key-encoder clip.", "ViT-L/14 in the cache")
    ] = None,
    thin: Annotated[bool, arg(help="Carry: leave out what is least visible of too large a secret.")] = False,
    dither: Annotated[
        bool, arg(help="Carry: give the cover new low bits where they are not random.")
    ] = False,
    resume: Resume = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = None,
) -> None:
    """Hide secret scenes in a cover scene, each under its own key.

    example: keyss hide --cover SCENE_A --secret SCENE_B --key-file key.txt -o runs/hidden
    example: keyss hide --cover cover.ply --secret secret.ply --key-file key.txt -o runs/hidden
    """
    from dataclasses import replace

    from keyss import api as verbs
    from keyss.cli.keys import keys, warn_of_weak_keys
    from keyss.cli.tables import print_carry, print_files, print_metrics
    from keyss.core.errors import UsageError
    from keyss.files.models import read_model
    from keyss.methods.learned.config import PRESETS
    from keyss.methods.learned.mask import parse_mask
    from keyss.methods.learned.sizing import room_for_models
    from keyss.progress import reporter
    from keyss.rendering.orbit import is_model

    if not secret:
        raise UsageError("nothing to hide: give --secret SCENE, once for each secret")
    if secret_model and len(secret_model) != len(secret):
        raise UsageError(
            f"expected no --secret-model or one for each of {len(secret)} secret(s), got {len(secret_model)}"
        )
    if method == "carry" and (mask is not None or start is not None):
        raise UsageError("--mask and --start are for the learned method: carrying trains no decoder")
    config = PRESETS[preset]
    config = config.adapted(None if mask is None else parse_mask(mask), start)
    if max_gaussians is None and all(map(is_model, (cover, *secret))):
        config = room_for_models(config, [read_model(path) for path in (cover, *secret)])
    config = replace(config, fit=_schedule(config.fit, iterations, max_gaussians, seed))
    if clip_model is not None and key_encoder != "clip":
        raise UsageError("--clip-model is for --key-encoder clip")
    encoder = None
    if key_encoder == "clip":
        from keyss.methods.learned.clip_keys import MODEL, ClipKeys

        encoder = ClipKeys(clip_model or MODEL)
    models = secret_model or (None,) * len(secret)
    chosen = keys(key_file, len(secret), confirm=True)
    warn_of_weak_keys(chosen)
    verbs.hide(
        cover,
        [verbs.Secret(scene, key, model) for scene, key, model in zip(secret, chosen, models, strict=True)],
        method=method,
        config=config,
        width=width,
        background=background,
        cover_model=cover_model,
        sidecar=sidecar,
        encoder=encoder,
        thin=thin,
        dither=dither,
        device=device,
        out=out,
        overwrite=overwrite,
        resume=resume,
        reporter=reporter(),
    )
    (print_carry if method == "carry" else print_metrics)(_metrics(out))
    print_files(
        out,
        {
            "stego.ply": "the cover with the secret in it: this is what to publish",
            "decoder.sealed": "what the keys open, encrypted: needed for revealing",
            "private": "plain models of all scenes: keep them to yourself",
            "metrics.json": "the numbers",
            "config.json": "what ran",
        },
    )


def reveal(
    stego: Annotated[Positional[Path], arg(metavar="FILE", help="The published .ply.")],
    *,
    key_file: Annotated[
        Path | None, optional("FILE", "File with the key.", "KEYSS_KEY, or a hidden prompt")
    ] = None,
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE", help="The .ply to write.")],
    decoder: Annotated[
        Path | None,
        optional("FILE", "A sidecar.", "decoder.sealed beside the .ply, else what is in the .ply"),
    ] = None,
    frame: Annotated[
        Literal["secret", "cover"], arg(help="Whose coordinates: the secret's own, or where it was hidden.")
    ] = "secret",
    decoy: Annotated[bool, arg(help="With a wrong key, write the cover instead of failing.")] = False,
    force: Annotated[
        bool, arg(help="For a .ply that was quantised: skip the check that the decoder belongs to it.")
    ] = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: UnusedSeed = 0,
) -> None:
    """Bring a secret back with its key.

    example: keyss reveal runs/hidden/stego.ply --key-file key.txt -o secret.ply
    """
    from keyss import api as verbs
    from keyss.cli.keys import keys

    (key,) = keys((key_file,) if key_file else (), 1)
    revealed = verbs.reveal(
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
    print(f"{out}: {len(revealed):,} Gaussians")


def render(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="A 3DGS .ply.")],
    *,
    cameras: Annotated[Path, arg(metavar="SCENE", help="Scene folder whose cameras are used.")],
    out: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER", help="Folder for the images.")],
    split: Annotated[Literal["test", "train", "all"], arg(help="Which of its cameras.")] = "test",
    width: Width = None,
    background: Background = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: UnusedSeed = 0,
) -> None:
    """Render a model from the cameras of a scene.

    example: keyss render secret.ply --cameras SCENE_B -o images/
    """
    from keyss import api as verbs

    images = verbs.render(
        model,
        cameras,
        split=split,
        width=width,
        background=background,
        device=device,
        out=out,
        overwrite=overwrite,
    )
    print(f"{out}: {len(images)} image{'' if len(images) == 1 else 's'}")


def evaluate(
    run: Annotated[Positional[Path], arg(metavar="RUN", help="Result folder of `keyss hide`.")],
    *,
    key_file: KeyFiles = (),
    wrong_keys: Annotated[int, arg(metavar="N", help="Number of random wrong keys to try.")] = 32,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of the wrong keys.")] = 0,
) -> None:
    """Measure a hiding run against the test photos, with the keys and with wrong ones.

    example: keyss evaluate runs/hidden --key-file key.txt
    """
    from keyss import api as verbs
    from keyss.cli.keys import keys
    from keyss.cli.tables import print_carry, print_files, print_metrics
    from keyss.progress import reporter

    metrics = verbs.evaluate(
        run,
        keys(key_file, len(key_file) or 1),
        wrong_keys=wrong_keys,
        seed=checked_seed(seed),
        device=device,
        reporter=reporter(),
    )
    (print_carry if metrics.get("method") == "carry" else print_metrics)(metrics)
    print_files(run, {"metrics.json": "the numbers"})


def info(
    path: Annotated[
        Positional[Path], arg(metavar="FILE", help="A .ply, a scene folder, a sidecar or a result folder.")
    ],
    *,
    json_: Annotated[bool, arg(name="json", help="Print JSON.")] = False,
    device: UnusedDevice = "auto",
    seed: UnusedSeed = 0,
) -> None:
    """Tell what is in a model, a scene folder or a sidecar.

    example: keyss info runs/hidden/stego.ply
    """
    from keyss.cli.tables import print_facts
    from keyss.runs.describe import info as describe

    facts = describe(path)
    if json_:
        print(json.dumps(facts, indent=2))
    else:
        print_facts(facts)


def demo(
    *,
    out: OutFolder = Path("out/demo"),
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of everything random, the demo's key included.")] = 0,
) -> None:
    """Hide one made-up scene in another and open it again: everything in under two minutes.

    example: keyss demo -o out/demo
    """
    from keyss.cli.tables import print_files, print_metrics
    from keyss.demo.run import WRONG_KEYS, run_demo
    from keyss.progress import reporter

    result = run_demo(out, seed=checked_seed(seed), device=device, overwrite=overwrite, reporter=reporter())
    print_metrics(result.metrics)
    print(f"Of {len(WRONG_KEYS)} wrong keys tried at the door, {result.refused} were refused.")
    print_files(
        out,
        {
            "comparison.png": "all of it in one picture: look here first",
            "stego.ply": "what would be published: opens in any 3DGS viewer",
            "secret.ply": "what the key brought back from it",
            "key.txt": "the key of this demo, known to everybody",
            "scenes": "the photos",
            "metrics.json": "the numbers",
        },
    )


ALL = (keygen, fit, hide, reveal, render, evaluate, audit, report, steganalyze, info, demo)


def _schedule(
    config: FitConfig, iterations: int | None, max_gaussians: int | None, seed: int | None
) -> FitConfig:
    """The preset with what was asked for on the command line."""
    from dataclasses import replace

    asked: dict[str, Any] = {
        "iterations": iterations,
        "max_gaussians": max_gaussians,
        "seed": None if seed is None else checked_seed(seed),
    }
    return replace(config, **{name: value for name, value in asked.items() if value is not None})


def _metrics(folder: Path) -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return metrics

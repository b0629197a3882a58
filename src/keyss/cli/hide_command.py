"""The command `hide`: scenes or files."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

from tyro.conf import OmitArgPrefixes, UseAppendAction, arg

from keyss.cli.arguments import (
    PHOTOS,
    PRESETS,
    TRAINING,
    Device,
    KeyFiles,
    OutFolder,
    Overwrite,
    Photos,
    PresetName,
    Resume,
    Training,
    check_exists,
    flag,
    optional,
    switch,
    verb,
)
from keyss.cli.keys import keys
from keyss.core.errors import InputError, UsageError

if TYPE_CHECKING:
    from keyss import HideResult, Secret, SecretFile
    from keyss.methods.method import CommandLineOption, MethodOptions

_FOR_FILES = (
    *("cover", "secret_file", "key_file", "publish", "format", "channel", "method"),
    *("out", "overwrite", "device", "dry_run"),
)
_FOR_TRAINING = ("preset", "iterations", "max_gaussians")
_HOW_TO_PUBLISH = {False: "publish this file unchanged", True: "publish this file; it may be converted"}


@dataclass(frozen=True, kw_only=True)
class HideArguments:
    """The options of `keyss hide`; `keyss.cli.hide_command` adds those of the method."""

    cover: Annotated[
        Path,
        arg(
            metavar="SCENE",
            help="What everybody will see: folder of posed photos, or model (.ply, .spz, ...). Loses secrets "
            "that it holds.",
        ),
    ]
    secret: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("SCENE", "Folder of photos or model to hide in it; repeat for more."),
    ] = ()
    secret_file: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("FILE", "Any other file to hide, if the cover is a model; repeat for more."),
    ] = ()
    key_file: KeyFiles = ()
    publish: Annotated[
        Literal["unchanged", "converted"] | None,
        optional(
            "{unchanged,converted}",
            "unchanged: a file that must stay as it is; the secret lies in low bits. converted: a .ply that "
            "may be converted later; inspection shows that it holds something.",
            "unchanged or, with a warning, converted if the cover has too little capacity",
        ),
    ] = None
    format: Annotated[
        Literal["ply", "spz", "sog", "compressed-ply"] | None,
        optional(
            "{ply,spz,sog,compressed-ply}",
            "Publish unchanged in this format; all but ply hold small secrets only.",
            "the cover's",
        ),
    ] = None
    channel: Annotated[
        Literal["appended", "colours"],
        arg(
            help="With --publish converted: appended Gaussians hold 6 MB, but are visible in the file; "
            "colours hold less and show less."
        ),
    ] = "appended"
    out: OutFolder
    method: str
    preset: Annotated[
        PresetName, arg(help=f"{PRESETS} Method carry: 2.15 times the steps for secrets of photos.")
    ] = "default"
    cover_model: Annotated[
        Path | None, optional("FILE", "Plain 3DGS model of a cover of photos.", "fitted")
    ] = None
    secret_model: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("FILE", "Plain 3DGS model of a secret of photos, one for each secret.", "fitted"),
    ] = ()
    min_psnr: Annotated[
        float | None,
        optional(
            "DB",
            "Fail if the PSNR of cover or secret to its plain model is below this, or, unless it is 0, no "
            "better than that of empty renders.",
            "20, and 25 for secrets that were pruned without fine-tuning",
        ),
    ] = None
    bound: Annotated[
        bool,
        switch("Also fit upper bounds, plain 3DGS with equal Gaussians and steps; takes twice as long."),
    ] = False
    dry_run: Annotated[bool, switch("Print the plan and estimates of time, memory and disk.")] = False
    resume: Resume = False
    overwrite: Overwrite = False
    device: Device = "auto"
    photos: OmitArgPrefixes[Photos] = PHOTOS
    training: OmitArgPrefixes[Training] = TRAINING
    own: Any  # options of the method alone


def hide(args: HideArguments) -> None:
    """Hide secrets in a cover, each under its own key.

    Each method has options of its own: see `keyss hide --method METHOD --help`.

    example: keyss hide --cover SCENE_A --secret SCENE_B --key-file key.txt -o runs/hidden

    example: keyss hide --cover cover.ply --secret secret.ply --key-file key.txt -o runs/hidden

    example: keyss hide --cover cover.ply --secret-file letter.pdf --key-file key.txt -o runs/letter
    """
    secrets = (*args.secret, *args.secret_file, *args.secret_model)
    check_exists(args.cover, args.cover_model, *secrets, keys=args.key_file)
    if args.secret_file:
        if args.secret:
            raise UsageError("--secret and --secret-file do not go together: hide scenes or files, not both")
    elif not args.secret:
        raise UsageError("no secret: give --secret SCENE or --secret-file FILE, one for each secret")
    given = _given(args)
    if args.secret_file and (unused := [name for name in given if name not in _FOR_FILES]):
        raise UsageError(f"--secret-file does not use {flag(unused[0])}: leave it out")
    run = verb("hide")
    from keyss import progress
    from keyss.rendering.orbit import is_model

    result = run(
        args.cover,
        _secrets(args),
        method=_method_options(args),
        views=args.photos.views(),
        cover_model=args.cover_model,
        bound=args.bound,
        min_psnr=args.min_psnr,
        device=args.device,
        out=args.out,
        overwrite=args.overwrite,
        resume=args.resume,
        dry_run=args.dry_run,
        reporter=progress.reporter(),
    )
    trained = any(result.cost.steps) if result.cost else result.metrics and result.metrics.iterations
    idle = " and ".join(flag(name) for name in _FOR_TRAINING if name in given)
    sources = args.cover_model or args.cover, *(args.secret_model or args.secret)
    if idle and not trained and all(map(is_model, sources)):
        progress.reporter().note(f"keyss: warning: {idle}: no effect, as nothing is trained")
    _print_result(args, result)


def _given(options: Any) -> list[str]:
    """Names of the options, also of those in groups, that differ from their defaults."""
    names = []
    for option in fields(options):
        value = getattr(options, option.name)
        if is_dataclass(value):
            names += _given(value)
        elif value != option.default:
            names.append(option.name)
    return names


def _print_result(args: HideArguments, result: HideResult) -> None:
    """Print measurements, files and what to do with them, or the plan of a dry run."""
    from keyss import progress
    from keyss.cli.tables import print_cost, print_files, print_hiding
    from keyss.methods import registry
    from keyss.runs.files import COMPANIONS, LOOK, STEGOS

    if (plan := result.plan) is not None and result.cost is not None:
        size = f"up to {plan.gaussians:,} Gaussians of SH degree {plan.sh_degree}, {plan.megabytes:,.1f} MB"
        rows = [("method", args.method), ("capacity", plan.room), ("published", size)]
        print_cost(result.cost, rows, plan.notes)
        return
    if result.psnr is not None:
        for file in args.secret_file:
            what = "which fit" if args.dry_run else "revealed again from the published file"
            progress.say(f"{file.name}: {file.stat().st_size:,} bytes, {what}")
        progress.say(f"PSNR between renders of the cover before and after: {result.psnr:.0f} dB")
        if args.dry_run:
            print("Dry run: nothing was written.")
            return
    if result.metrics is not None and progress.level >= 0:
        print_hiding(result.metrics, brief=progress.level < 1)
    method = registry.get(args.method)
    published = [args.out / name for name in STEGOS if (args.out / name).exists()]
    size = f", {sum(path.stat().st_size for path in published) / 1e6:,.1f} MB"
    files = dict.fromkeys(STEGOS, _HOW_TO_PUBLISH[result.survives] + size)
    private = "the list of files that --overwrite may replace"
    if result.metrics is not None:
        private = "measurements, configuration, fitted models if any"
        files |= {
            LOOK: "cover before and after, secret and revealed: look here first; it shows the secret",
            COMPANIONS: "hand this over to whoever may see the secret: `keyss reveal --companion`",
        }
    files["private"] = f"keep this private, or delete it: {private}"
    print_files(args.out, files)
    if not method.capabilities.keys:
        progress.say(f"The method {method.name} has no keys: whoever has both files can see the secret.")
    else:
        progress.say(
            "Send the key over another channel, and keep a copy: without it the secret is lost. Whoever has "
            "the file and the key runs `keyss reveal`"
            + (f"; `keyss info {args.out}` prints all measurements." if result.metrics else ".")
        )


def _secrets(args: HideArguments) -> list[Secret] | list[SecretFile]:
    """The secrets with their keys and models."""
    from keyss import Secret, SecretFile
    from keyss.files.file_kinds import identify_file
    from keyss.files.models import is_model_path
    from keyss.methods import registry

    if args.secret_file:
        given = keys(args.key_file, len(args.secret_file), new=True)
        return list(map(SecretFile, args.secret_file, given))
    count, models = len(args.secret), args.secret_model
    for path in args.secret:
        if path.is_file() and not is_model_path(path):
            kind = identify_file(path)
            raise InputError(
                f"{path}: expected a scene folder or a model, found {kind}; --secret-file hides any file"
            )
    if models and len(models) != count:
        raise UsageError(
            f"expected no --secret-model or one for each of {count} secret(s), got {len(models)}"
        )
    has_keys = registry.get(args.method).capabilities.keys or args.key_file
    given = keys(args.key_file, count, new=True) if has_keys else [""] * count
    return list(map(Secret, args.secret, given, models or (None,) * count))


def _method_options(args: HideArguments) -> MethodOptions:
    """The preset with the options of the command line."""
    from keyss.methods.registry import options_of
    from keyss.rendering import resolve_device

    known = own_options(args.method)
    changes = {
        name: parse(value) if (parse := known[name][1].parse) else value
        for name, value in vars(args.own).items()
        if value is not None and value is not False
    }
    changes |= {"publish": args.publish, "format": args.format, "channel": args.channel}
    preset = options_of(args.method).preset(args.preset, resolve_device(args.device).type)
    return replace(preset, **changes).with_fit(**args.training.schedule())


def with_options_of_method(arguments: Sequence[str]) -> Callable[..., None]:
    """`hide` with the options of the method in `arguments`, for the parser.

    Raises UsageError for an option that only another method has.
    """
    from keyss.methods import registry

    chooser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    chooser.add_argument("--method", nargs="?")
    asked = chooser.parse_known_args(arguments)[0].method
    name = asked if asked in registry.METHODS else registry.DEFAULT
    flags = {method: set(map(flag, own_options(method))) for method in registry.METHODS}
    for argument in arguments:
        given = argument.partition("=")[0].replace("_", "-")
        having = [method for method in flags if given in flags[method]]
        if having and name not in having:
            known = ", ".join(sorted(flags[name])) or "none"
            raise UsageError(
                f"{given} is an option of --method {' and '.join(having)}; --method {name} has: {known}"
            )
    summaries = "; ".join(f"{method}: {modules.summary}" for method, modules in registry.METHODS.items())
    methods: Any = Annotated[Literal[tuple(registry.METHODS)], arg(help=f"{summaries}.")]
    options = make_dataclass("Own", map(_own_field, own_options(name).items()), frozen=True, kw_only=True)
    options.__doc__ = f"Options that only the method {name} has."
    changed: list[tuple[str, Any, Any]] = [
        ("method", methods, field(default=name)),
        ("own", Annotated[options, arg(name=name), OmitArgPrefixes], field(default=options())),
    ]
    kind = make_dataclass("Arguments", changed, bases=(HideArguments,), frozen=True, kw_only=True)

    # tyro builds its parser from annotations, and these depend on --method: a copy of `hide` gets its own.
    command = FunctionType(hide.__code__, hide.__globals__, "hide")
    command.__annotations__ = {"args": Annotated[kind, arg(name="")], "return": None}
    command.__doc__ = hide.__doc__
    return command


def _own_field(named: tuple[str, tuple[Any, CommandLineOption]]) -> tuple[str, Any, Any]:
    name, (kind, option) = named
    if kind is bool:
        return name, Annotated[bool, switch(option.help)], field(default=False)
    choices = "{" + ",".join(get_args(kind)) + "}" if get_origin(kind) is Literal else None
    described = optional(option.metavar or choices or "TEXT", option.help, option.default or "none")
    return name, Annotated[(str if option.parse else kind) | None, described], field(default=None)


def own_options(method: str) -> dict[str, tuple[Any, CommandLineOption]]:
    """Types and descriptions of a method's options on the command line."""
    from keyss.methods.method import CommandLineOption
    from keyss.methods.registry import options_of

    options = options_of(method)
    hints = get_type_hints(options, include_extras=True)
    return {
        field.name: (
            get_args(hints[field.name])[0],
            replace(extra, default=extra.default or str(field.default)),
        )
        for field in fields(options)
        for extra in getattr(hints[field.name], "__metadata__", ())
        if isinstance(extra, CommandLineOption)
    }

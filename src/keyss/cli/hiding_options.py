"""The options of `keyss hide` that only the chosen method has."""

from __future__ import annotations

import inspect
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

from tyro.conf import arg

from keyss.cli.arguments import optional, preset_sizes

if TYPE_CHECKING:
    from keyss.methods.base import CommandLineOption, Method

DEFAULT_METHOD = "learned"


def hide_with_options(hide: Callable[..., None], arguments: Sequence[str]) -> Callable[..., None]:
    """`hide` as it is to be parsed: with the options of the method that `arguments` choose, and no others.

    Raises UsageError for an option that only another method has.
    """
    from keyss.core.errors import UsageError
    from keyss.methods.registry import METHODS

    chooser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    chooser.add_argument("--method", nargs="?")
    chooser.add_argument("--publish", nargs="?")
    asked = chooser.parse_known_args(arguments)[0]
    # Codes have room for small secrets, which are carried at once.
    usual = DEFAULT_METHOD if asked.publish in (None, "ply", "any") else "carry"
    method = METHODS[asked.method if asked.method in METHODS else usual]
    flags = {name: _flags(each) for name, each in METHODS.items()}
    for argument in arguments:
        flag = argument.partition("=")[0].replace("_", "-")
        having = [name for name in METHODS if flag in flags[name]]
        if having and method.name not in having:
            known = ", ".join(sorted(flags[method.name])) or "none"
            raise UsageError(
                f"{flag} is an option of --method {' and '.join(having)}; --method {method.name} has of its "
                f"own: {known}"
            )
    return _with_options_of(hide, method)


def _with_options_of(hide: Callable[..., None], method: Method) -> Callable[..., None]:
    """`hide` with a signature for tyro: what all methods take, then the options of this one."""
    from keyss.methods.registry import METHODS

    summaries = "; ".join(f"{each.name}: {each.summary}" for each in METHODS.values())
    # Types and defaults by name, for what `hide` leaves open.
    hints: dict[str, Any] = {
        "method": Annotated[Literal[tuple(METHODS)], arg(help=f"{summaries}.")],
        "preset": Annotated[Literal[tuple(method.presets)], arg(help=_preset_help(method))],
    }
    defaults: dict[str, Any] = {"method": method.name, "preset": next(iter(method.presets))}
    for name, (kind, option) in own_options(method).items():
        aliases = [f"--{option.alias}"] if option.alias else None
        if kind is bool:
            hints[name], defaults[name] = Annotated[bool, arg(help=option.help, aliases=aliases)], False
            continue
        choices = "{" + ",".join(get_args(kind)) + "}" if get_origin(kind) is Literal else None
        described = optional(option.metavar or choices or "TEXT", option.help, "the preset's", aliases)
        hints[name], defaults[name] = Annotated[(str if option.parse else kind) | None, described], None

    def command(**arguments: Any) -> None:
        hide(**arguments)

    signature = inspect.signature(hide, eval_str=True)
    parameters = {name: each for name, each in signature.parameters.items() if name != "own"}
    for name, hint in hints.items():
        parameters[name] = inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name], annotation=hint
        )
    command.__signature__ = signature.replace(parameters=list(parameters.values()))  # type: ignore[attr-defined]
    command.__name__, command.__doc__ = "hide", hide.__doc__
    command.__annotations__ = {name: each.annotation for name, each in parameters.items()}
    return command


def _preset_help(method: Method) -> str:
    """What the presets of a method come to."""
    sizes = preset_sizes({name: options.fit for name, options in method.presets.items()})
    return f"Size and kind of a run on photos; models bring their size along. {sizes}"


def own_options(method: Method) -> dict[str, tuple[Any, CommandLineOption]]:
    """Of the fields of a method's options that the command line has, types and descriptions."""
    from keyss.methods.base import CommandLineOption

    hints = get_type_hints(method.options, include_extras=True)
    return {
        each.name: (get_args(hints[each.name])[0], extra)
        for each in fields(method.options)
        for extra in getattr(hints[each.name], "__metadata__", ())
        if isinstance(extra, CommandLineOption)
    }


def _flags(method: Method) -> set[str]:
    """As they are typed: `--prune-to-fit`, `--thin`."""
    own = own_options(method)
    aliases = [option.alias for _, option in own.values() if option.alias]
    return {f"--{name.replace('_', '-')}" for name in (*own, *aliases)}

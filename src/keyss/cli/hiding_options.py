"""The options of `keyss hide` that depend on the method."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Iterable, Sequence
from dataclasses import field, fields, make_dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import OmitArgPrefixes, arg

from keyss.cli.arguments import check_there, flag, optional, switch
from keyss.cli.hiding import HideArguments, hide

if TYPE_CHECKING:
    from keyss.methods.base import CommandLineOption, Method


def with_options_of_method(arguments: Sequence[str]) -> Callable[..., None]:
    """`hide` as it is parsed: with the options of the method that `arguments` choose, and no others.

    Raises UsageError for an option that only another method has.
    """
    from keyss.core.errors import UsageError
    from keyss.methods import registry

    chooser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    chooser.add_argument("--method", nargs="?")
    asked = chooser.parse_known_args(arguments)[0].method
    name = asked if asked in registry.METHODS else registry.DEFAULT
    flags = {each: set(map(flag, modules.own)) for each, modules in registry.METHODS.items()}
    for argument in arguments:
        given = argument.partition("=")[0].replace("_", "-")
        having = [each for each in flags if given in flags[each]]
        if having and name not in having:
            known = ", ".join(sorted(flags[name])) or "none"
            raise UsageError(
                f"{given} is an option of --method {' and '.join(having)}; --method {name} has: {known}"
            )
    if arguments and not {"-h", "--help"} & set(arguments):
        _check_without_torch(name, arguments)
    method = registry.get(name)
    summaries = "; ".join(f"{each}: {registry.get(each).summary}" for each in registry.METHODS)
    return _parsed_as(_arguments_of(name, f"{summaries}.", map(_own_field, own_options(method).items())))


def _check_without_torch(name: str, arguments: Sequence[str]) -> None:
    """Refuse wrong options and missing files before torch is loaded, which takes longer than all else.

    Raises InputError, and SystemExit as argument parsers do.
    """
    from keyss.methods.registry import METHODS

    own = [
        (each, bool, field(default=False)) if kind is bool else (each, str | None, field(default=None))
        for each, kind in METHODS[name].own.items()
    ]
    config = (tyro.conf.FlagCreatePairsOff,)
    asked = tyro.cli(_arguments_of(name, "", own), prog="keyss hide", args=arguments, config=config)
    check_there(asked.cover, asked.details.cover_model, asked.batch.batch, asked.batch.master_key_file)
    check_there(*asked.secret, *asked.secret_file, *asked.key_file, *asked.details.secret_model)


def _parsed_as(kind: type[HideArguments]) -> Callable[..., None]:
    def command(asked: HideArguments) -> None:
        hide(asked)

    command.__annotations__ = {"asked": Annotated[kind, arg(name="")], "return": None}
    command.__name__, command.__doc__ = "hide", hide.__doc__
    return command


def _arguments_of(
    name: str, methods_help: str, own_fields: Iterable[tuple[str, Any, Any]]
) -> type[HideArguments]:
    """`HideArguments` with the methods, and the own options of the method `name` as a group."""
    from keyss.methods.registry import METHODS

    methods: Any = Annotated[Literal[tuple(METHODS)], arg(help=methods_help)]
    own = make_dataclass("Own", own_fields, frozen=True, kw_only=True)
    own.__doc__ = f"Options that only the method {name} has."
    changed: list[tuple[str, Any, Any]] = [
        ("method", methods, field(default=name)),
        ("own", Annotated[own, arg(name=name), OmitArgPrefixes], field(default=own())),
    ]
    return make_dataclass("Arguments", changed, bases=(HideArguments,), frozen=True, kw_only=True)


def _own_field(named: tuple[str, tuple[Any, CommandLineOption]]) -> tuple[str, Any, Any]:
    name, (kind, option) = named
    if kind is bool:
        return name, Annotated[bool, switch(option.help)], field(default=False)
    choices = "{" + ",".join(get_args(kind)) + "}" if get_origin(kind) is Literal else None
    described = optional(option.metavar or choices or "TEXT", option.help, option.default or "none")
    return name, Annotated[(str if option.parse else kind) | None, described], field(default=None)


def own_options(method: Method) -> dict[str, tuple[Any, CommandLineOption]]:
    """Types and descriptions of the fields of a method's options that the command line has."""
    from keyss.methods.base import CommandLineOption

    hints = get_type_hints(method.options, include_extras=True)
    return {
        each.name: (get_args(hints[each.name])[0], replace(extra, default=extra.default or str(each.default)))
        for each in fields(method.options)
        for extra in getattr(hints[each.name], "__metadata__", ())
        if isinstance(extra, CommandLineOption)
    }

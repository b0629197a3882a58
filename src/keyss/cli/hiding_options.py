"""The options of `keyss hide` that depend on the method."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import field, fields, make_dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

from tyro.conf import OmitArgPrefixes, arg

from keyss.cli.arguments import flag, optional, switch
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
    method = registry.get(asked if asked in registry.METHODS else registry.DEFAULT)
    flags = {name: _flags(registry.get(name)) for name in registry.METHODS}
    for argument in arguments:
        given = argument.partition("=")[0].replace("_", "-")
        having = [name for name in flags if given in flags[name]]
        if having and method.name not in having:
            known = ", ".join(sorted(flags[method.name])) or "none"
            raise UsageError(
                f"{given} is an option of --method {' and '.join(having)}; --method {method.name} has: "
                f"{known}"
            )
    return _parsed_as(_arguments_of(method))


def _parsed_as(kind: type[HideArguments]) -> Callable[..., None]:
    def command(asked: HideArguments) -> None:
        hide(asked)

    command.__annotations__ = {"asked": Annotated[kind, arg(name="")], "return": None}
    command.__name__, command.__doc__ = "hide", hide.__doc__
    return command


def _arguments_of(method: Method) -> type[HideArguments]:
    """`HideArguments` with the methods, and the method's own options as a group."""
    from keyss.methods import registry

    summaries = "; ".join(f"{name}: {registry.get(name).summary}" for name in registry.METHODS)
    methods: Any = Annotated[Literal[tuple(registry.METHODS)], arg(help=f"{summaries}.")]
    own = make_dataclass("Own", map(_own_field, own_options(method).items()), frozen=True, kw_only=True)
    own.__doc__ = f"Options that only the method {method.name} has."
    changed: list[tuple[str, Any, Any]] = [
        ("method", methods, field(default=method.name)),
        ("own", Annotated[own, arg(name=method.name), OmitArgPrefixes], field(default=own())),
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


def _flags(method: Method) -> set[str]:
    return set(map(flag, own_options(method)))

"""All methods, each entered with one line and loaded when it is needed."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from keyss.channels import Content, open_content, quick_attempt
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.methods import handed
from keyss.methods.decoy import Decoy
from keyss.methods.opened import FILE, HiddenFile, Opened, OpensAFileError

if TYPE_CHECKING:
    from keyss.methods.base import Method, MethodOptions


class Modules(NamedTuple):
    """The modules of a method."""

    hiding: str  # has METHOD, a `keyss.methods.base.Method`
    opening: str  # has `unpack`, from the content of a channel or a handed-over file to an `Opened`


_ROOM = "keyss.methods"
DEFAULT = "carry"
METHODS = {
    "carry": Modules(f"{_ROOM}.carry.method", f"{_ROOM}.records.opening"),
    "keyss": Modules(f"{_ROOM}.keyss.method", f"{_ROOM}.keyss.secret"),
    **{
        name: Modules(f"{_ROOM}.peers.{module}", f"{_ROOM}.peers.{module}")
        for name, module in {
            "3dgs": "bound",
            "3dgs-sh": "sh",
            "3dgs-decoder": "decoder",
            "gs-hider": "gs_hider",
            "watergs": "watergs",
        }.items()
    },
}


def get(name: str) -> Method:
    """The method of that name. Raises UsageError."""
    if name not in METHODS:
        raise UsageError(f"method {name!r}: expected {' or '.join(METHODS)}")
    method: Method = import_module(METHODS[name].hiding).METHOD
    return method


def of_options(options: MethodOptions) -> Method:
    """The method with options of this class. Raises UsageError."""
    name = getattr(options, "method", None)
    if name not in METHODS or type(options) is not get(name).options:
        raise UsageError(f"expected options of a method ({', '.join(METHODS)}), got {type(options).__name__}")
    return get(name)


def open_model(stego: Gaussians, key: str, *, decoy: bool = False) -> Opened:
    """The secret that `key` opens in a model (see `keyss.channels.opening`).

    With `decoy`, a key that opens nothing gets a `Decoy`, and only one salt is tried: with more, a wrong key
    would take longer than a right one. Otherwise raises WrongKeyError. Raises InputError for damage.
    """
    if not decoy:
        return _unpacked(open_content(stego, key))
    attempt = quick_attempt(stego, key)
    if attempt is None:
        raise WrongKeyError()
    if attempt.content is None:
        return Decoy.of(stego, attempt.key, appended=attempt.appended)
    return _unpacked(attempt.content)


def open_handed(data: bytes, key: str | None) -> Opened:
    """The secret in a file that was handed over (see `keyss.methods.handed`).

    Raises WrongKeyError, InputError, and UsageError for a key missing or unneeded.
    """
    return _unpacked(handed.unpack(data, key))


def _unpacked(content: Content) -> Opened:
    name = content.method
    if name == FILE:
        raise OpensAFileError(HiddenFile.of(content))
    if name not in METHODS:
        raise InputError(
            f"the secret was hidden by the method {name!r}; this program has {', '.join(METHODS)}"
        )
    unpack: Callable[[Content], Opened] = import_module(METHODS[name].opening).unpack
    return unpack(content)

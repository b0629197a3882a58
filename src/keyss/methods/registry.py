"""The methods there are, each entered with one line and loaded when it is needed."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from keyss.channels import Content, open_content, quick_attempt
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.methods import handed, hidden_file
from keyss.methods.decoy import Decoy
from keyss.methods.hidden_file import HiddenFile, OpensAFileError
from keyss.methods.opened import Opened

if TYPE_CHECKING:
    from keyss.methods.base import Method, MethodOptions


class Modules(NamedTuple):
    """Where a method is."""

    hiding: str  # has METHOD, a `keyss.methods.base.Method`
    opening: str  # has `unpack`: from what a channel gave, or what was handed over, to an `Opened`


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
    """The method whose options these are. Raises UsageError."""
    name = getattr(options, "method", None)
    if name not in METHODS or type(options) is not get(name).options:
        raise UsageError(f"expected options of a method ({', '.join(METHODS)}), got {type(options).__name__}")
    return get(name)


def open_model(stego: Gaussians, key: str, *, decoy: bool = False) -> Opened:
    """What `key` opens in a model (see `keyss.channels.opening`).

    With `decoy`, a key that opens nothing gets a `Decoy`, and only one salt is tried: others would take a
    wrong key longer than a right one. Otherwise raises WrongKeyError. Raises InputError for what is damaged.
    """
    if not decoy:
        return _unpacked(open_content(stego, key))
    found = quick_attempt(stego, key)
    if found is None:
        raise WrongKeyError()
    if found.content is None:
        return Decoy.of(stego, found.key, appended=found.appended)
    return _unpacked(found.content)


def open_handed(data: bytes, key: str | None) -> Opened:
    """The secret in a file that was handed over (see `keyss.methods.handed`).

    Raises UsageError for a key where none is needed or the other way round, WrongKeyError, InputError.
    """
    return _unpacked(handed.unpack(data, key))


def _unpacked(content: Content) -> Opened:
    name = content.method
    if name == hidden_file.NAME:
        raise OpensAFileError(HiddenFile.of(content))
    if name not in METHODS:
        raise InputError(
            f"the secret was hidden by the method {name!r}; this program has {', '.join(METHODS)}"
        )
    unpack: Callable[[Content], Opened] = import_module(METHODS[name].opening).unpack
    return unpack(content)

"""All methods, each entered once and loaded when it is needed, as is torch."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from keyss.core.errors import InputError, UsageError, WrongKeyError

if TYPE_CHECKING:
    from keyss.channels import Content
    from keyss.core.gaussians import Gaussians
    from keyss.methods.base import Method, MethodOptions
    from keyss.methods.opened import Opened


class Modules(NamedTuple):
    """The modules of a method."""

    hiding: str  # has METHOD, a `keyss.methods.base.Method`
    opening: str  # has `unpack`, from the content of a channel or a handed-over file to an `Opened`
    own: dict[str, type]  # options that only it has on the command line, which are bool or take a value


_ROOM = "keyss.methods"
DEFAULT = "carry"
METHODS = {
    "carry": Modules(
        f"{_ROOM}.carry.method",
        f"{_ROOM}.records.opening",
        {"refit": str, "prune_to_fit": bool, "dither": bool, "sh_degree": str},
    ),
    "keyss": Modules(
        f"{_ROOM}.keyss.method",
        f"{_ROOM}.keyss.secret",
        {"design": str, "mask": str, "key_encoder": str, "clip_model": str},
    ),
    **{
        name: Modules(f"keyss.lab.peers.{module}", f"keyss.lab.peers.{module}", {"common_poses": str})
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
    """The secret that `key` opens in a model (see `keyss.channels.publishing`).

    With `decoy`, only one salt is tried, because otherwise a wrong key would take longer than a right one. A
    key that opens nothing then gives a `Decoy`, else raises WrongKeyError. Raises InputError for damage.
    """
    from keyss.channels import open_content, quick_attempt
    from keyss.methods.decoy import Decoy

    if not decoy:
        return _unpacked(open_content(stego, key))
    attempt = quick_attempt(stego, key)
    if attempt is None:
        raise WrongKeyError()
    if attempt.content is None:
        return Decoy.of(stego, attempt.key, appended=attempt.appended, records=attempt.records)
    return _unpacked(attempt.content)


def open_handed(data: bytes, key: str | None) -> Opened:
    """The secret in a file that was handed over (see `keyss.methods.handed`).

    Raises WrongKeyError, InputError, and UsageError for a key missing or unneeded.
    """
    from keyss.methods import handed

    return _unpacked(handed.unpack(data, key))


def _unpacked(content: Content) -> Opened:
    from keyss.methods.opened import FILE, HiddenFile, OpensAFileError

    name = content.method
    if name == FILE:
        raise OpensAFileError(HiddenFile.of(content))
    if name not in METHODS:
        raise InputError(
            f"the secret was hidden by the method {name!r}; this program has {', '.join(METHODS)}"
        )
    unpack: Callable[[Content], Opened] = import_module(METHODS[name].opening).unpack
    return unpack(content)

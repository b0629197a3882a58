"""The methods there are, each entered with one line."""

from __future__ import annotations

from keyss.channels.appended import AppendedReader
from keyss.channels.base import Content
from keyss.channels.opening import open_content, quick_attempts
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.methods import handed, hidden_file
from keyss.methods.base import Method, MethodOptions, Opened
from keyss.methods.carry.method import CarryMethod
from keyss.methods.carry.options import CarryOptions as CarryOptions
from keyss.methods.decoy import Decoy
from keyss.methods.hidden_file import HiddenFile
from keyss.methods.learned.method import LearnedMethod
from keyss.methods.learned.options import LearnedOptions as LearnedOptions
from keyss.methods.peers import PEERS

METHODS: dict[str, Method] = {method.name: method for method in (LearnedMethod(), CarryMethod(), *PEERS)}


def get(name: str) -> Method:
    """The method of that name. Raises UsageError."""
    if name not in METHODS:
        raise UsageError(f"method {name!r}: expected {' or '.join(METHODS)}")
    return METHODS[name]


def of_options(options: MethodOptions) -> Method:
    """The method whose options these are. Raises UsageError."""
    for method in METHODS.values():
        if type(options) is method.options:
            return method
    known = ", ".join(method.options.__name__ for method in METHODS.values())
    raise UsageError(f"expected options of a method ({known}), got {type(options).__name__}")


def open_model(stego: Gaussians, key: str, *, decoy: bool = False) -> Opened:
    """What `key` opens in a model (see `keyss.channels.opening`).

    With `decoy`, a key that opens nothing gets a `Decoy`, and only one salt is tried: others would take a
    wrong key longer than a right one. Otherwise raises WrongKeyError. Raises InputError for what is damaged.
    """
    if not decoy:
        return _unpacked(open_content(stego, key))
    for derived, reader in quick_attempts(stego, key):
        try:
            return _unpacked(reader.extract(derived))
        except WrongKeyError:
            return Decoy.of(stego, derived, appended=isinstance(reader, AppendedReader))
    raise WrongKeyError("this key opens nothing here")


def open_handed(data: bytes, key: str | None) -> Opened:
    """The secret in a file that was handed over (see `keyss.methods.handed`).

    Raises UsageError for a key where none is needed or the other way round, WrongKeyError, InputError.
    """
    return _unpacked(handed.unpack(data, key))


def _unpacked(content: Content) -> Opened:
    if content.method == hidden_file.NAME:
        size = len(HiddenFile.of(content).data)
        raise InputError(
            f"this key opens a file of {size:,} bytes, not a scene: take a name for it that does not end as "
            "that of a model (keyss.api.reveal_file)"
        )
    if content.method not in METHODS:
        raise InputError(
            f"the secret was hidden by the method {content.method!r}; this program has {', '.join(METHODS)}"
        )
    return METHODS[content.method].unpack(content)

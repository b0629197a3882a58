"""The methods there are, each entered with one line."""

from __future__ import annotations

from keyss.channels.base import Payload
from keyss.channels.sidecar import open_slots, read_header
from keyss.core.errors import UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey
from keyss.methods.base import Method, MethodOptions, Opened
from keyss.methods.carry.method import CarryMethod
from keyss.methods.decoy import Decoy
from keyss.methods.interim_extraction import extract, key_for
from keyss.methods.learned.method import LearnedMethod

METHODS: dict[str, Method] = {method.name: method for method in (LearnedMethod(), CarryMethod())}


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


def open_model(stego: Gaussians, key: str, *, sidecar: bytes | None = None, decoy: bool = False) -> Opened:
    """What `key` opens in the low bits of `stego`, or in the bytes of a `sidecar`.

    With `decoy`, a key that opens nothing gets a `Decoy`. A right key then takes as long as a wrong one: both
    derive what a decoy needs, and only one salt is tried. Otherwise raises WrongKeyError. Raises InputError
    for what is damaged.
    """
    seed = key_for(stego, key) if decoy else None
    try:
        if sidecar is not None:
            content = Payload("learned", open_slots(sidecar, DerivedKey(key, read_header(sidecar)[0])))
            return get(content.method).unpack(content)
        found = extract(stego, key, salts=1) if decoy else extract(stego, key)
        return get(found.method).unpack(found)
    except WrongKeyError:
        if seed is None:
            raise
        return Decoy.of(stego, seed)

"""Whatever a key opens in the low bits of a model: a carried one, or the payload of the learned method."""

from __future__ import annotations

from keyss.carry.carrying import SALTS_TRIED, Carried, Carriers, extract_derived
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.seal import container
from keyss.seal.keys import DerivedKey


def open_model(stego: Gaussians, key: str) -> Carried | bytes:
    """A carried secret, or a payload for `unpack_secret`.

    One key derivation serves both. Only if that opens nothing, a second salt is tried, so that a single
    changed or added Gaussian cannot lock out the key. Raises WrongKeyError when nothing opens, InputError
    when what is there is damaged.
    """
    carriers = Carriers.of(stego)
    names = [row.tobytes() for row in carriers.names]
    for identity in carriers.salts()[:SALTS_TRIED]:
        derived = DerivedKey(key, container.derivation_of(identity))
        try:
            return extract_derived(carriers, derived)
        except WrongKeyError:
            pass
        try:
            return container.extract_derived(stego, derived, names)
        except WrongKeyError:
            pass
    raise WrongKeyError("this key opens nothing here")

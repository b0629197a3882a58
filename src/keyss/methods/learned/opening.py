"""Whatever a key opens in the low bits of a model: a carried one, or a secret of the learned method."""

from __future__ import annotations

from contextlib import suppress

from keyss.channels.low_bits import container
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey
from keyss.methods.carry.carrying import SALTS_TRIED, Carried, Carriers
from keyss.methods.carry.carrying import extract_derived as extract_carried
from keyss.methods.learned.payload import HiddenSecret, unpack_secret
from keyss.methods.learned.revealing import decoy_secret


def open_model(stego: Gaussians, key: str, *, decoy: bool = False) -> Carried | HiddenSecret:
    """What `key` opens in `stego`.

    One key derivation serves both methods, and both are always tried. If nothing opens, other salts are
    tried, SALTS_TRIED in all, so that changed or added Gaussians rarely lock out the key; with `decoy` there
    is one only, for others would take a wrong key longer than a right one, and a wrong key gets a
    `decoy_secret`. Otherwise raises WrongKeyError when nothing opens. Raises InputError when what is there
    is damaged.
    """
    carriers = Carriers.of(stego)
    names = [row.tobytes() for row in carriers.names]
    keys = (
        DerivedKey(key, container.derivation_of(identity))
        for identity in carriers.salts()[: 1 if decoy else SALTS_TRIED]
    )
    for derived in keys:
        carried, payload = None, None
        with suppress(WrongKeyError):
            carried = extract_carried(carriers, derived)
        with suppress(WrongKeyError):
            payload = container.extract_derived(stego, derived, names)
        if carried is not None:
            return carried
        if payload is not None:
            return unpack_secret(payload)
        if decoy:
            return decoy_secret(stego, derived)
    raise WrongKeyError("this key opens nothing here")

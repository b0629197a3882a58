"""What comes of models that are to be embedded whole, before anything is encoded."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels.appended import appended_for
from keyss.channels.rooms import room_in
from keyss.methods.base import MethodOptions, Outlook, SceneInput
from keyss.methods.records.precision import least_bytes

# Of a Gaussian that is not there yet: room in codes or colours, and what one of a secret takes.
_BITS_IN_COLOURS, _BITS_IN_CODES, _BITS_OF_SECRETS = 1, 18, 130


def outlook_whole(inputs: Sequence[SceneInput], options: MethodOptions) -> Outlook:
    """The room in the cover; how many Gaussians of the secrets fit is a guess until they are encoded."""
    fit, (cover, *secrets) = options.fit, inputs
    count, *sizes = (fit.max_gaussians if each.model is None else len(each.model) for each in inputs)
    degree = fit.sh_degree if cover.model is None else cover.model.sh_degree
    needed = [
        size * _BITS_OF_SECRETS // 8 if each.model is None else least_bytes(each.model)
        for size, each in zip(sizes, secrets, strict=True)
    ]
    asked = sum(sizes)
    if options.publish == "any" and options.channel == "appended":
        more = sum(map(appended_for, needed))
        note = f"about {more:,} Gaussians that nobody sees are appended to the cover's {count:,}"
        return Outlook(count + more, degree, asked, asked, notes=(note,))
    if cover.model is None:
        bits = _BITS_IN_COLOURS if options.publish == "any" else _BITS_IN_CODES
        room, how = count * bits // 8, "about"
    else:
        exactly = room_in(cover.model, options.publish, options.channel, repair=options.repair)
        room, how = exactly.capacity, "exactly"
    where = "colours" if options.publish == "any" else f"codes of the {options.publish} file"
    note = f"the {where} have room for {how} {room:,} bytes"
    return Outlook(count, degree, asked, min(asked, room * asked // sum(needed)), notes=(note,))

"""What comes of models that are to be embedded whole, before anything is encoded."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels.appended import appended_for
from keyss.channels.rooms import room_in
from keyss.methods.base import MethodOptions, Outlook, SceneInput
from keyss.methods.records.table import Table

_BITS_OF_COVERS = {"any": 1}  # that a Gaussian has room for in codes or colours, where it is not known yet
_BITS_IN_CODES = 18
_PACKED = 0.82  # bits of a record that are left when it is packed


def outlook_whole(inputs: Sequence[SceneInput], options: MethodOptions) -> Outlook:
    """The room in the cover; how many Gaussians of the secrets fit is a guess until they are encoded."""
    fit, (cover, *secrets) = options.fit, inputs
    count, *sizes = (fit.max_gaussians if each.model is None else len(each.model) for each in inputs)
    degree = fit.sh_degree if cover.model is None else cover.model.sh_degree
    bits = [
        size * _PACKED * Table.short(fit.sh_degree if each.model is None else each.model.sh_degree)[1].total
        for size, each in zip(sizes, secrets, strict=True)
    ]
    asked = sum(sizes)
    if options.publish == "any" and options.channel == "appended":
        more = sum(appended_for(int(each / 8)) for each in bits)
        note = f"about {more:,} Gaussians that nobody sees are appended to the cover's {count:,}"
        return Outlook(count + more, degree, asked, asked, notes=(note,))
    if cover.model is None:
        room, how = count * _BITS_OF_COVERS.get(options.publish, _BITS_IN_CODES) // 8, "about"
    else:
        room, how = room_in(cover.model, options.publish, options.channel).capacity, "exactly"
    where = "colours" if options.publish == "any" else f"codes of the {options.publish} file"
    note = f"the {where} have room for {how} {room:,} bytes"
    return Outlook(count, degree, asked, min(asked, int(8 * room * asked / sum(bits))), notes=(note,))

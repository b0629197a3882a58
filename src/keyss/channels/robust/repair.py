"""A short fit after writing: views are brought nearer to those of the cover again.

Names and what is written are constant colours, sizes and opacities, so that the coefficients of higher
degrees are free. They are trained on pictures of the cover. That takes noise out of views, and puts it into
harmonics, where it may tell, too: it is for payloads that show anyway.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.rendering.difference import Viewpoints, cost
from keyss.rendering.orbit import orbit
from keyss.rendering.view import render

STEPS = 150
_VIEWS, _SIZE = 24, 160  # that are looked at in turn, in pixels
_RATE, _LAST = 1e-3, 0.1  # learning rate of Adam, and what is left of it in the end


def check_repairable(cover: Gaussians) -> None:
    """Raises UsageError for a model without harmonics, in which nothing is free."""
    if cover.sh_degree == 0:
        raise UsageError("`repair` fits spherical harmonics, and this model has SH degree 0")


def repaired(cover: Gaussians, stego: Gaussians, steps: int = STEPS) -> Gaussians:
    """`stego`, N of N Gaussians as in `cover`, with harmonics of degree 1 and more for views like its.

    As it is where that does not help, in views from around that were not trained on. Raises UsageError for SH
    degree 0.
    """
    check_repairable(cover)
    viewpoints = Viewpoints(orbit(cover, _SIZE, _VIEWS), cover.means.new_zeros(3))
    with torch.no_grad():
        wanted = [render(cover, camera, viewpoints.background) for camera in viewpoints.cameras]
    constant, free = stego.sh[:, :1].detach(), stego.sh[:, 1:].detach().clone().requires_grad_(True)
    optimizer = torch.optim.Adam([free], lr=_RATE)
    for step in range(steps):
        which = step % _VIEWS
        optimizer.param_groups[0]["lr"] = _RATE * _LAST ** (step / steps)
        fitted = replace(stego, sh=torch.cat([constant, free], dim=1))
        picture = render(fitted, viewpoints.cameras[which], viewpoints.background)
        loss = (picture - wanted[which]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    result = replace(stego, sh=torch.cat([constant, free.detach()], dim=1))
    return result if cost(cover, result) > cost(cover, stego) else stego

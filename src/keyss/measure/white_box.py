"""What somebody finds who holds a decoder without its key: the search for an embedding by gradient.

In the published scheme the key is a vector that enters the decoder's first layers. Whoever has the network
can look for the vector under which it exchanges most, and needs no key, no cover and no idea of the secret.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.keys import random_embeddings


@torch.enable_grad()
def search_embeddings(
    decode: Callable[[Gaussians, Tensor], Gaussians],  # `keyss.methods.base.Opened.decode`
    stego: Gaussians,
    *,
    restarts: int = 8,
    steps: int = 150,
    most: int = 4000,
    balance: float = 2.0,
    seed: int = 0,
) -> Tensor:
    """[restarts, 64] unit vectors under which the decoder seems to show another scene, the best first.

    Gradient ascent from random starts on the mean change of the opacities, less `balance` times the change of
    their mean: what makes some visible and as much of others invisible is a scene in place of a scene, while
    what only adds or only removes is not. With 0 all change counts, which finds a secret that needs more
    Gaussians than the cover. Of larger models a random subset of `most` Gaussians is decoded: a decoder that
    divides opacities by their norm over the model sees larger ones then, which are small all the same. Where
    the decoded opacities have no gradient in the embedding, the random starts come back.
    """
    generator = torch.Generator().manual_seed(seed)
    part = stego.detach()
    if len(part) > most:
        part = part[torch.randperm(len(part), generator=generator)[:most].to(stego.device)]

    def exchanged(direction: Tensor) -> Tensor:
        change = decode(part, F.normalize(direction, dim=0)).opacities - part.opacities
        score: Tensor = change.abs().mean() - balance * change.mean().abs()
        return score

    starts = random_embeddings(restarts, generator)
    if not exchanged(starts[0].to(stego.device).requires_grad_()).requires_grad:
        return starts
    found = []
    for start in starts:
        direction = start.to(stego.device).requires_grad_()
        optimizer = torch.optim.Adam([direction], lr=0.02)
        for _ in range(steps):
            optimizer.zero_grad()
            (-exchanged(direction)).backward()
            optimizer.step()
        with torch.no_grad():
            found.append((float(exchanged(direction)), F.normalize(direction.detach(), dim=0).cpu()))
    found.sort(key=lambda pair: -pair[0])
    return torch.stack([embedding for _, embedding in found])

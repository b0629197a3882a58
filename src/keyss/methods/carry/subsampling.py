"""Which Gaussians would be missed least."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.gaussians import Gaussians


def most_visible(gaussians: Gaussians, count: int) -> Gaussians:
    """The `count` Gaussians of `most_visible_rows`; all of them if there are no more."""
    if count >= len(gaussians):
        return gaussians
    return gaussians[torch.from_numpy(most_visible_rows(gaussians, count))]


def most_visible_rows(gaussians: Gaussians, count: int) -> npt.NDArray[np.int64]:
    """[count] the Gaussians with the largest opacity times size, in their order.

    Size is the square root of the cross-section, and no more than that of a typical large Gaussian: else a
    few huge faint ones would stay before all detail.
    """
    size = gaussians.log_scales.sort(dim=1).values[:, 1:].mean(1)  # log, of the larger two axes
    at_most = size.sort().values[int(0.9 * len(size))]
    visibility = gaussians.opacities * size.clamp_max(at_most).exp()
    rows: npt.NDArray[np.int64] = visibility.topk(count).indices.sort().values.numpy()
    return rows

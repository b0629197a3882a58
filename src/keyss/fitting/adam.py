"""Adam with a learning rate for each number of a row, in one pass over memory on a CPU.

It updates all Gaussians, including those outside the view. Skipping these ("selective" Adam, Mallick et al.
2024, "Taming 3DGS") costs quality and saves no time here, because memory accesses are no longer contiguous.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

# The cached kernel would miss changes in other files: it uses only these, see `kernels.jit`.
from keyss.kernels import parallel
from keyss.kernels.jit import kernel
from keyss.rendering.cpu.simd8 import fetch_add, fused_multiply_add

EPS = 1e-15
NUMBERS_PER_JOB = 8192
_UNSCALED = torch.empty(0)


@kernel
def _adam(
    counter: Any,
    parameter: Any,
    gradient: Any,
    mean: Any,
    square: Any,
    rates: Any,
    scales: Any,
    constants: Any,
) -> None:
    """Adam's step, in place, on `parameter`, `mean` and `square`; these and `gradient` are flat: [N * W].

    With constants (mean_share, square_share, root, eps): mean += mean_share (gradient - mean), square +=
    square_share (gradient^2 - square), and parameter -= rates (mean / (root sqrt(square) + eps)), with
    `rates` [W] for the numbers of a row, times `scales` [N] for each row; an empty one means 1.
    """
    mean_share, square_share, root, eps = constants
    width = len(rates)
    size = max(1, NUMBERS_PER_JOB // width) * width
    steps = np.empty(size, np.float32)  # rates for a whole job: rows are too short to vectorise
    for i in range(size):
        steps[i] = rates[i % width]
    while True:
        first = fetch_add(counter, 0, 1) * size
        if first >= len(parameter):
            break
        if len(scales):
            for row in range(first // width, min(first + size, len(parameter)) // width):
                for i in range(width):
                    steps[row * width - first + i] = rates[i] * scales[row]
        p = parameter[first : first + size]
        g = gradient[first : first + size]
        m = mean[first : first + size]
        v = square[first : first + size]
        for i in range(len(p)):
            m[i] += mean_share * (g[i] - m[i])
            v[i] += square_share * (g[i] * g[i] - v[i])
            # Rounded once, as in CUDA's Adam. Rounding the step before the subtraction would leave trailing
            # zeros in numbers near zero, which would identify models trained by keyss.
            quotient = m[i] / (np.sqrt(v[i]) * root + eps)
            p[i] = fused_multiply_add(-steps[i], quotient, p[i])


def _unwrap(name: str) -> Any:
    """A method of torch's optimizers without the wrapper that disables `torch.compile`.

    The wrapper loads torch's compiler, which takes a second.
    """
    method = getattr(torch.optim.Optimizer, name)
    return getattr(method, "__wrapped__", method)


class RowAdam(torch.optim.Adam):
    """torch's Adam (Kingma and Ba 2015) of one parameter, with factors on its learning rate.

    `lr_scale` broadcasts to a row of the parameter ([16, 1] for [N, 16, 3]); `scale_rows` gives each row a
    factor. The state is torch's. On a CPU, results do not depend on the number of threads.
    """

    def __init__(self, parameter: Tensor, lr: float, lr_scale: Tensor | None = None) -> None:
        group = {"params": [parameter], "lr_scale": lr_scale}
        super().__init__([group], lr, eps=EPS, fused=parameter.device.type == "cuda")

    add_param_group = _unwrap("add_param_group")
    load_state_dict = _unwrap("load_state_dict")
    state_dict = _unwrap("state_dict")
    zero_grad = _unwrap("zero_grad")

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Take one step if there is a gradient; closures are not supported."""
        (group,) = self.param_groups
        (parameter,) = group["params"]
        if parameter.grad is None:
            return
        if parameter.device.type == "cpu" and parameter.dtype == torch.float32:
            self._step_on_cpu(parameter, group)
            return
        # Take torch's step at the full rate, then undo the excess.
        scale = self._scale(parameter, group)
        before = None if scale is None else parameter.clone()
        super().step()
        if scale is not None:
            parameter.lerp_(before, (1 - scale).expand_as(parameter))

    def scale_rows(self, scale: Tensor) -> None:
        """Multiply the learning rate of each row by `scale` [N], until the next call.

        The scale is part of the state: densification keeps it for remaining rows, and gives new rows 0.
        """
        group = self.param_groups[0]
        (parameter,) = group["params"]
        self._state_of(parameter, group)["row_scale"] = scale.to(parameter).contiguous()

    def _scale(self, parameter: Tensor, group: dict[str, Any]) -> Tensor | None:
        """The factor on the learning rate, broadcastable to the parameter; None: 1 everywhere."""
        scale: Tensor | None = group["lr_scale"]
        rows: Tensor | None = self.state[parameter].get("row_scale")
        if rows is None:
            return scale
        rows = rows.view(-1, *[1] * (parameter.dim() - 1))
        return rows if scale is None else rows * scale

    def _state_of(self, parameter: Tensor, group: dict[str, Any]) -> dict[str, Any]:
        """The state of a parameter, initialised as in torch before the first step."""
        state: dict[str, Any] = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0, device=parameter.device if group["fused"] else None)
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
        return state

    def _step_on_cpu(self, parameter: Tensor, group: dict[str, Any]) -> None:
        state = self._state_of(parameter, group)
        state["step"] += 1
        step = int(state["step"])
        beta1, beta2 = group["betas"]
        rates = torch.full(parameter.shape[1:], group["lr"] / (1 - beta1**step))
        if group["lr_scale"] is not None:
            rates *= group["lr_scale"]
        assert parameter.grad is not None
        tensors = (parameter, parameter.grad.contiguous(), state["exp_avg"], state["exp_avg_sq"], rates)
        flat = [tensor.view(-1).numpy() for tensor in (*tensors, state.get("row_scale", _UNSCALED))]
        constants = (1 - beta1, 1 - beta2, (1 - beta2**step) ** -0.5, group["eps"])
        parallel.run(_adam, *flat, tuple(map(np.float32, constants)))

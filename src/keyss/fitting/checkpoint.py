"""The complete state of a training run in one safetensors file: tensors and JSON, nothing executable."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from keyss.core.errors import InputError
from keyss.files.atomic import write_bytes

if TYPE_CHECKING:
    from keyss.fitting.parameters import Optimizers, Parameters

State = dict[str, Tensor]
_UNREADABLE = (OSError, KeyError, ValueError, TypeError, safetensors.SafetensorError)


def save_checkpoint(path: Path, tensors: State, meta: Mapping[str, Any]) -> None:
    """Atomically write `tensors` and the JSON-able `meta`; any device can load them. Raises OutputError."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(path, safetensors.torch.save(contiguous, {"meta": json.dumps(meta)}))


def load_checkpoint(path: Path) -> tuple[State, dict[str, Any]]:
    """Tensors (on the CPU) and meta of a checkpoint. Raises InputError when it is missing or damaged."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {})["meta"])
            return {name: file.get_tensor(name) for name in file.keys()}, meta  # noqa: SIM118
    except _UNREADABLE as error:
        raise InputError(f"{path}: not a checkpoint of this version ({error})") from error


def pack_model(parameters: Parameters, optimizers: Optimizers, density: Mapping[str, Any]) -> State:
    """Parameters, their Adam moments and the statistics of a strategy: `means`, `means.exp_avg`, ..."""
    state: State = {}
    for name, parameter in parameters.items():
        state[name] = parameter.detach()
        for key, value in optimizers[name].state[parameter].items():
            state[f"{name}.{key}"] = torch.as_tensor(value)
    return state | {f"density.{key}": value for key, value in density.items() if isinstance(value, Tensor)}


def unpack_model(
    state: State, parameters: Parameters, optimizers: Optimizers, density: dict[str, Any]
) -> None:
    """Restore the result of `pack_model`; the number of Gaussians may differ."""
    device = parameters["means"].device
    for name, old in list(parameters.items()):
        parameter = torch.nn.Parameter(state[name].to(device))
        optimizer = optimizers[name]
        optimizer.state.pop(old, None)
        optimizer.param_groups[0]["params"] = [parameter]
        moments = _with_prefix(state, f"{name}.")
        if moments:
            counts_on_cpu = not optimizer.param_groups[0]["fused"]
            optimizer.state[parameter] = {
                key: value if key == "step" and counts_on_cpu else value.to(device)
                for key, value in moments.items()
            }
        parameters[name] = parameter
    density |= {key: value.to(device) for key, value in _with_prefix(state, "density.").items()}


def pack_network(network: torch.nn.Module, optimizer: torch.optim.Optimizer) -> State:
    """Weights and Adam moments of networks with an optimizer of their own."""
    state: State = {f"networks.{name}": value for name, value in network.state_dict().items()}
    for index, moments in optimizer.state_dict()["state"].items():
        state |= {f"networks_adam.{index}.{name}": value for name, value in moments.items()}
    return state


def unpack_network(state: State, network: torch.nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """Restore the result of `pack_network`."""
    network.load_state_dict(_with_prefix(state, "networks."))
    adam = optimizer.state_dict()
    for name, value in _with_prefix(state, "networks_adam.").items():
        index, key = name.split(".")
        adam["state"].setdefault(int(index), {})[key] = value
    optimizer.load_state_dict(adam)


def _with_prefix(state: State, prefix: str) -> State:
    return {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}

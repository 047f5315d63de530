"""Weights of an exported network, to continue its training from the ONNX file.

Export folds each batch normalisation into the convolution before it. Here the two are parted again, so that the
network says the same as before and training can go on with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, numpy_helper
from torch import Tensor, nn

from tools.training.networks import first_layers_of

BOXES = "detector."
"""Prefix of the trained network's weights in `detector.Boxes`, which is exported."""
HALVED = "_16"
"""Ends the names of weights that are stored in 16 bits."""


def begin_with(net: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Copy the weights of layers with the same name; of a larger layer the part that was there."""
    own = net.state_dict()
    for name, value in weights.items():
        if name in own and own[name].dim() == value.dim():
            part = tuple(slice(0, min(a, b)) for a, b in zip(own[name].shape, value.shape, strict=True))
            own[name][part] = value[part]
    net.load_state_dict(own)


def begin_with_onnx(net: nn.Module, path: Path, run: Callable[[], object]) -> None:
    """Give ``net`` the weights of the ONNX file that ``tools.training.export`` made of one like it.

    ``run`` calls ``net`` on a batch of training samples: what the normalisations see of it becomes what they know.
    Raises ValueError where the file is of another network.
    """
    own = net.state_dict()
    norms = {name: module for name, module in net.named_modules() if isinstance(module, nn.BatchNorm2d)}
    weights = _weights(path, net)
    for name, value in weights.items():
        if name not in own and not (name.endswith(".bias") and _norm_after(name) in norms):
            raise ValueError(f"{path}: its {name} is not {type(net).__name__}'s")
        if name in own and own[name].shape != value.shape:
            raise ValueError(f"{path}: its {name} is {list(value.shape)}, not {list(own[name].shape)}")
        if name in own:
            own[name] = value
    net.load_state_dict(own)
    biases = {_norm_after(name): value for name, value in weights.items() if name not in own}
    if missing := norms.keys() - biases.keys():
        raise ValueError(f"{path}: nothing for {sorted(missing)[0]}; it is not {type(net).__name__}'s")
    _settle_norms(net, {norm: biases[name] for name, norm in norms.items()}, run)


def _settle_norms(net: nn.Module, biases: Mapping[nn.BatchNorm2d, Tensor], run: Callable[[], object]) -> None:
    """Each normalisation adds its bias and does nothing else to what it sees while ``run`` calls ``net``."""
    hooks = [norm.register_forward_pre_hook(_settled_to(bias)) for norm, bias in biases.items()]
    momenta = [norm.momentum for norm in biases]
    net.train()
    for norm in biases:
        norm.momentum = 0.0
    with torch.no_grad():
        run()
    for hook, norm, momentum in zip(hooks, biases, momenta, strict=True):
        hook.remove()
        norm.momentum = momentum


def _settled_to(bias: Tensor) -> Callable[[nn.BatchNorm2d, tuple[Tensor]], None]:
    """A hook that sets a normalisation so that it only adds ``bias`` to its input batch."""

    def settle(norm: nn.BatchNorm2d, inputs: tuple[Tensor]) -> None:
        x = inputs[0].float()
        mean, variance = x.mean((0, 2, 3)), x.var((0, 2, 3), unbiased=False)
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.copy_(torch.sqrt(variance + norm.eps))
        norm.bias.copy_(bias.to(mean) + mean)

    return settle


def _weights(path: Path, net: nn.Module) -> dict[str, Tensor]:
    """Every parameter of the file, under its name in torch; a folded normalisation is its convolution's bias."""
    graph = onnx.load(str(path)).graph
    values = {
        one.name.removesuffix(HALVED).removeprefix(BOXES): torch.tensor(numpy_helper.to_array(one).astype(np.float32))
        for one in graph.initializer
        if one.data_type in (TensorProto.FLOAT, TensorProto.FLOAT16)
    }
    named = {name: value for name, value in values.items() if not name.startswith("onnx::")}
    nameless: list[tuple[Tensor, Tensor]] = []
    for node in graph.node:
        folded = [values[name] for name in node.input[1:] if name.startswith("onnx::") and name in values]
        if node.op_type != "Conv" or not folded:
            continue
        if layer := _module(node.name):
            named |= {
                f"{layer.removeprefix(BOXES)}.{part}": value
                for part, value in zip(("weight", "bias"), folded, strict=True)
            }
        else:
            nameless.append((folded[0], folded[1]))
    try:
        return named | first_layers_of(net, nameless)
    except (ValueError, RuntimeError):
        raise ValueError(f"{path}: its first layers are not {type(net).__name__}'s") from None


def _module(node: str) -> str:
    """``/deep/deep.0/first/first.0/Conv`` -> ``deep.0.first.0``."""
    parts: list[str] = []
    for part in node.strip("/").split("/")[:-1]:
        if parts and part.startswith(parts[-1] + "."):
            parts.pop()
        parts.append(part)
    return ".".join(parts)


def _norm_after(bias: str) -> str:
    """The normalisation after a convolution: parts of a unit are numbered, those of the detector named."""
    layer = bias.removesuffix(".bias")
    return layer.removesuffix("conv") + "norm" if layer.endswith(".conv") else layer.removesuffix("0") + "1"

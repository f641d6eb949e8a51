"""What a training starts from when another one came before it: its checkpoint, or the ONNX file that it gave."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tubepose.errors import DetectorError, one_line

if TYPE_CHECKING:
    import torch

CHECKPOINT = "checkpoint.pt"
_MODEL_SUFFIX = ".onnx"
_STEM = "backbone.backbone.stem.0"
"""The layer that takes the image: RGB in training, BGR in the file."""


def load_start(network: torch.nn.Module, start: Path, classes: Sequence[str]) -> bool:
    """Give a network of `build_network` the weights of another training.

    In an ONNX file every normalisation is part of the convolution before it. The network is given those convolutions,
    and normalisations that only add the file's offsets: as it stands it computes what the file computes, but before it
    learns from batches, `match_statistics` has to fit its normalisations to what they meet.

    Args:
        network: The network; changed.
        start: A checkpoint, whose averaged weights are taken, or an .onnx file of `export_onnx`.
        classes: Class names that it is to learn.

    Returns:
        Whether its normalisations have to be fitted before it learns.

    Raises:
        DetectorError: The file is neither, or it is of another network or other classes.
    """
    is_model = start.suffix == _MODEL_SUFFIX
    if is_model:
        _load_model(network, start, classes)
    else:
        _load_checkpoint(network, start)
    return is_model


def match_statistics(network: torch.nn.Module, images: Iterable[torch.Tensor]) -> None:
    """Fit the normalisations that learn from batches to what they meet, so that the network computes the same.

    A normalisation gives ``scale * (x - mean) / sqrt(variance + eps) + offset``. Mean and variance become those of the
    images, scale and offset what keeps the function; then batches are normalised by about what the weights expect.

    Args:
        network: The network, in the mode it is trained in; afterwards it is in evaluation mode.
        images: Batches (B, 3, H, W) as it takes them.
    """
    import torch

    layers = [m for m in network.modules() if isinstance(m, torch.nn.BatchNorm2d) and m.training]
    met: dict[Any, list[Any]] = {layer: [0.0, 0.0, 0.0] for layer in layers}  # count, sum and sum of squares by channel

    def note(layer: Any, inputs: tuple[torch.Tensor]) -> None:
        x = inputs[0].detach().double()
        sums = (x.numel() / x.shape[1], x.sum(dim=(0, 2, 3)), x.square().sum(dim=(0, 2, 3)))
        met[layer] = [old + new for old, new in zip(met[layer], sums, strict=True)]

    hooks = [layer.register_forward_pre_hook(note) for layer in layers]
    network.eval()
    with torch.no_grad():
        for batch in images:
            network(batch)
        for hook in hooks:
            hook.remove()
        for layer, (count, total, squares) in met.items():
            mean = total / count
            _renormalise(layer, mean, (squares / count - mean.square()).clamp_min(0.0))


def _renormalise(layer: Any, mean: torch.Tensor, variance: torch.Tensor) -> None:
    """Other statistics for a normalisation, and the scale and offset that keep what it computes."""
    slope = layer.weight / (layer.running_var + layer.eps).sqrt()
    layer.bias.add_(slope * (mean - layer.running_mean))
    layer.weight.copy_(slope * (variance + layer.eps).sqrt())
    layer.running_mean.copy_(mean)
    layer.running_var.copy_(variance)


def _load_checkpoint(network: torch.nn.Module, start: Path) -> None:
    import torch

    try:
        if not zipfile.is_zipfile(start):
            raise ValueError("no file of PyTorch")
        state = torch.load(start, map_location="cpu", weights_only=True)["average"]
        network.load_state_dict(
            {name.removeprefix("module."): value for name, value in state.items() if name.startswith("module.")}
        )
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, pickle.UnpicklingError) as problem:
        what = one_line(str(problem))[:120]
        raise DetectorError(
            f"{start}: no checkpoint to start from ({what}); expected {CHECKPOINT} of a training with as many classes, "
            f"or a model that tubepose trained ({_MODEL_SUFFIX})"
        ) from None


def _load_model(network: torch.nn.Module, start: Path, classes: Sequence[str]) -> None:
    import torch

    weights = _read_model(start, classes)
    pairs = _convolutions(network)
    if {*pairs} != {*weights}:
        raise _other_network(start, f"{len({*pairs} & {*weights})} of {len(pairs)} layers are in it")
    with torch.no_grad():
        for name, (kernel, offset) in weights.items():
            layer, norm = pairs[name]
            if tuple(layer.weight.shape) != kernel.shape:
                raise _other_network(start, f"{name} has {kernel.shape}, not {tuple(layer.weight.shape)}")
            values = torch.from_numpy(kernel.copy())
            layer.weight.copy_(values.flip(1) if name == _STEM else values)
            shift = torch.from_numpy(offset.copy())
            if norm is None:
                layer.bias.copy_(shift)
                continue
            norm.running_mean.zero_()
            norm.running_var.fill_(1.0)
            norm.weight.fill_((1.0 + norm.eps) ** 0.5)
            norm.bias.copy_(shift)


def _read_model(start: Path, classes: Sequence[str]) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Kernels and offsets of a file's convolutions, by the name of the layer that each was."""
    import onnx
    from google.protobuf.message import DecodeError
    from onnx import numpy_helper

    try:
        model = onnx.load(str(start))
    except (OSError, DecodeError) as problem:
        raise _other_network(start, one_line(str(problem))[:120]) from None
    names = {prop.key: prop.value for prop in model.metadata_props}.get("names", "no names")
    if names != repr(dict(enumerate(classes))):
        raise DetectorError(
            f"{start}: a model of the classes {names}; to start from it the pictures have to have the same, "
            f"and theirs are {dict(enumerate(classes))!r}"
        )
    stored = {tensor.name: numpy_helper.to_array(tensor).astype(np.float32) for tensor in model.graph.initializer}
    # Weights of 16 bits are widened, and of equal ones only one is stored.
    same = {node.output[0]: node.input[0] for node in model.graph.node if node.op_type in ("Cast", "Identity")}

    def value(name: str) -> NDArray[np.float32] | None:
        while name not in stored and name in same:
            name = same[name]
        return stored.get(name)

    found = {}
    for node in model.graph.node:
        if node.op_type == "Conv" and len(node.input) == 3:
            kernel, offset = (value(name) for name in node.input[1:])
            if kernel is not None and offset is not None:
                found[_layer_name(node.name)] = (kernel, offset)
    return found


def _layer_name(node: str) -> str:
    """Layer of an exported node: ``/head/stems.0/conv/Conv`` is ``head.stems.0.conv``; a list repeats its name."""
    parts = node.strip("/").split("/")[:-1]
    kept = [part for part, below in zip(parts, [*parts[1:], ""], strict=True) if not below.startswith(f"{part}.")]
    return ".".join(kept)


def _convolutions(network: torch.nn.Module) -> dict[str, tuple[Any, Any]]:
    """Each convolution by its name, with the normalisation that comes next when the network runs; None without one."""
    import torch

    order: list[tuple[str, Any]] = []
    hooks = [
        module.register_forward_hook(lambda layer, _inputs, _output, name=name: order.append((name, layer)))
        for name, module in network.named_modules()
        if isinstance(module, torch.nn.Conv2d | torch.nn.BatchNorm2d)
    ]
    was_training = network.training
    with torch.no_grad():
        network.eval()(torch.zeros(1, 3, 64, 64))
    network.train(was_training)
    for hook in hooks:
        hook.remove()
    following = [layer for _, layer in order[1:]] + [None]
    return {
        name: (layer, below if isinstance(below, torch.nn.BatchNorm2d) else None)
        for (name, layer), below in zip(order, following, strict=True)
        if isinstance(layer, torch.nn.Conv2d)
    }


def _other_network(start: Path, found: str) -> DetectorError:
    return DetectorError(
        f"{start}: no model to start from ({found}); expected one that `tubepose detector train` wrote, of this version"
    )

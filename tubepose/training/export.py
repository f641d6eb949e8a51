"""A trained network as an ONNX file that says what it is."""

from __future__ import annotations

import copy
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tubepose import __version__
from tubepose.detection.closer_look import Looks
from tubepose.report import write_aside

if TYPE_CHECKING:
    import torch

LICENSE = "Apache-2.0"
_OPSET = 17
_SMALL = 256
"""Weights of fewer numbers than this keep 32 bits."""


def export_onnx(
    network: torch.nn.Module,
    path: Path,
    classes: Sequence[str],
    looks: Looks,
    recipe: Mapping[str, Any],
    *,
    sha256: str,
) -> None:
    """Write a network of `build_network` as ONNX: input of any size and output as YOLOX's, weights in 16 bits.

    The input is BGR from 0 to 255 with the border right and below, as YOLOX has it; values and arithmetic have 32
    bits, only the stored weights are halved.

    Args:
        network: The network; it is not changed.
        path: The .onnx file.
        classes: Class names in the order of their numbers.
        looks: How large it is to see whole pictures and racks.
        recipe: How it was trained, for its metadata.
        sha256: Fingerprint of that.
    """
    import onnx
    import torch

    net = copy.deepcopy(network).cpu().eval().to(memory_format=torch.contiguous_format)
    net.head.decode_in_inference = False  # boxes are decoded outside: the grid depends on the input's size
    stem: Any = net.backbone.backbone.stem[0]
    with torch.no_grad():
        stem.weight.copy_(stem.weight.flip(1).clone())
    with write_aside(path) as aside:
        with warnings.catch_warnings():
            # The exporter that traces is called legacy, but needs no further package and folds all constants.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                net,
                (torch.zeros(1, 3, looks.rack_px, looks.rack_px),),
                str(aside),
                input_names=["images"],
                output_names=["output"],
                dynamic_axes={"images": {2: "height", 3: "width"}, "output": {1: "rows"}},
                opset_version=_OPSET,
                dynamo=False,
            )
        model = onnx.load(str(aside))
        _halve_weights(model)
        described = {
            "task": "detect",
            "names": repr(dict(enumerate(classes))),
            "imgsz": repr([looks.rack_px, looks.rack_px]),
            "looks": repr([looks.whole_px, looks.rack_px]),
            "stride": "32",
            "layout": "yolox",
            "color_order": "BGR",
            "value_range": "0..255",
            "enhancement": "none",
            "training": json.dumps(recipe, sort_keys=True),
            "training_sha256": sha256,
            "license": LICENSE,
            "author": f"tubepose {__version__}",
        }
        onnx.helper.set_model_props(model, described)
        onnx.checker.check_model(model)
        onnx.save(model, str(aside))


def _halve_weights(model: Any) -> None:
    """Store large weights in 16 bits, with a node each that widens them again when the file is loaded."""
    import onnx
    from onnx import numpy_helper

    casts = []
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < _SMALL or np.abs(values).max() > np.finfo(np.float16).max:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}_16"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}_16"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)

"""Opening a YOLO model file with onnxruntime, and what the file itself says about its classes, task and size."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubepose.detection.closer_look import Looks
from tubepose.detection.transformers import refuse_transformer
from tubepose.errors import DetectorError

_INPUT_TYPES: dict[str, type[np.floating]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
SIZE_STEP = 32
"""The coarsest usual stride: every level's grid must be whole."""
_DEFAULT_SIZE = 640


@dataclass(frozen=True, slots=True)
class ModelMetadata:
    """What the exporter wrote into a model file; None where it wrote nothing.

    Attributes:
        names: Class names in the order of their numbers.
        image_size: Width and height of the network's input, pixels.
        final_boxes: True when the file says that suppression is part of the network.
        layout: A layout of `yolo_decoding.LAYOUTS`, as our own exports write it.
        looks: How large the network is to see whole pictures and racks, if it was made to look at each rack again.
    """

    names: tuple[str, ...] | None
    image_size: tuple[int, int] | None
    final_boxes: bool
    layout: str | None
    looks: Looks | None


@dataclass(frozen=True, slots=True, eq=False)
class YoloSession:
    """A loaded network.

    Attributes:
        path: The model file, for messages.
        metadata: What the file says about itself.
        net_size: Width and height of the input, pixels.
        any_size: Whether it takes inputs of other sizes too.
        dtype: Type of the input values.
        runtime: The onnxruntime session.
    """

    path: Path
    metadata: ModelMetadata
    net_size: tuple[int, int]
    any_size: bool
    dtype: type[np.floating]
    runtime: Any

    def run(self, tensor: NDArray[np.floating]) -> list[NDArray[np.floating]]:
        """All outputs for one input of shape (1, 3, H, W).

        Raises:
            DetectorError: The network fails on its own input.
        """
        try:
            outputs = self.runtime.run(None, {self.runtime.get_inputs()[0].name: tensor})
        except _runtime_errors() as problem:
            raise DetectorError(f"{self.path}: the network fails: {problem}; export it again") from None
        return [np.asarray(output) for output in outputs]


def open_session(
    path: Path, providers: Sequence[str], threads: int | None, image_size: int | tuple[int, int] | None
) -> YoloSession:
    """Load a model file.

    Args:
        path: The .onnx file.
        providers: Execution providers that must all be in use.
        threads: Threads within an operator; None leaves it to onnxruntime.
        image_size: Width and height (or one number for both) for a model of any size; None takes the file's word.

    Raises:
        DetectorError: onnxruntime or a provider is missing, the file cannot be read, or the model is not a detector.
    """
    if threads is not None and threads < 1:
        raise DetectorError(f"threads {threads}: expected 1 or more; leave it out for onnxruntime's choice")
    if path.suffix in (".pt", ".pth"):
        raise DetectorError(f"{path}: PyTorch weights; expected an .onnx file: export it first (docs/detectors.md)")
    if not path.is_file():
        raise DetectorError(f"{path}: no such model file; expected an .onnx file")
    runtime = _start_runtime(path, providers, threads)
    inputs, outputs = ([item.name for item in items] for items in (runtime.get_inputs(), runtime.get_outputs()))
    refuse_transformer(path, inputs, outputs, runtime.get_modelmeta().custom_metadata_map)
    metadata = _read_metadata(path, runtime.get_modelmeta().custom_metadata_map)
    net_size, dtype = _read_input(path, runtime.get_inputs(), metadata, image_size)
    any_size = not any(isinstance(side, int) for side in runtime.get_inputs()[0].shape[2:])
    return YoloSession(path, metadata, net_size, any_size, dtype, runtime)


def _start_runtime(path: Path, providers: Sequence[str], threads: int | None) -> Any:
    try:
        import onnxruntime
    except ImportError as problem:
        raise DetectorError(
            f"{path}: onnxruntime cannot be imported ({problem}); install it with 'pip install onnxruntime'"
        ) from None
    asked, available = list(providers), onnxruntime.get_available_providers()
    _require_providers(path, asked, available)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # a library writes nothing to stderr; failures come as exceptions
    if threads is not None:
        options.intra_op_num_threads = threads
    try:
        runtime = onnxruntime.InferenceSession(str(path), sess_options=options, providers=asked)
    except _runtime_errors() as problem:
        raise DetectorError(f"{path}: no ONNX model that onnxruntime can load: {problem}") from None
    # A provider whose driver is missing is dropped in silence and the CPU takes over.
    _require_providers(path, asked, runtime.get_providers())
    return runtime


def _require_providers(path: Path, asked: list[str], found: list[str]) -> None:
    missing = [provider for provider in asked if provider not in found]
    if missing or not asked:
        raise DetectorError(
            f"{path}: asked for providers {', '.join(asked) or '(none)'}, found {', '.join(found)}; "
            "install the onnxruntime package and driver for the missing one, or ask for CPUExecutionProvider"
        )


def _runtime_errors() -> tuple[type[Exception], ...]:
    """The exceptions of onnxruntime, which have no base of their own."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    own = [item for item in vars(state).values() if isinstance(item, type) and issubclass(item, Exception)]
    return (*own, RuntimeError, ValueError)


def _read_metadata(path: Path, entries: dict[str, str]) -> ModelMetadata:
    task = entries.get("task", "detect")
    if task != "detect":
        raise DetectorError(
            f"{path}: a model for the task '{task}', expected 'detect'; train or export a detection model"
        )
    arguments = _literal(path, entries, "args")
    return ModelMetadata(
        names=_names(path, _literal(path, entries, "names")),
        image_size=_metadata_size(path, _literal(path, entries, "imgsz")),
        final_boxes=entries.get("end2end") == "True" or (isinstance(arguments, dict) and arguments.get("nms") is True),
        layout=entries.get("layout"),
        looks=_looks(path, _literal(path, entries, "looks")),
    )


def _literal(path: Path, entries: dict[str, str], key: str) -> Any:
    """A metadata entry, which exporters write as a Python literal; never evaluated as code."""
    if key not in entries:
        return None
    try:
        return ast.literal_eval(entries[key])
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        raise DetectorError(
            f"{path}: metadata '{key}' is {entries[key][:60]!r}, expected a Python literal; export the model again"
        ) from None


def _names(path: Path, found: Any) -> tuple[str, ...] | None:
    """Class names from a list, or from a mapping of numbers 0, 1, ... to names."""
    if found is None:
        return None
    values = list(found) if isinstance(found, list | tuple) else None
    if isinstance(found, dict) and set(found) == set(range(len(found))):
        values = [found[number] for number in range(len(found))]
    if not values or not all(isinstance(value, str) and value.strip() for value in values):
        raise DetectorError(
            f"{path}: metadata 'names' is {str(found)[:60]!r}, expected class names by number 0, 1, ...; "
            "export the model again or give classes"
        )
    return tuple(value.strip() for value in values)


def _metadata_size(path: Path, found: Any) -> tuple[int, int] | None:
    """Width and height from 'imgsz', which is one number or height before width."""
    if found is None:
        return None
    sides = [found, found] if isinstance(found, int) else found
    if not (isinstance(sides, list | tuple) and len(sides) == 2 and all(isinstance(side, int) for side in sides)):
        raise DetectorError(f"{path}: metadata 'imgsz' is {found!r}, expected [height, width]; export the model again")
    return int(sides[1]), int(sides[0])


def _looks(path: Path, found: Any) -> Looks | None:
    """Longer sides of the input for whole pictures and for racks."""
    if found is None:
        return None
    sides = list(found) if isinstance(found, list | tuple) else []
    if len(sides) != 2 or not all(isinstance(side, int) and side > 0 and side % SIZE_STEP == 0 for side in sides):
        raise DetectorError(
            f"{path}: metadata 'looks' is {found!r}, expected [whole, rack], multiples of {SIZE_STEP}; "
            "export the model again"
        )
    return Looks(sides[0], sides[1])


def _read_input(
    path: Path, inputs: list[Any], metadata: ModelMetadata, image_size: int | tuple[int, int] | None
) -> tuple[tuple[int, int], type[np.floating]]:
    """Size (width, height) and type of the network's input."""
    shape = list(inputs[0].shape) if inputs else []
    sides = [side if isinstance(side, int) and side > 0 else None for side in shape]
    if len(inputs) != 1 or len(sides) != 4 or sides[0] not in (1, None) or sides[1] not in (3, None):
        found = "; ".join(f"{item.name} {item.shape}" for item in inputs)
        raise DetectorError(f"{path}: input {found}, expected one image input [1, 3, height, width]; export it so")
    if inputs[0].type not in _INPUT_TYPES:
        known = " or ".join(_INPUT_TYPES)
        raise DetectorError(f"{path}: input of type {inputs[0].type}, expected {known}; export without quantised input")
    given = (image_size, image_size) if isinstance(image_size, int) else image_size
    wanted = given or metadata.image_size or (_DEFAULT_SIZE, _DEFAULT_SIZE)
    size = (sides[3] or wanted[0], sides[2] or wanted[1])
    if given is not None and given != size:
        raise DetectorError(f"{path}: image_size {given} given, but the model is made for {size}; leave image_size out")
    if any(side <= 0 or side % SIZE_STEP for side in size):
        raise DetectorError(f"{path}: input of {size[0]} x {size[1]} pixels, expected multiples of {SIZE_STEP}")
    return size, _INPUT_TYPES[inputs[0].type]

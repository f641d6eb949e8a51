"""Training: seeded, resumable, with a loss that can be looked at."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from tubepose.detection.labelled_images import LabelledFiles
from tubepose.errors import DetectorError
from tubepose.report import write_aside
from tubepose.training.augmentation import Views, draw_sample
from tubepose.training.network import build_network
from tubepose.training.start import CHECKPOINT, load_start, match_statistics

if TYPE_CHECKING:
    import torch

_STATISTICS_BATCHES = 8
"""Batches whose statistics a start from a model's file takes over."""
_LOSSES = ("total_loss", "iou_loss", "conf_loss", "cls_loss")


class Recipe(BaseModel):
    """Everything that decides what is learned, the pictures apart.

    Attributes:
        steps: Batches to learn from.
        batch: Samples a batch, at `side_px`; larger samples come in smaller batches.
        side_px: Side of a sample for most of the time; every batch differs from it by up to a fifth.
        late_side_px: Side for the last part, without mosaics: the size of things as they will be met.
        late_share: How long that part is, as a share of the steps.
        whole_px: Longer side of a whole picture as the network will see it.
        rack_px: Longer side of a rack as the network will see it when it looks at that rack alone.
        rack_share: Share of the samples that are at about that scale.
        rate: Largest learning rate of what starts from nothing; the backbone learns at a tenth of it.
        weight_decay: Of AdamW.
        frozen_blocks: Leading blocks of the backbone that keep what they learned on photographs.
        mosaic_share: Chance of a sample of four pictures.
        average: Weights that are exported are an average over about 1 / (1 - average) steps.
        pretrained: Start from ImageNet weights.
        seed: Of everything that is random.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    steps: int = Field(default=5000, ge=1)
    batch: int = Field(default=8, ge=1)
    side_px: int = Field(default=384, ge=96, multiple_of=32)
    late_side_px: int = Field(default=544, ge=96, multiple_of=32)
    late_share: float = Field(default=0.2, ge=0, le=1)
    whole_px: int = Field(default=512, ge=96)
    rack_px: int = Field(default=552, ge=64)
    rack_share: float = Field(default=0.5, ge=0, le=1)
    rate: float = Field(default=1e-3, gt=0)
    weight_decay: float = Field(default=0.02, ge=0)
    frozen_blocks: int = Field(default=3, ge=0, le=16)
    mosaic_share: float = Field(default=0.4, ge=0, le=1)
    average: float = Field(default=0.998, ge=0, lt=1)
    pretrained: bool = True
    seed: int = 0

    def sha256(self, *others: str) -> str:
        """Fingerprint of the recipe, and of other texts that belong to it."""
        text = json.dumps(self.model_dump(), sort_keys=True)
        return hashlib.sha256("\n".join([text, *others]).encode()).hexdigest()


class Trainer:
    """One run of training: a network, its average, and how far it has come."""

    def __init__(
        self, recipe: Recipe, files: LabelledFiles, folder: Path, *, threads: int, start: Path | None = None
    ) -> None:
        """Start anew, or go on from the folder's checkpoint.

        Args:
            recipe: How to train.
            files: Pictures to learn from.
            folder: Where the checkpoint is.
            threads: Processor threads.
            start: Checkpoint of another training, whose averaged weights this one starts from, or a model of one.

        Raises:
            DetectorError: A package is missing, a checkpoint is of another recipe, other pictures or other classes, or
                `start` is none.
        """
        import torch

        self.recipe, self.files, self.folder = recipe, files, folder
        self.start_sha256 = hashlib.sha256(start.read_bytes()).hexdigest() if start is not None else ""
        torch.set_num_threads(threads)
        torch.manual_seed(recipe.seed)
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        network = build_network(len(files.classes), pretrained=recipe.pretrained and start is None)
        unfitted = start is not None and load_start(network, start, files.classes)
        self.network = network.to(self.device, memory_format=torch.channels_last)
        resumed = (folder / CHECKPOINT).is_file()
        if unfitted and not resumed:
            self._match_statistics()
        _freeze(self.network, recipe.frozen_blocks)
        self.optimizer = torch.optim.AdamW(_groups(self.network, recipe), lr=recipe.rate)
        self.average = torch.optim.swa_utils.AveragedModel(
            self.network, multi_avg_fn=None, avg_fn=self._blend, use_buffers=True
        )
        self.step = 0
        self.losses: list[list[float]] = []
        if resumed:
            self._resume(folder / CHECKPOINT)

    def _match_statistics(self) -> None:
        """Normalise by what this training's own batches are like: a model's file has no statistics of its own."""
        _train_mode(self.network)
        match_statistics(self.network, (self._images(self.batch(step)[0]) for step in range(_STATISTICS_BATCHES)))

    def _images(self, images: NDArray[np.uint8]) -> torch.Tensor:
        import torch

        tensor = torch.from_numpy(images).to(self.device, torch.float32)
        return tensor.contiguous(memory_format=torch.channels_last)

    def _blend(self, mean: torch.Tensor, value: torch.Tensor, count: torch.Tensor | int) -> torch.Tensor:
        share = min(self.recipe.average, (1.0 + int(count)) / (10.0 + int(count)))
        return mean + (value - mean) * (1.0 - share) if mean.is_floating_point() else value

    def run(self, on_step: Callable[[int, float], None] = lambda _step, _loss: None, save_every: int = 200) -> None:
        """Learn from the remaining batches; the checkpoint is written now and then, and at the end.

        Batch k depends on the recipe and on k alone, so that a run that was cut off learns what it would have learned.

        Args:
            on_step: Called with the number of steps done and the loss.
            save_every: Steps between checkpoints.
        """
        with ThreadPoolExecutor(1) as ahead:
            future = ahead.submit(self.batch, self.step)
            while self.step < self.recipe.steps:
                images, labels = future.result()
                future = ahead.submit(self.batch, self.step + 1)
                losses = self._learn(images, labels)
                self.step += 1
                self.losses.append([float(self.step), *losses])
                on_step(self.step, losses[0])
                if self.step % save_every == 0 or self.step == self.recipe.steps:
                    self._save()
            future.cancel()

    def batch(self, step: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Batch k: RGB images (B, 3, side, side) and labels (B, N, 5) as `build_network` takes them."""
        recipe = self.recipe
        rng = np.random.default_rng([recipe.seed, step])
        late = step >= recipe.steps * (1 - recipe.late_share)
        base = recipe.late_side_px if late else recipe.side_px
        side = max(96, 32 * round(base * rng.uniform(0.8, 1.2) / 32))
        count = max(1, round(recipe.batch * min(1.0, (recipe.side_px / side) ** 2)))
        mosaic = 0.0 if late else recipe.mosaic_share
        views = Views(recipe.whole_px, recipe.rack_px, recipe.rack_share)
        samples = [draw_sample(self.files, side, mosaic, views, rng) for _ in range(count)]
        most = max(1, *(len(sample.class_ids) for sample in samples))
        labels = np.zeros((count, most, 5), np.float32)
        for row, sample in zip(labels, samples, strict=True):
            low, high = sample.edges_xyxy[:, :2], sample.edges_xyxy[:, 2:]
            row[: len(low)] = np.column_stack([sample.class_ids, (low + high) / 2, high - low])
        return np.stack([sample.image.transpose(2, 0, 1) for sample in samples]), labels

    def _learn(self, images: NDArray[np.uint8], labels: NDArray[np.float32]) -> list[float]:
        import torch

        _train_mode(self.network)
        rate = self.recipe.rate * _schedule(self.step, self.recipe.steps)
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["share"]
        with warnings.catch_warnings():  # YOLOX calls autocast by its old name
            warnings.simplefilter("ignore", FutureWarning)
            found = self.network(self._images(images), torch.from_numpy(labels).to(self.device))
        self.optimizer.zero_grad(set_to_none=True)
        found["total_loss"].backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self.optimizer.step()
        self.average.update_parameters(self.network)
        return [float(torch.as_tensor(found[name]).detach()) for name in _LOSSES]

    def _identity(self) -> str:
        return self.recipe.sha256(self.files.fingerprint(), self.start_sha256)

    def _save(self) -> None:
        import torch

        state: dict[str, Any] = {
            "identity": self._identity(),
            "step": self.step,
            "losses": self.losses,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        with write_aside(self.folder / CHECKPOINT) as aside:
            torch.save(state, aside)

    def _resume(self, file: Path) -> None:
        import torch

        state = torch.load(file, map_location=self.device, weights_only=True)
        if state["identity"] != self._identity():
            raise DetectorError(
                f"{file}: a checkpoint of another recipe, other pictures or other classes; remove it to start anew, "
                "or give the options it was started with"
            )
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step, self.losses = state["step"], state["losses"]


def _freeze(network: torch.nn.Module, blocks: int) -> None:
    backbone: Any = network.backbone.backbone
    for module in (backbone.stem, *backbone.blocks[:blocks]):
        for parameter in module.parameters():
            parameter.requires_grad_(blocks == 0)


def _train_mode(network: torch.nn.Module) -> None:
    """Training mode, but the backbone normalises by the photographs' statistics: batches are small."""
    import torch

    network.train()
    for module in network.backbone.backbone.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.eval()


def _groups(network: torch.nn.Module, recipe: Recipe) -> list[dict[str, Any]]:
    """Parameters by how fast they learn, and whether they decay: scales and offsets do not."""
    groups: dict[tuple[bool, bool], list[torch.nn.Parameter]] = {}
    for name, parameter in network.named_parameters():
        if parameter.requires_grad:
            old = name.startswith(("backbone.backbone.stem", "backbone.backbone.blocks"))
            groups.setdefault((old and recipe.pretrained, parameter.ndim > 1), []).append(parameter)
    return [
        {"params": found, "share": 0.1 if old else 1.0, "weight_decay": recipe.weight_decay if decays else 0.0}
        for (old, decays), found in groups.items()
    ]


def _schedule(step: int, steps: int) -> float:
    """Learning rate as a share of the largest: up within the first twentieth, then down half a cosine to 1 %."""
    warm = max(1, steps // 20)
    if step < warm:
        return (step + 1) / warm
    return float(0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * (step - warm) / max(1, steps - warm))))

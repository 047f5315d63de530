"""The architecture of the network that says whether a crop shows a drone: an encoder that has seen natural images.

Its encoder is the first five stages of EfficientNet-Lite0 (Tan and Le, ICML 2019; the Lite variant is Google's, 2020),
so that it can begin with weights learnt from ImageNet. These expect TensorFlow's padding, which adds more on the right
and below; torch adds more on the left and above. So the crop enters upside down, and every kernel is turned with it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CROP_PX = 96
STEM_CHANNELS = 32
GREY_LEVELS = 128.0
"""The image enters as (grey level - 128) / 128."""
FIXED_BLOCKS = 3
"""So many first blocks, and the layer before them, keep what they learnt from natural images: edges and textures."""
GRID = 3
"""The crop is summed up in so many by so many parts: a drone stands in the middle."""


class Stage(NamedTuple):
    """Blocks of one width; the first has the stride."""

    kernel: int
    stride: int
    expansion: int
    channels: int
    blocks: int


STAGES = (
    Stage(3, 1, 1, 16, 1),
    Stage(3, 2, 6, 24, 2),
    Stage(5, 2, 6, 40, 2),
    Stage(3, 2, 6, 80, 3),
    Stage(5, 1, 6, 112, 3),
)


def _conv(inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> nn.Sequential:
    norm = nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.01)
    return nn.Sequential(nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False), norm)


class _Block(nn.Module):
    """An inverted residual: wider, each channel by itself, narrower again."""

    def __init__(self, inputs: int, stage: Stage, *, is_first: bool) -> None:
        super().__init__()
        wide, stride = inputs * stage.expansion, stage.stride if is_first else 1
        self.expand = _conv(inputs, wide) if stage.expansion > 1 else None
        self.each = _conv(wide, wide, stage.kernel, stride, groups=wide)
        self.project = _conv(wide, stage.channels)
        self.is_residual = stride == 1 and inputs == stage.channels

    def forward(self, x: Tensor) -> Tensor:
        wide = x if self.expand is None else F.relu6(self.expand(x))
        narrow: Tensor = self.project(F.relu6(self.each(wide)))
        return x + narrow if self.is_residual else narrow


class VerificationNet(nn.Module):
    """Whether there is a drone in the middle of a crop.

    Input: `crop` (n, 96, 96, 3) uint8, RGB, as ``DistanceNet`` takes it. Output (n, 1): logit of there being a drone.
    """

    size = CROP_PX
    hidden = 160

    def __init__(self) -> None:
        super().__init__()
        self.stem = _conv(3, STEM_CHANNELS, 3, 2)
        blocks, channels = [], STEM_CHANNELS
        for stage in STAGES:
            for number in range(stage.blocks):
                blocks.append(_Block(channels, stage, is_first=number == 0))
                channels = stage.channels
        self.fixed, self.blocks = nn.ModuleList(blocks[:FIXED_BLOCKS]), nn.ModuleList(blocks[FIXED_BLOCKS:])
        self.summary = nn.Sequential(nn.Linear(channels * GRID**2, self.hidden), nn.ReLU(True), nn.Dropout(0.2))
        self.head = nn.Linear(self.hidden, 1)

    def train(self, mode: bool = True) -> VerificationNet:
        """As torch does; the fixed layers stay as they are."""
        super().train(mode)
        self.stem.eval()
        self.fixed.eval()
        return self

    def forward(self, crop: Tensor) -> Tensor:
        """One logit (n, 1) a crop."""
        grey = crop.flip(1, 2).permute(0, 3, 1, 2).float() - GREY_LEVELS
        with torch.set_grad_enabled(False):
            x = F.relu6(self.stem(grey / GREY_LEVELS) if self.training else self._stem_on_grey(grey))
            for block in self.fixed:
                x = block(x)
        for block in self.blocks:
            x = block(x)
        parts = F.avg_pool2d(x, x.shape[-1] // GRID)
        logit: Tensor = self.head(self.summary(parts.flatten(1)))
        return logit

    @staticmethod
    def stem_of(kernel_and_bias: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """The weights, without their normalisation, that `_stem_on_grey` made this kernel and bias of."""
        kernel, bias = kernel_and_bias
        return {"stem.0.weight": kernel * GREY_LEVELS, "stem.0.bias": bias}

    def _stem_on_grey(self, grey: Tensor) -> Tensor:
        """The first layer on whole numbers, which in 8 bits are what they are: see ``tools.quantise``."""
        convolution, norm = self.stem[0], self.stem[1]
        scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        kernel = (convolution.weight * scale[:, None, None, None] / GREY_LEVELS).detach()
        bias = (norm.bias - norm.running_mean * scale).detach()
        return F.conv2d(grey, kernel.clone(), bias, stride=2, padding=1)


def weights_of_efficientnet(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Those of ``VerificationNet`` among the weights of EfficientNet-Lite0, which has its own names for them.

    Raises ValueError where they are of something else.
    """
    layers = {"_conv_stem": "stem.0", "_bn0": "stem.1"}
    for number in range(sum(stage.blocks for stage in STAGES)):
        theirs = f"_blocks.{number}"
        ours = f"fixed.{number}" if number < FIXED_BLOCKS else f"blocks.{number - FIXED_BLOCKS}"
        for part, convolution, norm in (
            ("expand", "_expand_conv", "_bn0"),
            ("each", "_depthwise_conv", "_bn1"),
            ("project", "_project_conv", "_bn2"),
        ):
            layers |= {f"{theirs}.{convolution}": f"{ours}.{part}.0", f"{theirs}.{norm}": f"{ours}.{part}.1"}
    renamed = {
        f"{layers[layer]}.{kind}": value.flip(2, 3) if value.dim() == 4 else value
        for layer, _, kind, value in ((*name.rpartition("."), value) for name, value in weights.items())
        if layer in layers
    }
    encoder = ("stem.", "fixed.", "blocks.")
    for name, value in VerificationNet().state_dict().items():
        if not name.startswith(encoder):
            continue
        if name not in renamed or renamed[name].shape != value.shape:
            raise ValueError(f"no {name} of shape {list(value.shape)} in it; give the weights of EfficientNet-Lite0")
    return renamed

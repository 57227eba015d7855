"""BiSeNetV2 (Yu et al. 2021, arXiv 2004.02147) with a head at half scale, so that thin things survive.

As published: a wide and shallow detail branch to 1/8, a narrow and deep semantic branch (stem,
gather-and-expansion layers, context embedding) to 1/32, bilateral guided aggregation of the two, booster
heads on the semantic stages while training. Ours: the aggregate climbs back to 1/4 and 1/2 over the detail
branch's own stages, because at 1/8 a lane line of 4 px, or a post of 3 px, is less than one cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from pipeline import labels

STRIDE = 32
"""Height and width of the input are multiples of this: the deepest semantic stage."""

GRID = 2
"""The probabilities stand on a grid of this many input pixels."""

MEAN_RGB = (102.0, 104.0, 103.0)
STD_RGB = (62.0, 63.0, 65.0)
"""Centre and spread of road pictures in 0..255, rounded; inside the graph, so that callers pass plain RGB."""


@dataclass(frozen=True, slots=True)
class Widths:
    """Channels of each part; the defaults keep a 1242x375 frame near 0.1 s on two cores.

    Args:
        detail: Channels of the detail branch at 1/2, 1/4 and 1/8.
        semantic: Channels of the semantic branch at 1/4, 1/8, 1/16 and 1/32.
        expansion: Factor of the gather-and-expansion layers.
        fused: Channels of the aggregate at 1/8.
        climb: Channels of the way back at 1/4 and 1/2.
    """

    detail: tuple[int, int, int] = (16, 32, 64)
    semantic: tuple[int, int, int, int] = (16, 32, 64, 96)
    expansion: int = 4
    fused: int = 64
    climb: tuple[int, int] = (32, 16)


def conv(
    inputs: int, outputs: int, kernel: int = 3, *, stride: int = 1, groups: int = 1, relu: bool = True
) -> nn.Module:
    """Return convolution, batch norm and, where asked, a rectifier."""
    layers: list[nn.Module] = [
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outputs),
    ]
    if relu:
        layers.append(nn.ReLU(inplace=True))
    return nn.Sequential(*layers)


def _double(x: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


class DetailBranch(nn.Module):
    """Three stages of plain convolutions to 1/8; the stages at 1/2 and 1/4 are handed out too."""

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        half, quarter, eighth = widths
        self.to2 = nn.Sequential(conv(3, half, stride=2), conv(half, half))
        self.to4 = nn.Sequential(
            conv(half, quarter, stride=2), conv(quarter, quarter), conv(quarter, quarter)
        )
        self.to8 = nn.Sequential(conv(quarter, eighth, stride=2), conv(eighth, eighth), conv(eighth, eighth))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Map (B, 3, H, W) to the stages at 1/2, 1/4 and 1/8."""
        half = self.to2(x)
        quarter = self.to4(half)
        return half, quarter, self.to8(quarter)


class Stem(nn.Module):
    """Two ways down to 1/4, one by convolution and one by maximum, joined."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.enter = conv(3, width, stride=2)
        self.left = nn.Sequential(conv(width, width // 2, 1), conv(width // 2, width, stride=2))
        self.right = nn.MaxPool2d(3, 2, 1)
        self.join = conv(2 * width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, 3, H, W) to (B, width, H/4, W/4)."""
        x = self.enter(x)
        joined: torch.Tensor = self.join(torch.cat((self.left(x), self.right(x)), dim=1))
        return joined


class GatherExpansion(nn.Module):
    """Gather by a 3x3 convolution, expand by depthwise ones, project back and add the shortcut."""

    def __init__(self, inputs: int, outputs: int, *, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        if stride == 1:
            middle = conv(inputs, wide, groups=inputs)
            self.shortcut: nn.Module = nn.Identity()
        else:
            middle = nn.Sequential(
                conv(inputs, wide, stride=2, groups=inputs, relu=False), conv(wide, wide, groups=wide)
            )
            self.shortcut = nn.Sequential(
                conv(inputs, inputs, stride=2, groups=inputs, relu=False),
                conv(inputs, outputs, 1, relu=False),
            )
        self.main = nn.Sequential(conv(inputs, inputs), middle, conv(wide, outputs, 1, relu=False))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, inputs, h, w) to (B, outputs, h/stride, w/stride)."""
        return functional.relu(self.main(x) + self.shortcut(x))


class ContextEmbedding(nn.Module):
    """Add what the whole picture says to every cell."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(width)
        self.embed = conv(width, width, 1)
        self.last = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, width, h, w) to the same shape."""
        whole = self.embed(self.norm(x.mean(dim=(2, 3), keepdim=True)))
        added: torch.Tensor = self.last(x + whole)
        return added


class SemanticBranch(nn.Module):
    """Stem, gather-and-expansion layers to 1/32 and the context embedding."""

    def __init__(self, widths: tuple[int, int, int, int], expansion: int) -> None:
        super().__init__()
        c2, c3, c4, c5 = widths
        self.stem = Stem(c2)
        self.stage3 = _stage(c2, c3, layers=2, expansion=expansion)
        self.stage4 = _stage(c3, c4, layers=2, expansion=expansion)
        self.stage5 = _stage(c4, c5, layers=4, expansion=expansion)
        self.context = ContextEmbedding(c5)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Map (B, 3, H, W) to the stages at 1/4, 1/8, 1/16, 1/32 and the context at 1/32."""
        x2 = self.stem(x)
        x3 = self.stage3(x2)
        x4 = self.stage4(x3)
        x5 = self.stage5(x4)
        return x2, x3, x4, x5, self.context(x5)


def _stage(inputs: int, outputs: int, *, layers: int, expansion: int) -> nn.Module:
    first = GatherExpansion(inputs, outputs, stride=2, expansion=expansion)
    rest = [GatherExpansion(outputs, outputs, stride=1, expansion=expansion) for _ in range(layers - 1)]
    return nn.Sequential(first, *rest)


class Aggregation(nn.Module):
    """Bilateral guided aggregation: each branch gates the other at its own scale, summed at 1/8."""

    def __init__(self, detail: int, semantic: int, fused: int) -> None:
        super().__init__()
        self.detail_keep = nn.Sequential(
            conv(detail, detail, groups=detail, relu=False), nn.Conv2d(detail, fused, 1)
        )
        self.detail_down = nn.Sequential(conv(detail, fused, stride=2, relu=False), nn.AvgPool2d(3, 2, 1))
        self.semantic_keep = nn.Sequential(
            conv(semantic, semantic, groups=semantic, relu=False), nn.Conv2d(semantic, fused, 1)
        )
        self.semantic_up = conv(semantic, fused, relu=False)
        self.join = conv(fused, fused)

    def forward(self, detail: torch.Tensor, semantic: torch.Tensor) -> torch.Tensor:
        """Map detail (B, d, h, w) and semantic (B, s, h/4, w/4) to (B, fused, h, w)."""
        fine = self.detail_keep(detail) * torch.sigmoid(_double(_double(self.semantic_up(semantic))))
        coarse = self.detail_down(detail) * torch.sigmoid(self.semantic_keep(semantic))
        joined: torch.Tensor = self.join(fine + _double(_double(coarse)))
        return joined


class BiSeNetV2(nn.Module):
    """From RGB 0..255 (B, 3, H, W), H and W multiples of ``STRIDE``, to logits (B, classes, H/2, W/2)."""

    def __init__(self, widths: Widths | None = None, classes: int = len(labels.NAMES)) -> None:
        super().__init__()
        widths = widths or Widths()
        half, quarter, eighth = widths.detail
        climb4, climb2 = widths.climb
        self.detail = DetailBranch(widths.detail)
        self.semantic = SemanticBranch(widths.semantic, widths.expansion)
        self.aggregate = Aggregation(eighth, widths.semantic[-1], widths.fused)
        self.narrow4 = conv(widths.fused, climb4, 1)
        self.climb4 = nn.Sequential(conv(climb4 + quarter, climb4, 1), conv(climb4, climb4))
        self.narrow2 = conv(climb4, climb2, 1)
        self.climb2 = nn.Sequential(conv(climb2 + half, climb2, 1), conv(climb2, climb2))
        self.head = nn.Conv2d(climb2, classes, 1)
        self.boosters = nn.ModuleList(
            nn.Sequential(conv(width, 2 * width), nn.Conv2d(2 * width, classes, 1))
            for width in widths.semantic
        )
        self.register_buffer("mean", torch.tensor(MEAN_RGB).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(STD_RGB).view(1, 3, 1, 1))

    def forward(self, rgb: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Return the logits at 1/2 and, in training only, the boosters' at 1/4, 1/8, 1/16 and 1/32."""
        x = (rgb - self.mean) / self.std
        half, quarter, eighth = self.detail(x)
        *stages, context = self.semantic(x)
        fused = self.aggregate(eighth, context)
        at4 = self.climb4(torch.cat((_double(self.narrow4(fused)), quarter), dim=1))
        at2 = self.climb2(torch.cat((_double(self.narrow2(at4)), half), dim=1))
        boosted = (
            [head(stage) for head, stage in zip(self.boosters, stages, strict=True)] if self.training else []
        )
        return self.head(at2), boosted

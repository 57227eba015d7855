"""Loss for labels that say a group of classes: the negative log of the group's summed probability."""

from __future__ import annotations

import torch

from pipeline import labels

CLASS_WEIGHTS = (1.0, 3.0, 5.0, 1.0, 1.0, 1.0, 1.0, 1.0, 2.0)
"""Weight of a pixel by its label value. Paint and poles cover 1 to 2 % of a road picture: without weight the
cheapest answer is to deny them. More weight over-paints: the probabilities then say more than was seen."""

_FLOOR = 1e-30
"""Smallest probability that still has a gradient: logits 69 apart, and its inverse is finite in float32."""


def grouped_nll(
    logits: torch.Tensor, target: torch.Tensor, groups: torch.Tensor, weights: torch.Tensor
) -> torch.Tensor:
    """Return the weighted mean over labelled pixels of ``-log(sum of p over the pixel's group)``.

    The target may stand on a finer grid than the logits: each cell then answers for all its pixels, so that
    the probability it learns is the share of the cell that the class covers.

    Args:
        logits: (B, classes, h, w).
        target: Label values, integer (B, f*h, f*w) with a whole number f; ``labels.IGNORE`` takes no part.
        groups: What a value may be, bool (B, classes, classes), see ``labels.group_table``.
        weights: Weight of a pixel by its label value, (classes,).
    """
    batch, _, height, width = logits.shape
    factor = target.shape[1] // height
    if target.shape != (batch, factor * height, factor * width):
        raise ValueError(f"target {tuple(target.shape)} is no whole multiple of logits {tuple(logits.shape)}")
    by_value = torch.einsum("bvc,bchw->bvhw", groups.to(logits.dtype), torch.softmax(logits, dim=1))
    cells = target.view(batch, height, factor, width, factor).permute(0, 2, 4, 1, 3)
    values = cells.reshape(batch, factor * factor, height, width).long()
    known = values != labels.IGNORE
    values = torch.where(known, values, 0)
    weight = weights[values] * known
    nll = -torch.log(by_value.gather(1, values).clamp(min=_FLOOR))
    return (weight * nll).sum() / weight.sum().clamp(min=1.0)


def boosted_loss(
    logits: torch.Tensor,
    boosted: list[torch.Tensor],
    target: torch.Tensor,
    groups: torch.Tensor,
    weights: torch.Tensor,
    *,
    booster_share: float = 0.25,
) -> torch.Tensor:
    """Return the loss of the head plus a share of each booster's, whose cells answer for their centre pixel.

    Args:
        logits: Head, (B, classes, h, w).
        boosted: Heads of the semantic stages, each (B, classes, h', w') of whole factors of the target.
        target: As in ``grouped_nll``.
        groups: As in ``grouped_nll``.
        weights: As in ``grouped_nll``.
        booster_share: Weight of one booster: they guide the stages, the head is what is used.
    """
    loss = grouped_nll(logits, target, groups, weights)
    for coarse in boosted:
        step = target.shape[1] // coarse.shape[2]
        centres = target[:, step // 2 :: step, step // 2 :: step]
        loss = loss + booster_share * grouped_nll(coarse, centres, groups, weights)
    return loss

"""Train BiSeNetV2 on data in the fleet layout: ``python -m models.train --data DIR --out DIR --minutes N``.

Checkpoints are written every few minutes and the same command goes on from the last one, also with more data
or more minutes. The learning rate is held, then falls over the last part of the time, so that a run ends well
whatever the machine. What stands when the fall begins is kept too: ``--start`` lets another run, with other
data, go on from there (a run that has ended has lost the rate to learn with).
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from models import losses
from models.bisenetv2 import BiSeNetV2
from models.data import Sampler, fingerprint, read_sets

if TYPE_CHECKING:
    from collections.abc import Callable

CHECKPOINT = "checkpoint.pt"
BEFORE_FALL = "before_fall.pt"
"""Checkpoint of the moment at which the rate began to fall."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Recipe:
    """How the network is trained.

    Args:
        crop: Crop (height, width), px, multiples of 32.
        batch: Crops a step.
        rate: Highest learning rate of AdamW.
        decay: Weight decay of AdamW.
        fall: Last share of the time over which the rate falls to nothing.
        warm_up: Steps over which the rate rises.
        average: Decay of the running mean of the weights, which is what is exported.
        save_s: Seconds between checkpoints.
        clip: Largest norm of the gradient: one odd crop must not throw a run.
    """

    crop: tuple[int, int] = (256, 448)
    batch: int = 6
    rate: float = 2.5e-3
    decay: float = 0.01
    fall: float = 0.4
    warm_up: int = 100
    average: float = 0.998
    save_s: float = 120.0
    clip: float = 5.0


@dataclass(slots=True, eq=False)
class Run:
    """What a checkpoint holds: the network, its running mean, the optimiser, steps and seconds spent."""

    network: BiSeNetV2
    average: BiSeNetV2
    optimiser: torch.optim.Optimizer
    step: int = 0
    spent_s: float = 0.0

    def save(self, path: Path, data: str) -> None:
        """Write beside the final name, then rename: a killed run leaves the last checkpoint whole."""
        unfinished = path.with_suffix(".tmp")
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "spent_s": self.spent_s,
            "data_sha256": data,
            "class_weights": list(losses.CLASS_WEIGHTS),
        }
        torch.save(state, unfinished)
        unfinished.replace(path)

    def load(self, path: Path) -> None:
        """Go on from a checkpoint."""
        state = torch.load(path, map_location="cpu", weights_only=True)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.spent_s = int(state["step"]), float(state["spent_s"])


def start(recipe: Recipe, device: torch.device) -> Run:
    """Return a fresh run."""
    network = BiSeNetV2().to(device, memory_format=torch.channels_last)
    average = BiSeNetV2().to(device, memory_format=torch.channels_last)
    average.load_state_dict(network.state_dict())
    average.requires_grad_(requires_grad=False)
    optimiser = torch.optim.AdamW(network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
    return Run(network, average, optimiser)


def learning_rate(recipe: Recipe, step: int, progress: float) -> float:
    """Rise over the first steps, hold, fall linearly over the last share of the time."""
    return recipe.rate * min(1.0, (step + 1) / recipe.warm_up, max(1.0 - progress, 1e-3) / recipe.fall)


def update_average(average: torch.nn.Module, network: torch.nn.Module, decay: float, step: int) -> None:
    """Move the running mean towards the network, faster while there are few steps to average over."""
    keep = min(decay, (1.0 + step) / (10.0 + step))
    new = network.state_dict()
    for name, value in average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(new[name], 1.0 - keep)
        else:
            value.copy_(new[name])


def train(
    run: Run,
    sampler: Sampler,
    recipe: Recipe,
    *,
    minutes: float,
    out: Path,
    data: str,
    seed: int,
    clock: Callable[[], float],
) -> None:
    """Train until ``minutes`` are spent in all, over every call; the checkpoint goes to ``out``.

    ``clock`` gives seconds that never go back; ``data`` is the fingerprint of the training data.
    """
    device = next(run.network.parameters()).device
    half_precision = device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()  # noqa: SLF001 no public name
    weights = torch.tensor(losses.CLASS_WEIGHTS, device=device)
    rng = np.random.default_rng((seed, run.step))
    run.network.train()
    began = saved = clock()
    before = run.spent_s
    losses_seen: list[float] = []
    falling = before >= (1.0 - recipe.fall) * 60.0 * minutes
    while run.spent_s < 60.0 * minutes:
        progress = run.spent_s / (60.0 * minutes)
        if not falling and progress >= 1.0 - recipe.fall:
            run.save(out / BEFORE_FALL, data)
            falling = True
        rate = learning_rate(recipe, run.step, progress)
        for group in run.optimiser.param_groups:
            group["lr"] = rate
        rgb, label, groups = sampler.batch(recipe.batch, rng)
        pixels = torch.from_numpy(rgb).to(device, torch.float32, memory_format=torch.channels_last)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=half_precision):
            logits, boosted = run.network(pixels)
        loss = losses.boosted_loss(
            logits.float(),
            [coarse.float() for coarse in boosted],
            torch.from_numpy(label).to(device),
            torch.from_numpy(groups).to(device),
            weights,
        )
        run.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(run.network.parameters(), recipe.clip)
        run.optimiser.step()
        update_average(run.average, run.network, recipe.average, run.step)
        losses_seen.append(float(loss.detach()))
        run.step += 1
        now = clock()
        run.spent_s = before + now - began
        if run.step % 50 == 0:
            mean_loss = sum(losses_seen) / len(losses_seen)
            log.info("step %d, %.0f s, rate %.5f, loss %.4f", run.step, run.spent_s, rate, mean_loss)
            losses_seen.clear()
        if now - saved > recipe.save_s:
            run.save(out / CHECKPOINT, data)
            saved = now
    run.save(out / CHECKPOINT, data)


def _weight(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    return name, float(value)


def main() -> None:
    """Read the options and train."""
    parser = argparse.ArgumentParser(prog="python -m models.train", description=__doc__)
    parser.add_argument(
        "--data", type=Path, action="append", required=True, help="folder of sets; may be repeated"
    )
    parser.add_argument(
        "--set", dest="sets", action="append", default=[], metavar="SET", help="train on these sets only"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the checkpoint and the log")
    parser.add_argument(
        "--minutes", type=float, required=True, help="time to spend in all, earlier runs counted in"
    )
    parser.add_argument(
        "--weight", type=_weight, action="append", default=[], metavar="SET=W", help="share of draws"
    )
    parser.add_argument(
        "--start", type=Path, metavar="FILE", help="checkpoint whose weights a new run begins with"
    )
    parser.add_argument("--threads", type=int, default=1, help="threads of the processor")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    handlers: list[logging.Handler] = [logging.StreamHandler(), logging.FileHandler(options.out / "log.txt")]
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=handlers)
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    torch.manual_seed(options.seed)
    recipe = Recipe()
    sets = read_sets(options.data, frozenset(options.sets))
    run = start(recipe, torch.device("cuda" if torch.cuda.is_available() else "cpu"))
    if (options.out / CHECKPOINT).is_file():
        run.load(options.out / CHECKPOINT)
    elif options.start is not None:
        run.load(options.start)
        run.step, run.spent_s = 0, 0.0
    sampler = Sampler(sets, recipe.crop, dict(options.weight))
    train(
        run,
        sampler,
        recipe,
        minutes=options.minutes,
        out=options.out,
        data=fingerprint(sets),
        seed=options.seed,
        clock=time.monotonic,
    )


if __name__ == "__main__":
    main()

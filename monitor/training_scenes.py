"""Labelled pictures of simulated streets as one set of the training folder: images, labels and ``set.json``.

    python -m monitor.training_scenes --out training/simulated --count 300 --seed 1

Every picture is another street, camera, light and sensor; picture k of a seed is always the same.
"""

import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import click
import cv2
import numpy as np

from pipeline import labels
from pipeline.errors import CalibwatchError, InputError
from pipeline.simulation.variety import draw_variety, picture

VALIDATION_EVERY = 8
"""Every eighth picture is held back for validation."""
JPEG_QUALITY = 90


def write_scene(folder: Path, seed: int, index: int) -> str:
    """Writes picture ``index`` of a seed with its labels below ``folder``; gives its id."""
    rng = np.random.default_rng([seed, index])
    shown, _ = picture(draw_variety(rng), rng)
    identifier = f"{seed:04d}_{index:05d}"
    _write(
        folder / "images" / f"{identifier}.jpg",
        shown.image.pixels,
        [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY],
    )
    _write(folder / "labels" / f"{identifier}.png", shown.labels, [])
    return identifier


def write_scenes(folder: Path, count: int, seed: int, workers: int) -> None:
    """Writes a whole set; ``set.json`` comes last, so that a broken run is not taken for a set.

    Args:
        folder: Of the set; made where it is missing.
        count: Pictures.
        seed: Of the first draw.
        workers: Processes.
    """
    try:
        for name in ("images", "labels"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            identifiers = list(
                pool.map(write_scene, [folder] * count, [seed] * count, range(count), chunksize=2)
            )
        said = {
            "source": "simulated streets (calibwatch)",
            "licence": "Apache-2.0",
            "labelled_classes": list(range(len(labels.NAMES))),
            "unlabelled_notes": "all classes, exact; people, pavement, kerbs, wires are 0, trunks 6, fences "
            "with their stakes 5; 255 on the own bonnet and on paint worn by two thirds or more",
            "cameras": "drawn: twelve image sizes, focal length 0.45 to 2.2 widths, some with distortion",
            "splits": {
                "train": [name for k, name in enumerate(identifiers) if k % VALIDATION_EVERY],
                "val": identifiers[::VALIDATION_EVERY],
            },
        }
        partial = folder / "set.json.partial"
        partial.write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")
        partial.replace(folder / "set.json")
    except OSError as error:
        raise InputError(
            f"{folder}: {error.strerror or error}", hint="give a folder that can be written"
        ) from error


def _write(path: Path, pixels: np.ndarray, options: list[int]) -> None:
    written, data = cv2.imencode(path.suffix, pixels, options)
    if not written:
        raise InputError(f"{path.name}: the picture can not be encoded")
    path.write_bytes(data.tobytes())


@click.command(help="Write labelled pictures of simulated streets as one set of the training folder.")
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder of the set."
)
@click.option("--count", required=True, type=click.IntRange(min=1), help="Pictures.")
@click.option("--seed", default=1, show_default=True, type=click.IntRange(min=0), help="Of the first draw.")
@click.option(
    "--workers", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(min=1), help="Processes."
)
def main(out: Path, count: int, seed: int, workers: int) -> None:
    """Command line."""
    try:
        write_scenes(out, count, seed, workers)
    except CalibwatchError as error:
        raise click.ClickException(str(error)) from error
    click.echo(out)


if __name__ == "__main__":
    main()

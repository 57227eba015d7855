"""Labelled sets for tests, written file by file."""

import json

import cv2


def write_set(folder, pairs, **said):
    """A set of ``pairs`` of a picture (H,W,3) and a label (H,W); ids are p0, p1, ...; all are in ``val``."""
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True)
    for index, (picture, label) in enumerate(pairs):
        assert cv2.imwrite(str(folder / "images" / f"p{index}.png"), picture)
        assert cv2.imwrite(str(folder / "labels" / f"p{index}.png"), label)
    ids = [f"p{index}" for index in range(len(pairs))]
    described = {"labelled_classes": list(range(9)), "splits": {"val": ids}} | said
    (folder / "set.json").write_text(json.dumps(described))
    return folder

"""Draws docs/drift.png from the folder of a demo: ``python docs/drift_picture.py out/demo docs/drift.png``.

Left: the LiDAR edges under the stored extrinsic; right: under the estimated one; below: the yaw
that the monitor tells over time.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from monitor.daemon import mount_of
from monitor.intake import Intake
from monitor.messages import Message
from monitor.preparation import prepare
from monitor.sources import open_source
from pipeline import cameras, se3
from pipeline.edge_parameters import EdgeParameters
from pipeline.edges import find_edges
from pipeline.ground import fit_ground
from pipeline.mount import Mount
from pipeline.records import Floats, FramePair

ORANGE, BLUE, GREY, RED, INK = (0, 120, 255), (255, 150, 0), (170, 170, 170), (60, 60, 220), (60, 50, 40)
CROP = (470, 90, 480, 190)
"""Left, top, width, height of the part of the image that is shown, px: poles and facades."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


def main() -> None:
    """Reads the demo's files and writes the picture."""
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    statuses = [json.loads(line) for line in (folder / "status.jsonl").read_text().splitlines()]
    last = statuses[-1]
    rig = prepare(str(folder / "drive.mcap"), folder / "rig.toml", None).rig
    mount = mount_of(rig.pairs[0])
    pair = _frame(folder, Intake(rig))
    drift = np.array(
        [last["drift"][axis]["value"] for axis in ("roll", "pitch", "yaw", "forward", "left", "up")]
    )
    drift[:3] = np.radians(drift[:3])
    estimated = se3.displaced(mount.T_cam_lidar, drift, mount.R_vehicle_cam)
    tiles = [
        _tile(pair, mount, mount.T_cam_lidar, ORANGE, "stored extrinsic"),
        _tile(pair, mount, estimated, BLUE, "estimated while driving"),
    ]
    top = cv2.hconcat([tiles[0], np.full((tiles[0].shape[0], 8, 3), 255, np.uint8), tiles[1]])
    picture = cv2.vconcat([top, _plot(statuses, top.shape[1])])
    if not cv2.imwrite(str(out), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise SystemExit(f"{out} can not be written")


def _frame(folder: Path, intake: Intake) -> FramePair:
    """The last pair of the drive."""
    pairs: list[FramePair] = []
    with open_source(str(folder / "drive.mcap")) as source:
        for message in source:
            if isinstance(message, Message):
                pairs = intake.take(message) or pairs
    return pairs[-1]


def _tile(pair: FramePair, mount: Mount, T: Floats, colour: tuple[int, int, int], title: str) -> np.ndarray:
    """A crop of the image with the cloud's edges under an extrinsic."""
    ground = fit_ground(pair.cloud, mount.up, np.random.default_rng(0))
    edges = find_edges(pair.cloud, ground, mount.camera, mount.T_cam_lidar, EdgeParameters())
    assert edges is not None
    uv, valid = cameras.project(mount.camera, se3.apply(T, edges.position))
    left, top, width, height = CROP
    scale = 2
    tile = cv2.resize(
        pair.image.pixels[top : top + height, left : left + width],
        None,
        fx=scale,
        fy=scale,
        interpolation=cv2.INTER_CUBIC,
    )
    for u, v in uv[valid]:
        cv2.circle(tile, (round((u - left) * scale), round((v - top) * scale)), 3, colour, -1, cv2.LINE_AA)
    cv2.rectangle(tile, (0, 0), (420, 40), (255, 255, 255), -1)
    cv2.putText(tile, title, (10, 29), FONT, 0.8, colour, 2, cv2.LINE_AA)
    return tile


def _plot(statuses: list[dict], width: int) -> np.ndarray:
    """Yaw over time with its limit, and the states as a strip."""
    height, margin = 240, 90
    plot = np.full((height, width, 3), 255, np.uint8)
    begun = statuses[0]["stamp_ns"]
    seconds = [(s["stamp_ns"] - begun) / 1e9 for s in statuses]
    limit = statuses[0]["drift"]["yaw"]["alert_limit"]

    def at(t: float, yaw: float) -> tuple[int, int]:
        x = margin + (width - 2 * margin) * t / seconds[-1]
        return round(x), round(150 - 110 * yaw / (1.3 * limit))

    for level, colour in ((0.0, GREY), (limit, RED)):
        cv2.line(plot, at(0, level), at(seconds[-1], level), colour, 1, cv2.LINE_AA)
        cv2.putText(plot, f"{level:.1f}", (margin - 45, at(0, level)[1] + 5), FONT, 0.5, INK, 1, cv2.LINE_AA)
    told = [(t, s["drift"]["yaw"]["value"]) for t, s in zip(seconds, statuses, strict=True)]
    points = np.array([at(t, yaw) for t, yaw in told if yaw is not None], np.int32)
    cv2.polylines(plot, [points], isClosed=False, color=BLUE, thickness=3, lineType=cv2.LINE_AA)
    colours = {"healthy": (90, 150, 40), "suspect": (0, 140, 230), "drifted": (50, 50, 210)}
    for index, status in enumerate(statuses):
        ahead = seconds[index + 1] if index + 1 < len(seconds) else seconds[-1]
        colour = colours.get(status["state"], (150, 140, 130))
        cv2.rectangle(plot, (at(seconds[index], 0)[0], 180), (at(ahead, 0)[0], 200), colour, -1)
    for status, t in zip(statuses, seconds, strict=True):
        if status["since_ns"] == status["stamp_ns"]:
            cv2.putText(plot, status["state"], (at(t, 0)[0] + 2, 222), FONT, 0.5, INK, 1, cv2.LINE_AA)
    cv2.putText(
        plot,
        "yaw drift (deg), told while driving; red: alert limit",
        (margin, 22),
        FONT,
        0.6,
        INK,
        1,
        cv2.LINE_AA,
    )
    return plot


if __name__ == "__main__":
    main()

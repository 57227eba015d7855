"""KITTI: ``calib_velo_to_cam.txt`` with ``calib_cam_to_cam.txt`` beside it, and benchmarks' ``calib.txt``.

The extrinsic is that of the rectified left colour camera (02): points go into camera 00, are turned by its
rectifying rotation, and move into camera 02 by the fourth column of its projection matrix.
"""

from collections.abc import Mapping

import numpy as np

from monitor.extrinsic_formats import (
    Choice,
    Document,
    Format,
    Reading,
    defined,
    directed,
    keyed_rows,
    load_document,
    rigid,
)
from monitor.sources.kitti_raw import kitti_document
from pipeline.errors import InputError
from pipeline.records import Floats

CAMERAS, LIDAR = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
_ROWS = (("R0_rect", "Tr_velo_to_cam"), ("R_rect", "Tr_velo_cam"))
"""Names of the rectifying rotation and of the motion, by release of the object benchmark."""


class Kitti:
    """KITTI's text files."""

    name = "kitti"
    title = "KITTI calib_velo_to_cam.txt with calib_cam_to_cam.txt, or calib.txt"

    def matches(self, document: Document) -> bool:
        """Rows R and T of the pair of files, or P2 of the single one."""
        rows = keyed_rows(document.text)
        return "P2" in rows or "P_rect_02" in rows or ({"R", "T"} <= rows.keys() and rows["R"].size == 9)

    def read(self, document: Document, choice: Choice) -> Reading:
        """Composes the motion into camera 02; the size of images is in ``calib_cam_to_cam.txt`` alone."""
        rows = keyed_rows(document.text)
        size = choice.size
        if "P2" in rows:
            cameras, lidar = _single(rows, str(document.path))
            cameras["S_rect_02"] = np.array(size or (1, 1), dtype=np.float64)
            why = "velodyne to camera, shifted into camera 02 by P2"
        else:
            cameras, lidar = _two_files(document)
            size = tuple(cameras["S_rect_02"].astype(int).tolist()) if "S_rect_02" in cameras else size
            why = "velodyne to camera 00, rectified by R_rect_00, shifted into camera 02 by P_rect_02"
        rig = kitti_document(cameras, lidar, where=str(document.path))
        pair = rig["pairs"][0] if isinstance(rig["pairs"], list) else {}
        direction = defined(choice, "T_cam_lidar", why)
        T, read_as = directed(rigid(pair["extrinsic"]["T_cam_lidar"], "the composed motion"), direction, why)
        if size is None:
            note = (
                "K is left out, for the file does not tell the size of the images: give --size WIDTHxHEIGHT"
            )
            return Reading(T, read_as, name="image_02", notes=(note,))
        return Reading(
            T, read_as, camera={k: v for k, v in pair["camera"].items() if k != "topic"}, name="image_02"
        )


def _two_files(document: Document) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Rows of both files of a drive's day, whichever was named."""
    rows = keyed_rows(document.text)
    other = CAMERAS if "P_rect_02" not in rows else LIDAR
    path = document.path.with_name(other)
    if not path.is_file():
        raise InputError(f"{document.path} needs {other} beside it", hint="KITTI's day folder has both")
    beside = keyed_rows(load_document(path).text)
    return (beside, rows) if other == CAMERAS else (rows, beside)


def _single(rows: Mapping[str, Floats], where: str) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Rows of ``calib.txt`` under the names of the two files; odometry's Tr is rectified already."""
    named = next((names for names in _ROWS if set(names) <= rows.keys()), None)
    if named is not None:
        R_rect, Tr = rows[named[0]], rows[named[1]]
    elif "Tr" in rows:
        R_rect, Tr = np.eye(3).reshape(-1), rows["Tr"]
    else:
        raise InputError(
            f"{where} has no Tr_velo_to_cam and no Tr", hint="without them it states cameras only"
        )
    if Tr.size != 12:
        raise InputError(f"{where}: the motion has {Tr.size} numbers, not 12")
    Tr = Tr.reshape(3, 4)
    lidar = {"R": Tr[:, :3].reshape(-1), "T": Tr[:, 3]}
    return {"P_rect_02": rows["P2"], "R_rect_00": R_rect}, lidar


FORMAT: Format = Kitti()

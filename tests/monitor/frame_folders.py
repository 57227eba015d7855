"""Folders with ``calib.json`` around small simulated frames."""

import dataclasses
import json
from functools import cache

import cv2
import numpy as np

from pipeline.simulation.drive import Drive
from tests.drives import PARAMETERS


@cache
def _drive():
    return Drive(dataclasses.replace(PARAMETERS, drift_time=np.inf))


@cache
def frame(index=0):
    """A frame of the short drive, with its true extrinsic."""
    return _drive().frame(index)


def calib(**changed):
    """What ``calib.json`` says of them; keywords replace keys, None leaves them out."""
    camera = PARAMETERS.camera
    document = {
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "distortion_model": "none",
            "D": [],
        },
        "T_cam_lidar": PARAMETERS.T_stored.tolist(),
        "T_vehicle_lidar": PARAMETERS.T_vehicle_lidar.tolist(),
    }
    return {key: value for key, value in (document | changed).items() if value is not None}


def write_frames(folder, count=1, **changed):
    """A folder of the first frames; of several, ``calib.json`` lists them."""
    folder.mkdir(parents=True)
    listed = []
    for index in range(count):
        stem = "" if count == 1 else f"_{index}"
        cloud, image = f"cloud{stem}.npz", f"image{stem}.png"
        c = frame(index).cloud
        np.savez(folder / cloud, xyz=c.xyz, intensity=c.intensity, ring=c.ring.astype(np.uint8), time=c.time)
        cv2.imwrite(str(folder / image), frame(index).image.pixels)
        listed.append({"image": image, "cloud": cloud})
    document = calib(**changed)
    if count > 1:
        document["frames"] = listed
    (folder / "calib.json").write_text(json.dumps(document))
    return folder

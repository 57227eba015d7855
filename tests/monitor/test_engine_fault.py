"""A stream of frames that are of no use is told as a fault, and ends as one."""

import numpy as np

from monitor.clock import SystemClock
from monitor.engine import Engine
from monitor.intake import Intake
from monitor.rig import parse_rig
from monitor.statements import Identity
from monitor.status import Provenance
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import CameraImage, CameraModel, FramePair, PointCloud
from pipeline.watch import Watch

CAMERA = CameraModel("pinhole", np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), np.zeros(0), 64, 48)
FORWARD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def engine():
    rig = parse_rig({"pairs": [{"name": "front"}]}, where="test")
    mount = Mount(CAMERA, FORWARD, None, 0.002, 0.02, np.ones(6), ("yaw",))
    nothing = Provenance(hash=None, version=None)
    identity = Identity("v", "front", nothing, nothing, "test")
    return Engine(identity, Watch(mount, Parameters(), None), Intake(rig), SystemClock())


def pair(index, width):
    cloud = PointCloud(np.ones((5, 3), dtype=np.float32))
    image = CameraImage(np.zeros((48, width, 3), dtype=np.uint8))
    return FramePair("front", cloud, image, index * 10**8, index * 10**8)


def states(events):
    return [event.status.state for event in events if hasattr(event, "status")]


def test_images_of_another_size_become_a_fault_that_names_both_sizes():
    under_test = engine()
    told = [s for i in range(1, 11) for s in states(under_test.step(pair(i, 80), i * 10**8))]
    assert told[-1] == "fault"
    assert "80x48" in under_test.watch.memory.reason
    assert "64x48" in under_test.watch.memory.reason
    assert states(under_test.finish()) == ["fault"]


def test_a_few_bad_frames_are_a_drop_and_no_fault():
    under_test = engine()
    told = [s for i in range(1, 6) for s in states(under_test.step(pair(i, 80), i * 10**8))]
    assert "fault" not in told
    assert under_test.dropped["image_size"] == 10

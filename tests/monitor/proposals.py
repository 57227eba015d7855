"""A proposed extrinsic, as an engine gives it."""

import numpy as np

from monitor.candidate_file import document_of
from monitor.events import ProposalEvent
from monitor.statements import Identity
from monitor.status import Provenance
from pipeline import se3
from pipeline.candidate import Candidate, WindowEstimate
from pipeline.hold_out import HoldOut
from pipeline.mount import Mount
from pipeline.records import CameraModel

NONE = Provenance(hash=None, version=None)
MOUNT = Mount(
    camera=CameraModel("pinhole", np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), np.empty(0), 160, 120),
    T_cam_lidar=se3.transform(se3.AXES_CAM_IN_VEHICLE.T, np.zeros(3)),
    T_vehicle_lidar=np.eye(4),
    sigma_rad=0.001,
    sigma_m=0.01,
    limits=np.ones(6),
    required=("yaw",),
)


def proposal(pair="front", lines=None, windows=1):
    drift = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
    T = se3.displaced(MOUNT.T_cam_lidar, drift, MOUNT.R_vehicle_cam)
    p_lines, stored, found = lines or (None, None, None)
    check = HoldOut(10, 20, 8, 31.5, 50, 0.25, 0.41, 0.42, 1e-4, 0.3, p_lines, stored, found, None)
    seen = tuple(WindowEstimate(i, i, 30.0 * i, 30.0 * i, 8, np.zeros(6), np.eye(6)) for i in range(windows))
    candidate = Candidate(20, T, 1e-4 * np.eye(6), seen, agreed=windows >= 3, hold_out=check)
    return ProposalEvent(pair, document_of(Identity("van-17", pair, NONE, NONE, "test"), MOUNT, candidate))

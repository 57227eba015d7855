"""Trials of the verdict: which thing is made wrong about a drive whose extrinsic is known, and by how much.

One thing at a time: the stored extrinsic, its constancy, the stamps, the intrinsics, or nothing. What a trial
does to the drive stands in :mod:`pipeline.staging`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np

from pipeline import se3
from pipeline.mount import Mount
from pipeline.records import AXES, Floats, read_only

Kind: TypeAlias = Literal[
    "healthy",
    "combined",
    "single",
    "compensating",
    "ramp",
    "vibration",
    "time-offset",
    "focal",
    "offline",
    "slip",
]
KINDS: tuple[Kind, ...] = get_args(Kind)

SINGLE_DEG = (0.1, 0.25, 0.5, 1.0, 2.0)
SINGLE_M = (0.01, 0.05, 0.10, 0.20)
"""Steps along one axis."""

PAIR_RANGE_M = 20.0
"""m; compensating pairs leave the bearing at this range as it was (PROBE 3)."""
PAIR_DEG = (0.25, 0.5, 1.0)
"""Angle of a compensating pair; its shift follows from the range."""

COMBINED_DEG = (0.5, 1.2)
COMBINED_M = (0.1, 0.2)
"""Of a wrong extrinsic: turn about a random axis, and shift of the camera in a random direction (PROBE 5)."""

RAMP_DEG = (0.25, 0.5, 1.0)
"""Turn that has grown evenly by the end of the drive."""

SLIP_DEG = (0.1, 0.25, 0.5)
SLIP_M = (0.05, 0.10, 0.20)
"""Steps along one axis of a mount that held until then."""
SLIPS_AFTER = (2, 3)
"""Share of a drive, so that one of two seconds shows the mount in its place before, and some frames after."""

SHAKE_DEG = (0.1, 0.2, 0.4)
"""Root mean square angle of a camera that shakes faster than frames follow each other."""

LATE_MS = (10, 20, 50, 100)
"""By which images bear wrong stamps."""

FOCAL_SHARE = (0.005, 0.01, 0.02)
"""By which the stored focal length is wrong."""

OFFLINE_DEG = (1.0, 3.0, 5.0)
OFFLINE_M = 0.05
"""Turn about, and shift along, each axis of the camera: the table of a published offline check."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What is made wrong in one run.

    Attributes:
        kind: Of trial.
        label: Which amount, for the tables; trials of one label are alike.
        number: Among the trials of this kind.
        drift: float64 (6,), vehicle axes, rad and m: motion of the mount since the extrinsic was
            stored, at the end of the drive.
        ramp: Whether the drift grows evenly over the drive.
        slips: Whether it comes at once, at two thirds of the drive. Else it is there from the first frame on.
        shake_rad: Root mean square angle by which the camera shakes, rad.
        late_ns: Images bear stamps that are later by so much, ns.
        focal: The stored focal length is so many times the true one.
    """

    kind: Kind
    label: str
    number: int
    drift: Floats
    ramp: bool = False
    slips: bool = False
    shake_rad: float = 0.0
    late_ns: int = 0
    focal: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "drift", read_only(self.drift))

    @property
    def moves(self) -> bool:
        """Whether the mount moves during the drive."""
        return self.ramp or self.slips

    def share(self, frame: int, frames: int) -> float:
        """How much of the drift is there at a frame, of so many."""
        if self.ramp:
            return frame / max(frames - 1, 1)
        return float(frame >= self.first_wrong(frames))

    def first_wrong(self, frames: int) -> int:
        """The first frame, of so many, in which anything is wrong."""
        part, whole = SLIPS_AFTER
        return frames * part // whole if self.slips else 0


_Draw: TypeAlias = Callable[[Mount, np.random.Generator], dict[str, object]]
"""The fields of a trial other than kind, label and number."""


def count(kind: Kind, runs: int) -> int:
    """How many trials there are of a kind when at least ``runs`` are wanted: of every label equally many."""
    labels = len(_CELLS[kind])
    return math.ceil(runs / labels) * labels


def labels_of(kind: Kind) -> tuple[str, ...]:
    """The labels of a kind, in the order of the tables."""
    return tuple(_CELLS[kind])


def draw(kind: Kind, number: int, true: Mount, rng: np.random.Generator) -> Trial:
    """Trial ``number`` of a kind.

    Args:
        kind: Of trial.
        number: From 0; labels take turns.
        true: The mount with its true extrinsic.
        rng: Of this trial.
    """
    label = labels_of(kind)[number % len(_CELLS[kind])]
    fields = {"drift": np.zeros(6)} | _CELLS[kind][label](true, rng)
    return Trial(kind, label, number, **fields)  # type: ignore[arg-type]  # the draws below give its fields


def direction(rng: np.random.Generator) -> Floats:
    """Unit vector (3,), every direction equally likely."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v), dtype=np.float64)


def _healthy(true: Mount, rng: np.random.Generator) -> dict[str, object]:
    del true, rng
    return {}


def _combined(true: Mount, rng: np.random.Generator) -> dict[str, object]:
    """Turned about a random axis and moved in a random direction."""
    turn = direction(rng) * math.radians(rng.uniform(*COMBINED_DEG))
    return {"drift": _moved(true, turn, direction(rng) * rng.uniform(*COMBINED_M))}


def _moved(true: Mount, turn: Floats, shift: Floats) -> Floats:
    """Drift (6,) since an extrinsic that was off the true one.

    Args:
        true: The mount with its true extrinsic.
        turn: float64 (3,), rotation vector, rad, camera axes.
        shift: float64 (3,), of the camera centre, m, camera axes.
    """
    R = true.T_cam_lidar[:3, :3]
    centre = -R.T @ true.T_cam_lidar[:3, 3] + R.T @ shift
    R_stored = se3.exp_so3(turn) @ R
    stored = se3.transform(R_stored, -R_stored @ centre)
    R_vehicle_cam = se3.vehicle_axes(stored, true.T_vehicle_lidar)
    return se3.mount_drift(stored, true.T_cam_lidar, R_vehicle_cam)


def _constant(**fields: object) -> _Draw:
    def give(true: Mount, rng: np.random.Generator) -> dict[str, object]:
        del true, rng
        return dict(fields)

    return give


def _one_axis() -> dict[str, _Draw]:
    cells: dict[str, _Draw] = {}
    for axis, name in enumerate(AXES):
        for amount in SINGLE_DEG if axis < 3 else SINGLE_M:
            for sign in (1.0, -1.0):
                drift = np.zeros(6)
                drift[axis] = sign * (math.radians(amount) if axis < 3 else amount)
                cells[f"{name} {sign * amount:+g} {'deg' if axis < 3 else 'm'}"] = _constant(drift=drift)
    return cells


def _pairs() -> dict[str, _Draw]:
    cells: dict[str, _Draw] = {}
    for angle, shift, slope in (("pitch", "up", 1.0), ("yaw", "left", -1.0)):
        for amount in PAIR_DEG:
            for sign in (1.0, -1.0):
                drift = np.zeros(6)
                drift[AXES.index(angle)] = sign * math.radians(amount)
                drift[AXES.index(shift)] = slope * PAIR_RANGE_M * sign * math.radians(amount)
                metres = drift[AXES.index(shift)]
                cells[f"{angle} {sign * amount:+g} deg, {shift} {metres:+.3f} m"] = _constant(drift=drift)
    return cells


def _ramps() -> dict[str, _Draw]:
    def ramp(amount: float) -> _Draw:
        def give(true: Mount, rng: np.random.Generator) -> dict[str, object]:
            del true
            drift = np.zeros(6)
            drift[int(rng.integers(3))] = rng.choice((-1.0, 1.0)) * math.radians(amount)
            return {"drift": drift, "ramp": True}

        return give

    return {f"{amount:g} deg by the end": ramp(amount) for amount in RAMP_DEG}


def _slips() -> dict[str, _Draw]:
    def slip(axis: int, amount: float) -> _Draw:
        def give(true: Mount, rng: np.random.Generator) -> dict[str, object]:
            del true
            return {"drift": rng.choice((-1.0, 1.0)) * amount * np.eye(6)[axis], "slips": True}

        return give

    return {
        f"{name} {amount:g} {unit}": slip(axis, math.radians(amount) if axis < 3 else amount)
        for axis, name in enumerate(AXES)
        for unit, amounts in (("deg", SLIP_DEG) if axis < 3 else ("m", SLIP_M),)
        for amount in amounts
    }


def _offline() -> dict[str, _Draw]:
    def wrong(axis: int, turn_deg: float, shift_m: float) -> _Draw:
        def give(true: Mount, rng: np.random.Generator) -> dict[str, object]:
            along = float(rng.choice((-1.0, 1.0))) * np.eye(3)[axis]
            return {"drift": _moved(true, math.radians(turn_deg) * along, shift_m * along)}

        return give

    cells = {
        f"about {name} {deg:g} deg": wrong(axis, deg, 0.0)
        for axis, name in enumerate("xyz")
        for deg in OFFLINE_DEG
    }
    return cells | {
        f"along {name} {OFFLINE_M:g} m": wrong(axis, 0.0, OFFLINE_M) for axis, name in enumerate("xyz")
    }


_CELLS: Mapping[Kind, Mapping[str, _Draw]] = {
    "healthy": {"nothing": _healthy},
    "combined": {"all axes": _combined},
    "single": _one_axis(),
    "compensating": _pairs(),
    "ramp": _ramps(),
    "vibration": {f"{deg:g} deg rms": _constant(shake_rad=math.radians(deg)) for deg in SHAKE_DEG},
    "time-offset": {
        f"{sign * ms:+d} ms": _constant(late_ns=sign * ms * 1_000_000) for ms in LATE_MS for sign in (1, -1)
    },
    "focal": {
        f"{100 * sign * share:+g} %": _constant(focal=1.0 + sign * share)
        for share in FOCAL_SHARE
        for sign in (1, -1)
    },
    "offline": _offline(),
    "slip": _slips(),
}
"""Label -> what it draws, of each kind."""

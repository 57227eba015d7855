"""The status of one pair, ``calibwatch.status/1`` (DESIGN 5): what goes on the bus, into files and to people.

Every number is finite or null. Angles are degrees, lengths metres, stamps integer nanoseconds of the data's
clock. ``status.schema.json`` beside this file is what :func:`json_schema` gives; a test holds them together.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Annotated, Any, Literal, TypeAlias, get_args

from pydantic import Field, FiniteFloat, NonNegativeInt, StringConstraints

from monitor.document import DocumentPart

SCHEMA: Literal["calibwatch.status/1"] = "calibwatch.status/1"

State: TypeAlias = Literal["starting", "healthy", "suspect", "drifted", "unobservable", "stale", "fault"]
"""The states of DESIGN 4."""

STATES: tuple[State, ...] = get_args(State)

PRECEDENCE: tuple[State, ...] = (
    "fault",
    "stale",
    "drifted",
    "suspect",
    "unobservable",
    "healthy",
    "starting",
)
"""The first of these that any pair is in speaks for all pairs."""

EXIT_CODES: dict[State, int] = {
    "healthy": 0,
    "fault": 1,
    "drifted": 3,
    "suspect": 4,
    "unobservable": 4,
    "stale": 4,
    "starting": 4,
}
"""Exit code of a command whose answer is this state (DESIGN 7): what reads 0 never reads green by default."""

AxisName: TypeAlias = Literal["roll", "pitch", "yaw", "forward", "left", "up"]

AXIS_NAMES: tuple[AxisName, ...] = get_args(AxisName)
"""The six axes in the order of ``pipeline.records.AXES``."""

Name: TypeAlias = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
"""Vehicle or pair: one chunk of a key."""

Code: TypeAlias = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
"""A word of a closed list: the code of a state, the reason of a drop, the name of a stage."""

NonNegative: TypeAlias = Annotated[FiniteFloat, Field(ge=0)]


def finite(value: float) -> float | None:
    """``value``, or None where it is infinite or not a number: how inf and NaN are told in a status."""
    return float(value) if math.isfinite(value) else None


def unit_of(axis: AxisName) -> Literal["deg", "m"]:
    """Unit in which a status tells this axis."""
    return "deg" if axis in ("roll", "pitch", "yaw") else "m"


def first_in_precedence(states: Iterable[State]) -> State:
    """The state that speaks for all pairs; 'starting' where there is none."""
    present = set(states)
    return next((state for state in PRECEDENCE if state in present), "starting")


def exit_code(state: State) -> int:
    """Exit code of a command whose answer is ``state``."""
    return EXIT_CODES[state]


class Onset(DocumentPart):
    """Since when the drift is there: most likely stamp and interval."""

    stamp_ns: int = Field(description="most likely; from_ns where nothing before was surely free of it")
    from_ns: int = Field(description="not before: the interval holds the beginning with 95 %")
    to_ns: int = Field(description="not after")
    gradual: bool = Field(default=False, description="it grew rather than jumped; the first growth is told")


class AxisDrift(DocumentPart):
    """Drift along one axis. Degrees for roll, pitch, yaw; metres for forward, left, up."""

    value: FiniteFloat | None = Field(description="estimated drift; null while nothing is known")
    sigma: NonNegative | None = Field(description="standard deviation of the value; null where held")
    protection_level: NonNegative | None = Field(
        description="no drift beyond this is missed at the stated risk; null: no bound"
    )
    alert_limit: Annotated[FiniteFloat, Field(gt=0)] = Field(
        description="drift that matters to this vehicle's perception"
    )
    detectable: NonNegative | None = Field(
        description="smallest drift that would have been noticed; null: none"
    )
    observable: bool = Field(description="sigma is at most two alert limits")
    monitored: bool = Field(description="the protection level is at or below the alert limit")
    last_seen_ns: int | None = Field(description="stamp at which the axis was last observable")


class Drift(DocumentPart):
    """Motion of the camera mount since the extrinsic was stored.

    Signs: +yaw turns left, +pitch nose down, +roll right side down; forward, left, up of the camera centre.
    """

    axes: Literal["vehicle", "camera"] = Field(
        description="vehicle: x forward, y left, z up; camera: the stored camera's own axes, renamed"
    )
    relative_to: Literal["stored", "baseline"] = Field(
        description="the stored extrinsic, or that plus the rig's own bias that a baseline learned"
    )
    roll: AxisDrift
    pitch: AxisDrift
    yaw: AxisDrift
    forward: AxisDrift
    left: AxisDrift
    up: AxisDrift

    def items(self) -> Iterator[tuple[AxisName, AxisDrift]]:
        """The six axes by name, in order."""
        for name in AXIS_NAMES:
            yield name, self[name]

    def __getitem__(self, name: AxisName) -> AxisDrift:
        axis: AxisDrift = getattr(self, name)
        return axis


class Consequence(DocumentPart):
    """What the drift does at one distance from the camera; null where nothing projects."""

    range_m: NonNegative
    shift_px: NonNegative | None = Field(description="how far a point on the optical axis moves in the image")
    sigma_px: NonNegative | None = Field(description="standard deviation of its place, largest direction")
    worst_px: NonNegative | None = Field(description="largest move of a point anywhere in the image")
    left_m: FiniteFloat = Field(
        description="how far left of where the stored extrinsic puts it a thing on the optical axis stands"
    )
    sigma_left_m: NonNegative
    up_m: FiniteFloat = Field(description="how far above, likewise")
    sigma_up_m: NonNegative


class AxisValues(DocumentPart):
    """One number per axis, degrees and metres."""

    roll: FiniteFloat | None
    pitch: FiniteFloat | None
    yaw: FiniteFloat | None
    forward: FiniteFloat | None
    left: FiniteFloat | None
    up: FiniteFloat | None


class Witness(DocumentPart):
    """What one witness alone says."""

    drift: AxisValues
    sigma: AxisValues
    chi2: NonNegative | None = Field(description="residual statistic per degree of freedom; 1 fits")
    frames: NonNegativeInt


class Witnesses(DocumentPart):
    """The two witnesses; null where one has said nothing."""

    lines: Witness | None
    edges: Witness | None


class Drive(DocumentPart):
    """Where the mount is by all scenes of the drive, a wandering one followed."""

    scenes: NonNegativeInt = Field(description="stretches of road that share no frame, heard so far")
    drift: AxisValues
    sigma: AxisValues = Field(description="standard deviation, what scenes differ by included")


class Window(DocumentPart):
    """Evidence on which the present verdict rests."""

    frames: NonNegativeInt
    span_s: NonNegative
    lines_lane: NonNegativeInt
    lines_pole: NonNegativeInt
    lines_structure: NonNegativeInt
    left: dict[Code, NonNegativeInt] = Field(
        default_factory=dict,
        description="reason -> frames that left the window since the start: past, aged, repeats, adds_least",
    )


class Frames(DocumentPart):
    """The account of every frame since the start: received = used + dropped + under way."""

    received: NonNegativeInt
    used: NonNegativeInt
    dropped: dict[Code, NonNegativeInt] = Field(description="reason -> number")


class Rates(DocumentPart):
    """Rates of the inputs and of the two witnesses, over the window."""

    lidar_hz: NonNegative | None
    camera_hz: NonNegative | None
    gap_ms: FiniteFloat | None = Field(description="median of image stamp minus cloud stamp")
    lines_hz: NonNegative | None = Field(default=None, description="frames that got masks and lines")
    edges_hz: NonNegative | None = Field(default=None, description="frames that got edges")


class TimeOffset(DocumentPart):
    """Offset between the clocks of the two sensors."""

    ms: FiniteFloat | None = Field(
        description="the camera exposes so much later than its stamp says; null: not told from a drift"
    )
    sigma_ms: NonNegative | None
    separable: bool = Field(description="the motion allows telling it from yaw and forward drift")


class Timing(DocumentPart):
    """Quantiles of the time one stage takes, ms."""

    p50: NonNegative
    p95: NonNegative


class Provenance(DocumentPart):
    """Which extrinsic or model: content hash and version; null where there is none."""

    hash: str | None
    version: str | None


class Status(DocumentPart):
    """One status of one pair: once a second, and at each change."""

    schema_: Literal["calibwatch.status/1"] = Field(default=SCHEMA, alias="schema")
    vehicle: Name
    pair: Name
    seq: NonNegativeInt = Field(description="grows by one with each status of the pair")
    stamp_ns: int
    state: State
    code: Code
    reason: str = Field(min_length=1, description="one sentence")
    since_ns: int = Field(description="stamp of the data at which the state was entered")
    onset: Onset | None
    severity: Literal["minor", "major"] | None
    drift: Drift
    consequence: tuple[Consequence, ...] = Field(
        default=(), description="what the drift does at several distances; none while nothing is known"
    )
    witnesses: Witnesses
    drive: Drive | None = Field(
        default=None,
        description="null before the first scene of a drive, and while a drift stands: what is followed is a "
        "mount that wanders, not one that has slipped",
    )
    window: Window
    frames: Frames
    rates: Rates
    time_offset: TimeOffset
    timing_ms: dict[Code, Timing] = Field(description="stage -> quantiles")
    extrinsic: Provenance
    model: Provenance
    software: str
    outputs_lost: dict[Code, str] = Field(
        default={}, description="output -> what happened: recording lost, disk full, ..."
    )
    warnings: tuple[str, ...] = Field(
        default=(), description="what the data say against the rig's settings, one sentence each"
    )

    def to_json(self) -> str:
        """One line of JSON."""
        return self.model_dump_json()


def json_schema() -> dict[str, Any]:
    """JSON schema of a status as it is written."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | Status.model_json_schema(
        mode="serialization"
    )

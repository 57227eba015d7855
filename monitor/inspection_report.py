"""The answer of ``calibwatch inspect``, ``calibwatch.inspection/1``: what a program reads with ``--json``."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

SCHEMA: Literal["calibwatch.inspection/1"] = "calibwatch.inspection/1"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, serialize_by_alias=True)


class Span(_Part):
    """Smallest and largest stamp, ns."""

    first_ns: int
    last_ns: int


class CloudReport(_Part):
    """What the first sweeps of a topic look like."""

    frame: str
    sweeps: int = Field(description="how many were decoded")
    points: tuple[int, int, int] = Field(description="least, median, most points per sweep")
    intensity: bool
    ring: bool = Field(description="a ring number per point")
    time: bool = Field(description="a time per point")
    rings: int | None = Field(description="rings in the first sweep; null: no scan pattern was found")
    sweep_s: float | None = Field(description="duration of a sweep by its times per point or its source, s")
    middle_ms: float | None = Field(
        description="middle of a sweep after its stamp; null: not known, sweeps are paired by their stamp"
    )


class ImageReport(_Part):
    """The first image of a topic, and the intrinsics that hold for it."""

    frame: str
    size: tuple[int, int] = Field(description="width, height, px")
    info: str | None = Field(description="topic of its CameraInfo")
    reading: str | None = Field(description="which intrinsics hold, and why; null: there are none")
    model: str | None
    K: list[list[float]] | None
    D: list[float] | None


class TopicReport(_Part):
    """One topic."""

    name: str
    type: str
    understood: bool
    count: int = Field(description="messages that were read")
    rate_hz: float | None = Field(description="by header stamps, else by log times")
    stamps: Span | None = Field(description="header stamps; null: its messages have none that is read")
    logged: Span | None = Field(description="when the source recorded its messages")
    nominal: bool = Field(description="a folder without stamps: they count files, ten a second")
    delay_ms: float | None = Field(
        description="median of log time minus header stamp; null where log times are the stamps"
    )
    backwards: int = Field(description="messages whose stamp is before that of the message before")
    undecodable: str | None = Field(description="why its first messages could not be decoded")
    cloud: CloudReport | None
    image: ImageReport | None


class Link(_Part):
    """One transform."""

    parent: str
    child: str
    static: bool


class PairReport(_Part):
    """One pair that can be watched."""

    name: str
    lidar: str
    camera: str
    how: str = Field(description="where topics, intrinsics and extrinsic come from")
    T_cam_lidar: list[list[float]]
    camera_at_m: list[float] = Field(description="camera centre in LiDAR axes, m")
    looks_along: list[float] = Field(description="viewing direction in LiDAR axes")
    vehicle_frame: bool = Field(description="drift is told in vehicle axes, else in the camera's own")
    sweeps: int
    images: int
    pairs: int = Field(description="sweep and image that go together by the rule of the rig")
    same_stamps: bool = Field(
        description="a folder whose images bear the stamps of the sweeps: no gap can be told"
    )
    gap_ms: float | None = Field(
        description="image stamp minus middle of the sweep (where that is null: its stamp), median of pairs"
    )
    nearest_ms: float | None = Field(description="the same over every image and the sweep nearest to it")
    clock_offset_ms: float | None = Field(
        description="camera clock ahead of LiDAR clock by log times, transport included; null: no log times"
    )
    in_view: tuple[int, int] | None = Field(description="points of the first sweep inside the image, of all")
    problems: tuple[str, ...] = Field(description="what will keep it from being judged, one sentence each")
    warnings: tuple[str, ...] = Field(
        default=(), description="what the data say against the rig's settings, one sentence each"
    )


class Inspection(_Part):
    """What a recording holds."""

    schema_: Literal["calibwatch.inspection/1"] = Field(default=SCHEMA, alias="schema")
    location: str
    kind: str = Field(description="kind of source")
    vehicle: str | None
    topics: tuple[TopicReport, ...]
    transforms: tuple[Link, ...]
    pairs: tuple[PairReport, ...]
    missing: tuple[str, ...] = Field(description="what stands in the way of further pairs, one sentence each")
    losses: dict[str, int] = Field(description="what the source could not give: reason -> number")
    notes: tuple[str, ...] = Field(description="what the source says of them")

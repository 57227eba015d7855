"""The rig that a recording carries in itself: pairs from CameraInfo and tf, without a rig file (DESIGN 3).

Frame ids are trusted as messages state them: the frame of an Image or CameraInfo is the optical frame,
whatever the directions of its tf look like.
"""

import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from monitor.messages import CameraInfo, Message, Transform, decode
from monitor.rig import (
    CameraInput,
    LidarInput,
    Rig,
    RigPair,
    camera_from_info,
    is_cloud,
    is_image,
    parse_rig,
)
from monitor.rig_document import NAME
from monitor.sources import Tick, TopicInfo
from pipeline.errors import CalibwatchError, InputError
from pipeline.records import CameraImage, Floats, PointCloud
from pipeline.se3 import inverse

VEHICLE_FRAMES = ("base_link", "base_footprint")
"""What the vehicle frame is called, in order of preference (REP-105)."""
INFO_TYPES = ("sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration")
TF_TYPES = (
    "tf2_msgs/msg/TFMessage",
    "tf/msg/tfMessage",
    "foxglove.FrameTransform",
    "foxglove.FrameTransforms",
)

_SURVEY_MESSAGES = 20_000
_SURVEY_NS = 30_000_000_000
"""ns of recording that are searched at most: latched transforms come at the start, cameras every 100 ms."""
_GENERIC = {
    "image",
    "image_raw",
    "image_color",
    "image_mono",
    "image_rect",
    "image_rect_color",
    "compressed",
    "raw",
}
"""Last chunks of topics that name no camera."""


@dataclass(slots=True)
class Survey:
    """What was seen at the beginning of a recording.

    Attributes:
        clouds: Frame id by topic.
        images: Frame id by topic, and the size of the first image (width, height) px.
        infos: Frame id and intrinsics by topic.
        transforms: By (parent, child); a static one wins over a changing one, then the latest.
        undecodable: Topic -> why, for topics whose first message could not be decoded.
    """

    clouds: dict[str, str] = field(default_factory=dict)
    images: dict[str, tuple[str, tuple[int, int]]] = field(default_factory=dict)
    infos: dict[str, tuple[str, CameraInfo]] = field(default_factory=dict)
    transforms: dict[tuple[str, str], Transform] = field(default_factory=dict)
    undecodable: dict[str, str] = field(default_factory=dict)

    def see(self, message: Message) -> bool:
        """Takes what is new in a message; tells whether anything was."""
        wanted = is_cloud(message.type) or is_image(message.type) or message.type in INFO_TYPES
        seen = message.topic in (
            self.clouds.keys() | self.images.keys() | self.infos.keys() | self.undecodable.keys()
        )
        if message.type not in TF_TYPES and (not wanted or seen):
            return False
        try:
            decoded = decode(message)
        except InputError as error:
            self.undecodable[message.topic] = error.what
            return True
        news = False
        for one in decoded:
            match one.value:
                case PointCloud():
                    self.clouds[message.topic] = one.frame
                case CameraImage(pixels=_) as image:
                    self.images[message.topic] = (one.frame, image.size)
                case CameraInfo() as info:
                    self.infos[message.topic] = (one.frame, info)
                case Transform() as transform:
                    news |= self._see_transform(transform)
                    continue
            news = True
        return news

    def info_of(self, image: str) -> str | None:
        """The CameraInfo topic that goes with an image topic, or None."""
        return _info_of(self, image) if image in self.images else None

    def _see_transform(self, transform: Transform) -> bool:
        link = (transform.parent, transform.child)
        before = self.transforms.get(link)
        if before is not None and before.static and not transform.static:
            return False
        self.transforms[link] = transform
        return before is None


@dataclass(frozen=True, slots=True, eq=False)
class Discovery:
    """What can be watched without a rig file.

    Attributes:
        rig: The rig, or None where no pair could be composed.
        missing: What stands in the way of further pairs, one sentence each.
        notes: How each pair came about, one sentence each.
    """

    rig: Rig | None
    missing: tuple[str, ...]
    notes: tuple[str, ...]


def survey_in(messages: Iterable[Message | Tick], topics: Sequence[TopicInfo]) -> Survey:
    """Reads the beginning of a recording until every cloud and image topic is part of a pair.

    Args:
        messages: The source, from its start.
        topics: What :meth:`~monitor.sources.Source.describe` tells.
    """
    survey = Survey()
    clouds = {topic.name for topic in topics if is_cloud(topic.type)}
    images = {topic.name for topic in topics if is_image(topic.type)}
    start_ns: int | None = None
    for message in itertools.islice(messages, _SURVEY_MESSAGES):
        if isinstance(message, Tick):
            continue
        start_ns = message.log_ns if start_ns is None else start_ns
        news = survey.see(message)
        if message.log_ns - start_ns > _SURVEY_NS:
            break
        # A broadcaster may send its transforms one by one: nothing is complete before all sensors were seen.
        all_seen = clouds | images <= survey.clouds.keys() | survey.images.keys() | survey.undecodable.keys()
        if news and all_seen and not discover(survey).missing:
            break
    return survey


def discover(survey: Survey) -> Discovery:
    """Pairs every cloud topic with every image topic whose frames tf connects."""
    missing = [
        f"topic {topic}: {why.removeprefix(f'topic {topic}: ')}"
        for topic, why in sorted(survey.undecodable.items())
    ]
    if not survey.clouds:
        missing.append("no topic with point clouds")
    if not survey.images:
        missing.append("no topic with images")
    if not survey.transforms:
        missing.append("no transforms (tf_static)")
    pairs: list[RigPair] = []
    notes: list[str] = []
    for image in _one_per_camera(survey):
        camera, why = _camera(survey, image)
        if camera is None:
            missing.append(why)
            continue
        for lidar, lidar_frame in sorted(survey.clouds.items()):
            chain = path(survey.transforms.values(), camera.frame, lidar_frame)
            if chain is None:
                missing.append(
                    f"no chain of transforms from {lidar_frame or '(no frame)'} of {lidar} "
                    f"to {camera.frame or '(no frame)'} of {image}"
                )
                continue
            name = _pair_name(image, lidar, many=len(survey.clouds) > 1, taken=[pair.name for pair in pairs])
            pairs.append(_pair(survey, name, (lidar, lidar_frame), camera, compose(chain)))
            notes.append(f"{name}: {lidar} with {image}, {why}; extrinsic from {_told(chain)}")
    rig = Rig(vehicle="vehicle", pairs=tuple(pairs)) if pairs else None
    return Discovery(rig, tuple(missing), tuple(notes))


Step = tuple[Transform, bool]
"""A transform and whether it is walked from parent to child (as stated) or back."""


def path(transforms: Iterable[Transform], target: str, source: str) -> tuple[Step, ...] | None:
    """The shortest chain of transforms that maps points of ``source`` into ``target``, or None.

    Static transforms alone are preferred; ROS 1 publishes fixed ones on /tf too, so changing ones are the
    second choice.
    """
    known = list(transforms)
    for usable in ([t for t in known if t.static], known):
        found = _shortest(usable, target, source)
        if found is not None:
            return found
    return None


def _shortest(transforms: Sequence[Transform], target: str, source: str) -> tuple[Step, ...] | None:
    links: dict[str, list[tuple[str, Step]]] = {}
    for transform in transforms:
        links.setdefault(transform.parent, []).append((transform.child, (transform, True)))
        links.setdefault(transform.child, []).append((transform.parent, (transform, False)))
    reached: dict[str, tuple[Step, ...]] = {target: ()}
    queue = deque([target])
    while queue:
        here = queue.popleft()
        if here == source:
            return reached[here]
        for there, step in links.get(here, ()):
            if there not in reached:
                reached[there] = (*reached[here], step)
                queue.append(there)
    return None


def compose(chain: Iterable[Step]) -> Floats:
    """The motion of a chain, (4,4): maps points of its last frame into its first."""
    T = np.eye(4)
    for transform, forward in chain:
        T = T @ (transform.T_parent_child if forward else inverse(transform.T_parent_child))
    return T


def _told(chain: Sequence[Step]) -> str:
    if not chain:
        return "the same frame"
    links = ", ".join(f"{transform.parent} -> {transform.child}" for transform, _ in chain)
    changing = "" if all(transform.static for transform, _ in chain) else " (not all of them static)"
    return f"tf {links}{changing}"


def _pair(
    survey: Survey, name: str, lidar: tuple[str, str], camera: CameraInput, T_cam_lidar: Floats
) -> RigPair:
    """A pair with the defaults of the rig file."""
    defaults = parse_rig({"pairs": [{"name": name}]}, where="discovery").pairs[0]
    vehicle = (path(survey.transforms.values(), frame, lidar[1]) for frame in VEHICLE_FRAMES)
    T_vehicle_lidar = next((compose(chain) for chain in vehicle if chain is not None), None)
    default_lidar = defaults.lidar
    return RigPair(
        name=name,
        lidar=LidarInput(lidar[0], lidar[1], default_lidar.type, default_lidar.spin, default_lidar.stamp),
        camera=camera,
        T_cam_lidar=T_cam_lidar,
        store=None,
        T_vehicle_lidar=T_vehicle_lidar,
        sigma_rad=defaults.sigma_rad,
        sigma_m=defaults.sigma_m,
        limits=defaults.limits,
        required=defaults.required,
        max_gap_ns=defaults.max_gap_ns,
        pairing=defaults.pairing,
    )


def _camera(survey: Survey, image: str) -> tuple[CameraInput | None, str]:
    """The camera of an image topic and which intrinsics hold; or None and what is missing."""
    frame, size = survey.images[image]
    info_topic = _info_of(survey, image)
    if info_topic is None:
        return None, f"no CameraInfo for {image}"
    info_frame, info = survey.infos[info_topic]
    try:
        model, why = camera_from_info(info, rectified=None, topic=image)
    except CalibwatchError as error:
        return None, str(error)
    if (model.width, model.height) != size:
        return None, f"{info_topic} is for {model.width}x{model.height} px, {image} has {size[0]}x{size[1]}"
    return CameraInput(image, info_topic, frame or info_frame, None, None, model), f"intrinsics {why}"


def _info_of(survey: Survey, image: str) -> str | None:
    """The CameraInfo of an image: same namespace first (ROS), then the same frame."""
    frame = survey.images[image][0]
    chunks = image.split("/")

    def likeness(topic: str) -> tuple[int, bool]:
        both = zip(chunks, topic.split("/"), strict=False)
        shared = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], both))
        return shared, survey.infos[topic][0] == frame

    siblings = []
    for topic, (info_frame, _) in survey.infos.items():
        namespace = topic.rpartition("/")[0]
        same_place = namespace != "" and image.startswith(f"{namespace}/")
        if same_place or (frame != "" and info_frame == frame):
            siblings.append(topic)
    return max(sorted(siblings), key=likeness, default=None)


def _one_per_camera(survey: Survey) -> Iterator[str]:
    """Image topics, one per CameraInfo: raw and compressed streams of one camera are the same pictures."""
    taken: set[str] = set()
    for image in sorted(survey.images, key=lambda topic: (topic.count("/"), topic)):
        info = _info_of(survey, image)
        if info is None or info not in taken:
            yield image
        if info is not None:
            taken.add(info)


def _pair_name(image: str, lidar: str, *, many: bool, taken: Sequence[str]) -> str:
    """A name of one chunk: the camera's, with the LiDAR's where there are several; a number if it repeats."""
    chunks = [chunk for chunk in image.split("/") if chunk and chunk not in _GENERIC]
    name = chunks[-1] if chunks else "camera"
    if many:
        name = f"{name}-{lidar.strip('/').replace('/', '_')}"
    name = "".join(letter if NAME.fullmatch(letter) else "_" for letter in name)[:60]
    numbered = (f"{name}{number or ''}" for number in itertools.chain([0], itertools.count(2)))
    return next(candidate for candidate in numbered if candidate not in taken)

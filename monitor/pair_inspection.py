"""What would become of a pair of a recording if it were watched: gaps, view, and what stands in the way."""

import statistics
from collections.abc import Mapping, Sequence

import numpy as np

from monitor.daemon import mount_of
from monitor.inspection_report import PairReport, TopicReport
from monitor.rig import RigPair
from monitor.seen_topics import NONE, Seen
from monitor.sync import pairer_for
from monitor.wording import spin_warning
from pipeline.cameras import project
from pipeline.se3 import apply, inverse
from pipeline.spin_check import told_spin


def pair_report(
    pair: RigPair, how: str, seen: Mapping[str, Seen], topics: Sequence[TopicReport]
) -> PairReport:
    """One pair with its gaps, view and problems. Topics and extrinsic of the pair are known."""
    assert pair.T_cam_lidar is not None  # noqa: S101 - a prepared rig lacks nothing
    lidar, camera = pair.lidar.topic or "", pair.camera.topic or ""
    sweeps, images = seen.get(lidar, Seen()), seen.get(camera, Seen())
    by_name = {topic.name: topic for topic in topics}
    report = by_name[lidar].cloud
    middle = 0 if report is None or report.middle_ms is None else round(report.middle_ms * 1e6)
    same = by_name[camera].type.startswith("file/") and sorted(images.stamps) == sorted(sweeps.stamps)
    gaps = _gaps(pair, sweeps, images, middle)
    nearest = _nearest_ms([stamp + middle for stamp in sweeps.stamps], images.stamps)
    in_view = _in_view(pair, sweeps)
    T_lidar_cam = inverse(pair.T_cam_lidar)
    return PairReport(
        name=pair.name,
        lidar=lidar,
        camera=camera,
        how=how.removeprefix(f"{lidar} with {camera}, "),
        T_cam_lidar=pair.T_cam_lidar.tolist(),
        camera_at_m=T_lidar_cam[:3, 3].tolist(),
        looks_along=T_lidar_cam[:3, 2].tolist(),
        vehicle_frame=pair.T_vehicle_lidar is not None,
        sweeps=len(sweeps.logged),
        images=len(images.logged),
        pairs=len(gaps),
        same_stamps=same,
        gap_ms=statistics.median(gaps) if gaps and not same else None,
        nearest_ms=nearest,
        clock_offset_ms=_clock_offset_ms(by_name[lidar], by_name[camera]),
        in_view=in_view,
        problems=tuple(_problems(pair, by_name, len(gaps), nearest, in_view)),
        warnings=_warnings(pair, sweeps),
    )


def _warnings(pair: RigPair, sweeps: Seen) -> tuple[str, ...]:
    """What the first sweeps say against the sense of rotation that the rig states."""
    spin, clouds = pair.lidar.spin, sweeps.clouds
    if spin is None or pair.camera.model is None or any(cloud.time is not None for _, cloud, _ in clouds):
        return ()
    told_s = next((sweep_s for _, _, sweep_s in clouds if sweep_s is not None), None)
    told = told_spin([(stamp_ns, cloud) for stamp_ns, cloud, _ in clouds], told_s, mount_of(pair).up)
    return () if told in (None, spin) else (spin_warning(told),)


def _gaps(pair: RigPair, sweeps: Seen, images: Seen, middle: int) -> list[float]:
    """Image stamp minus middle of the sweep, ms, of each pair; found as the monitor finds them."""
    pairer = pairer_for(pair)
    arrivals = [
        (log_ns, side, stamp, None if sequence == NONE else sequence)
        for side, topic in (("camera", images), ("lidar", sweeps))
        for stamp, log_ns, sequence in zip(topic.stamps, topic.logged, topic.sequences, strict=True)
    ]
    paired = []
    for _, side, stamp, sequence in sorted(arrivals, key=lambda arrival: arrival[0]):
        if side == "lidar":
            paired += pairer.push_lidar(stamp + middle, None, sequence)
        else:
            paired += pairer.push_camera(stamp, None, sequence)
    paired += pairer.flush()
    return [(one.camera_ns - one.lidar_ns) / 1e6 for one in paired]


def _clock_offset_ms(lidar: TopicReport, camera: TopicReport) -> float | None:
    """How far the camera's clock is ahead of the LiDAR's if both take equally long from measuring to log.

    A sweep is sent when it ends, which its stamp does not tell where its duration is unknown.
    """
    if lidar.delay_ms is None or camera.delay_ms is None or lidar.cloud is None:
        return None
    cloud = lidar.cloud
    known = cloud.middle_ms is not None and cloud.sweep_s is not None
    end_ms = (cloud.middle_ms or 0.0) + 500.0 * (cloud.sweep_s or 0.0) if known else 0.0
    return lidar.delay_ms - end_ms - camera.delay_ms


def _nearest_ms(sweeps: Sequence[int], images: Sequence[int]) -> float | None:
    """Median of image stamp minus nearest sweep, ms; None where one of them is empty."""
    if not sweeps or not images:
        return None
    order = np.sort(np.array(sweeps, dtype=np.int64))
    stamps = np.array(images, dtype=np.int64)
    after = (
        np.clip(np.searchsorted(order, stamps), 1, len(order) - 1)
        if len(order) > 1
        else np.zeros_like(stamps)
    )
    before = np.maximum(after - 1, 0)
    differences = np.stack([stamps - order[before], stamps - order[after]])
    chosen = np.abs(differences).argmin(axis=0)
    return float(np.median(differences[chosen, np.arange(len(stamps))])) / 1e6


def _in_view(pair: RigPair, sweeps: Seen) -> tuple[int, int] | None:
    """Points of the first sweep that the stored extrinsic puts into the image, and all of them."""
    cloud = next((cloud for _, cloud, _ in sweeps.clouds if len(cloud)), None)
    if cloud is None or pair.camera.model is None or pair.T_cam_lidar is None:
        return None
    _, inside = project(pair.camera.model, apply(pair.T_cam_lidar, cloud.xyz))
    return int(inside.sum()), len(cloud)


def _problems(
    pair: RigPair,
    topics: Mapping[str, TopicReport],
    pairs: int,
    nearest: float | None,
    in_view: tuple[int, int] | None,
) -> list[str]:
    """What will keep the pair from being judged."""
    lidar, camera = topics[pair.lidar.topic or ""], topics[pair.camera.topic or ""]
    found = [f"{topic.name}: {topic.undecodable}" for topic in (lidar, camera) if topic.undecodable]
    found += [f"{topic.name} has no message" for topic in (lidar, camera) if topic.count == 0]
    model = pair.camera.model
    if camera.image is not None and model is not None and camera.image.size != (model.width, model.height):
        width, height = camera.image.size
        found.append(f"images are {width}x{height} px, the intrinsics are for {model.width}x{model.height}")
    if pairs == 0 and nearest is not None:
        found.append(
            f"no sweep and image belong together: camera stamps are {nearest / 1e3:+.3f} s from the nearest "
            f"sweep, the limit is {pair.max_gap_ns / 1e6:g} ms"
        )
    if in_view is not None and in_view[0] == 0:
        found.append("no point of the first sweep falls into the image: is T_cam_lidar inverted?")
    return found

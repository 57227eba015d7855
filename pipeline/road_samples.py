"""Estimates of windows along drives, cut into stretches of road that are each one sample of the scene.

Windows of one street see the same things: they tell the random error (how it scatters, how far along the road
it stays alike), and together ONE value of the error that the scene adds (PROBE 2, 11.5).
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from pipeline.records import Floats, read_only

STRETCH_M = 200.0
"""m of road after which the scene counts as another: ten times what shows a new view (NEW_SCENE_M)."""

_WINDOWS_A_STRETCH = 4.0
"""A stretch is at least so many windows long: a window on its border belongs to neither side."""

_APART_M = 1.0
"""m; windows closer together than this are one: they hold the same frames but for one."""

_SHORTEST_CORRELATION_M = 20.0
"""m; edges lie 40 m ahead, so what is seen now is seen until half of that is driven (NEW_SCENE_M)."""

_CORRELATIONS = 16
"""Correlation lengths that are tried, from the shortest to four times it."""

_LEAST_WINDOWS = 3
"""Windows on each side of a change: one alone may lie in a false mode."""

_NOISE_LENGTHS = 2.0
"""Shortest correlation lengths in a segment that tells the noise: over more road the scene wanders."""

_SCENE_LENGTHS = 4.0
"""The same for the correlation: 80 m, as on the drives whose correlation is known (PROBE 4)."""

_PRIOR_DRIVES = 4.0
"""Drives on which the stated sigma was measured (PROBE 4): as many samples as stand behind a noise of 1."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowEstimates:
    """What the judgements along one drive estimated, in order of time; vehicle axes, rad and m.

    Attributes:
        recording: Name of the drive.
        drift: float64 (N,6), estimates against the stored extrinsic.
        covariance: float64 (N,6,6), stated covariance of their random error.
        feigned: float64 (N,6), drift that one sigma of error in the time between sweep and image would feign.
        way_m: float64 (N,2), way driven at the oldest and at the newest frame of each window, m.
        stamp_ns: int64 (N,), stamp of the newest frame of each window.
    """

    recording: str
    drift: Floats
    covariance: Floats
    feigned: Floats
    way_m: Floats
    stamp_ns: np.ndarray

    def __post_init__(self) -> None:
        for name in ("drift", "covariance", "feigned", "way_m", "stamp_ns"):
            object.__setattr__(self, name, read_only(np.asarray(getattr(self, name))))

    def __len__(self) -> int:
        return len(self.drift)

    def chosen(self, kept: np.ndarray) -> "WindowEstimates":
        """The windows that an index array or a mask (N,) names."""
        return dataclasses.replace(
            self,
            drift=self.drift[kept],
            covariance=self.covariance[kept],
            feigned=self.feigned[kept],
            way_m=self.way_m[kept],
            stamp_ns=self.stamp_ns[kept],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """The random error of windows inside a stretch.

    Attributes:
        noise: Factor on the stated sigma: 1 where it is honest.
        correlation_m: Way driven after which the error of a window is alike to 1/e, m.
    """

    noise: float
    correlation_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """One stretch of road in short.

    Attributes:
        recording: Name of the drive that it is part of.
        mean: float64 (6,), mean estimate of its windows; rad and m.
        windows: Windows that share no frame.
        samples: Independent windows that all its windows are worth.
        way_m: Way from the first frame to the last, m.
        seconds: Time from the first window to the last, s.
    """

    recording: str
    mean: Floats
    windows: int
    samples: float
    way_m: float
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class RoadSample:
    """One stretch of road: one sample of the scene, however many windows show how it pulls.

    Attributes:
        street: The stretch in short.
        drift: float64 (K,6), estimates of windows that share no frame.
        covariance: float64 (K,6,6), of their error apart from the scene: random, and of the clocks.
    """

    street: Street
    drift: Floats
    covariance: Floats


def stretches_of(drive: WindowEstimates) -> list[WindowEstimates]:
    """Cuts a drive into equal stretches of at least 200 m and four windows; a shorter drive is one stretch.

    Windows that reach over a border are left out: the stretches share no frame. Windows within ``_APART_M``
    count once, the later one, which saw more.
    """
    if len(drive) == 0:
        return []
    begin, end = drive.way_m[:, 0], drive.way_m[:, 1]
    start = float(begin.min())
    way = float(end.max()) - start
    whole = math.floor(way / max(STRETCH_M, _WINDOWS_A_STRETCH * float(np.median(end - begin))))
    if whole <= 1:
        return [_apart(drive)]
    length = way / whole
    parts = []
    for index in range(whole):
        inside = (begin >= start + index * length) & (end <= start + (index + 1) * length)
        if inside.any():
            parts.append(_apart(drive.chosen(inside)))
    return parts


def _apart(drive: WindowEstimates) -> WindowEstimates:
    kept: list[int] = []
    for index in range(len(drive) - 1, -1, -1):
        if not kept or drive.way_m[kept[-1], 1] - drive.way_m[index, 1] >= _APART_M:
            kept.append(index)
    return drive.chosen(np.array(kept[::-1]))


def scatter_of(drives: Sequence[WindowEstimates]) -> Scatter:
    """Noise and correlation of windows within segments of drives, each segment with a mean of its own.

    Errors are taken as ``noise^2`` times the stated covariance, alike as ``exp(-way / length)`` (AR(1) over
    the way, FORMULAS F1). The noise is what renews itself as fast as the windows do, so its length is half
    a window or the shortest: what wanders more slowly is the scene. It is the median over segments, for the
    scene changes within some, drawn to 1 by the drives on which the stated sigma was measured. The
    correlation is that of all together, of the largest restricted likelihood.
    """
    spans = [np.median(part.way_m[:, 1] - part.way_m[:, 0]) for part in drives]
    shortest = max(_SHORTEST_CORRELATION_M, 0.5 * float(np.median(spans)))
    near, far = (
        [part for drive in drives for part in _segments(drive, lengths * shortest) if len(part) > 1]
        for lengths in (_NOISE_LENGTHS, _SCENE_LENGTHS)
    )
    if not near:
        return Scatter(noise=1.0, correlation_m=shortest)
    alike = _whitened(near)
    degrees = np.concatenate([np.full(len(some.way_m), some.degrees) for some in alike])
    squares = np.concatenate([_restricted(some, shortest)[0] for some in alike])
    scales = squares / special.chdtri(degrees, 0.5)
    samples = sum(effective_samples(part.way_m[:, 1], shortest) - 1.0 for part in near)
    variance = _weighted_median(scales, degrees)
    noise = math.sqrt((_PRIOR_DRIVES + samples * variance) / (_PRIOR_DRIVES + samples))
    lengths = np.geomspace(shortest, _SCENE_LENGTHS * shortest, _CORRELATIONS)
    alike = _whitened(far)
    likelihoods = [_likelihood(alike, float(length)) for length in lengths]
    return Scatter(noise=noise, correlation_m=float(lengths[int(np.argmax(likelihoods))]))


@dataclass(frozen=True, slots=True, eq=False)
class _Alike:
    """Segments of equally many windows, whitened by what each window states of its error.

    Attributes:
        way_m: float64 (G,n), way driven at the end of each window, m.
        values: float64 (G,n,6), whitened estimates.
        roots: float64 (G,n,36), rows of the symmetric ``C^-1/2`` of each window.
    """

    way_m: Floats
    values: Floats
    roots: Floats

    @property
    def degrees(self) -> int:
        """Of freedom, of each segment: its windows less its mean."""
        return 6 * (int(self.way_m.shape[1]) - 1)


def _whitened(parts: Sequence[WindowEstimates]) -> list[_Alike]:
    """Segments by how many windows they have, so that all of one size are worked on at once."""
    found = []
    for size in sorted({len(part) for part in parts}):
        same = [part for part in parts if len(part) == size]
        roots = _inverse_roots(np.stack([part.covariance for part in same]))
        values = np.einsum("gnij,gnj->gni", roots, np.stack([part.drift for part in same]))
        way_m = np.stack([part.way_m[:, 1] for part in same])
        found.append(_Alike(way_m, values, roots.reshape(len(same), size, 36)))
    return found


def _likelihood(parts: Sequence[_Alike], length_m: float) -> float:
    """Logarithm of the restricted likelihood of a correlation length, each segment with its own noise."""
    total = 0.0
    for some in parts:
        squares, log_determinants = _restricted(some, length_m)
        # Estimates that repeat each other to the last digit must not make the logarithm infinite.
        fits = log_determinants + some.degrees * np.log(squares / some.degrees + 1e-300)
        total -= 0.5 * float(fits.sum())
    return total


def _segments(drive: WindowEstimates, length_m: float) -> list[WindowEstimates]:
    """The windows of a drive by the segment of road in which they end."""
    drive = _apart(drive)
    number = ((drive.way_m[:, 1] - drive.way_m[0, 1]) // length_m).astype(np.int64)
    return [drive.chosen(number == index) for index in np.unique(number)]


def _weighted_median(values: Floats, weights: np.ndarray) -> float:
    order = np.argsort(values)
    half = np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())
    return float(values[order][half])


def _restricted(some: _Alike, length_m: float) -> tuple[Floats, Floats]:
    """Per segment (G,) squared residuals, whitened, and the log determinants of the restricted likelihood."""
    count, size = some.way_m.shape
    factor = np.linalg.cholesky(_alike(some.way_m, length_m))
    values = np.linalg.solve(factor, some.values).reshape(count, 6 * size, 1)
    design = np.linalg.solve(factor, some.roots).reshape(count, 6 * size, 6)
    # Scaled, for radians and metres differ by orders of magnitude.
    scale = np.linalg.norm(design, axis=1)
    q, r = np.linalg.qr(design / scale[:, None, :])
    residual = (values - q @ (q.transpose(0, 2, 1) @ values))[:, :, 0]
    log_determinants = 12.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    log_determinants += 2.0 * np.log(np.abs(np.diagonal(r, axis1=1, axis2=2)) * scale).sum(axis=1)
    return np.einsum("ni,ni->n", residual, residual), log_determinants


def _alike(way_m: Floats, length_m: float) -> Floats:
    """Correlation (...,N,N) of windows by the way (...,N) between them."""
    apart = np.abs(way_m[..., :, None] - way_m[..., None, :])
    return np.asarray(np.exp(-apart / length_m), dtype=np.float64)


def _inverse_roots(covariance: Floats) -> Floats:
    """Symmetric ``C^-1/2``, (...,6,6)."""
    values, vectors = np.linalg.eigh(covariance)
    scaled = vectors / np.sqrt(values)[..., None, :]
    return np.asarray(scaled @ np.swapaxes(vectors, -1, -2), dtype=np.float64)


def effective_samples(way_m: Floats, length_m: float) -> float:
    """Independent windows that windows at ``way_m`` (N,) are worth: ``N^2 / sum of correlations``."""
    return len(way_m) ** 2 / float(_alike(way_m, length_m).sum())


def samples_of(drives: Sequence[WindowEstimates]) -> tuple[tuple[RoadSample, ...], Scatter]:
    """The stretches of all drives as samples, sorted by recording, and how their windows scatter."""
    ordered = sorted((drive for drive in drives if len(drive) > 0), key=lambda drive: drive.recording)
    if not ordered:
        return (), Scatter(noise=1.0, correlation_m=_SHORTEST_CORRELATION_M)
    scatter = scatter_of(ordered)
    return tuple(_sample(part, scatter) for drive in ordered for part in stretches_of(drive)), scatter


def _sample(part: WindowEstimates, scatter: Scatter) -> RoadSample:
    """A stretch as a sample: its windows that share no frame, from the last one back, which saw most."""
    kept: list[int] = []
    for index in range(len(part) - 1, -1, -1):
        if not kept or part.way_m[index, 1] <= part.way_m[kept[-1], 0]:
            kept.append(index)
    chosen = part.chosen(np.array(kept[::-1]))
    clocks = chosen.feigned[:, :, None] * chosen.feigned[:, None, :]
    street = Street(
        recording=part.recording,
        mean=np.asarray(chosen.drift.mean(axis=0), dtype=np.float64),
        windows=len(chosen),
        samples=effective_samples(part.way_m[:, 1], scatter.correlation_m),
        way_m=float(part.way_m[:, 1].max() - part.way_m[:, 0].min()),
        seconds=float(part.stamp_ns[-1] - part.stamp_ns[0]) / 1e9,
    )
    return RoadSample(street, chosen.drift, scatter.noise**2 * chosen.covariance + clocks)


def mean_of(drive: WindowEstimates) -> tuple[Floats, Floats]:
    """Mean (6,) of a drive's windows by information, and its covariance (6,6): no surer than one window."""
    information = np.linalg.inv(drive.covariance)
    total = np.linalg.inv(information.sum(axis=0))
    mean, clock = (
        total @ np.einsum("nij,nj->i", information, values) for values in (drive.drift, drive.feigned)
    )
    return mean, len(drive) * total + np.outer(clock, clock)


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """The largest difference between what a drive shows before and after one of its windows.

    Attributes:
        difference: float64 (6,), mean after it minus mean before it, rad and m.
        statistic: Joint statistic, chi-square of six degrees of freedom where nothing moved.
    """

    difference: Floats
    statistic: float


def largest_change(drive: WindowEstimates, floor: Floats) -> Change:
    """Whether something moved on the way: all windows up to one against all after it, three at least each.

    Neither side is taken to know more than one window and one scene do, however long it is: it errs towards
    no change.

    Args:
        drive: Its windows.
        floor: float64 (6,6), covariance of what a scene adds.
    """
    information = np.linalg.inv(drive.covariance)
    pulls = [np.einsum("nij,nj->ni", information, values) for values in (drive.drift, drive.feigned)]
    total, (drift, feigned) = information.cumsum(axis=0), (pull.cumsum(axis=0) for pull in pulls)
    count = len(drive)
    split = np.arange(_LEAST_WINDOWS, count - _LEAST_WINDOWS + 1)
    if not split.size:
        return Change(np.zeros(6), 0.0)
    last = split - 1
    before, after = np.linalg.inv(total[last]), np.linalg.inv(total[-1] - total[last])
    difference, clock = (
        np.einsum("nij,nj->ni", after, pull[-1] - pull[last]) - np.einsum("nij,nj->ni", before, pull[last])
        for pull in (drift, feigned)
    )
    P = split[:, None, None] * before + (count - split)[:, None, None] * after + 2.0 * floor
    P = P + clock[:, :, None] * clock[:, None, :]
    statistic = np.einsum("ni,ni->n", difference, np.linalg.solve(P, difference[:, :, None])[:, :, 0])
    largest = int(np.argmax(statistic))
    return Change(difference[largest], float(statistic[largest]))

"""An evaluation of masks as Markdown, for people, and as files."""

from collections.abc import Iterator
from pathlib import Path

from monitor.mask_evaluation import Evaluation, Quality, Ratio
from monitor.outputs import write_whole
from pipeline.errors import CalibwatchError

_WAYS = {"argmax": "likeliest class", "thresholds": "thresholds", "crf": "CRF"}
_SAYS = {"network": "network", "crf": "with CRF"}


def tables(found: Evaluation) -> str:
    """Three tables: figures, reliability, times."""
    return "\n".join((*_head(found), "", *_figures(found), "", *_reliability(found), "", *_times(found)))


def made(out: Path) -> Path:
    """The folder, made where it is absent, before anything is measured for it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibwatchError(
            f"--out {out} can not be made: {error.strerror}", hint="name a folder"
        ) from error
    return out


def write(found: Evaluation, out: Path) -> None:
    """Writes ``masks.md`` and ``masks.json`` into a folder."""
    everything = found.model_dump_json(indent=1)
    try:
        for name, text in (("masks.md", tables(found)), ("masks.json", everything)):
            write_whole(out / name, f"{text}\n".encode())
    except OSError as error:
        raise CalibwatchError(
            f"--out {out} can not be written: {error.strerror}", hint="name another folder"
        ) from error


def _head(found: Evaluation) -> Iterator[str]:
    reduced = "" if found.longest_side is None else f", images reduced to {found.longest_side} px"
    crf = (
        f"{name} {threshold:g}"
        for name, threshold in (("lane", found.lane_threshold_crf), ("pole", found.pole_threshold_crf))
        if threshold is not None
    )
    yield (
        f"Network {found.model_version or 'without version'} (SHA-256 {found.model_hash[:12]}), split "
        f"{found.split}, thresholds lane {found.lane_threshold:g}, pole {found.pole_threshold:g} "
        f"(after the CRF {', '.join(crf) or 'the same'}){reduced}. "
        "Precision and recall with a slack of 2 px at 1280 px width. In brackets 95 % intervals, "
        f"{found.resamples} resamples of the images (seed {found.seed})."
    )


def _figures(found: Evaluation) -> Iterator[str]:
    yield "| set | class | images | masks by | IoU | precision | recall | F | covered, % | labelled, % |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for one in found.sets:
        for name, report in one.classes.items():
            for way, quality in report.masks.items():
                figures = " | ".join(_ratio(ratio) for ratio in _ratios(quality))
                shares = f"{_percent(quality.covered.value)} | {_percent(report.labelled)}"
                yield f"| {one.name} | {name} | {one.images} | {_WAYS[way]} | {figures} | {shares} |"


def _ratios(quality: Quality) -> tuple[Ratio, ...]:
    return quality.iou, quality.precision, quality.recall, quality.f


def _reliability(found: Evaluation) -> Iterator[str]:
    yield "Observed share by tenths of the stated probability (an honest one lies within its tenth):"
    yield ""
    tenths = " | ".join(f"{i / 10:.1f}" for i in range(10))
    yield f"| set | class | stated by | calibration error | {tenths} |"
    yield "|---|---|---|---|" + "---|" * 10
    for one in found.sets:
        for name, report in one.classes.items():
            for of, said in report.reliability.items():
                error = "-" if said.error is None else f"{said.error:.4f}"
                shares = " | ".join("-" if share is None else f"{share:.2f}" for share in said.observed)
                yield f"| {one.name} | {name} | {_SAYS[of]} | {error} | {shares} |"


def _times(found: Evaluation) -> Iterator[str]:
    yield f"Median wall time of an image, ms; threads: {found.threads}."
    yield ""
    yield "| set | images | network | CRF, thresholds, choice of pieces |"
    yield "|---|---|---|---|"
    for one in found.sets:
        masks = "-" if one.masks_ms is None else f"{one.masks_ms:.0f}"
        yield f"| {one.name} | {one.images} | {one.network_ms:.0f} | {masks} |"


def _ratio(ratio: Ratio) -> str:
    if ratio.value is None:
        return "-"
    if ratio.low is None or ratio.high is None:
        return f"{ratio.value:.2f}"
    return f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f}"

"""Tables and curves of ``evaluate dataset`` and ``basin``: what stands where, for values made up by hand."""

import cv2
import numpy as np
import pytest

from monitor import charts
from monitor.basin_evaluation import WAYS, Basin, Curve, Point
from monitor.basin_tables import basin_picture, basin_text
from monitor.clock import SystemClock
from monitor.coarse_evaluation import Coarse, coarse_of, coarse_summary
from monitor.dataset_evaluation import Answer, AxisError, Dataset, Summary, Trust
from monitor.dataset_tables import dataset_picture, dataset_text
from monitor.evaluated_frames import simulated_frames
from monitor.model_file import open_segmenter
from monitor.status import AXIS_NAMES
from pipeline.basin import OFFSETS


def coarse(frame="a", rotation_deg=None, translation_m=None, reason="", group="set"):
    found = rotation_deg is not None
    return Coarse(
        frame=frame,
        group=group,
        found=found,
        reason=reason,
        errors=(0.1, -0.2, 0.3, 0.4, -0.5, 0.6) if found else (),
        rotation_deg=rotation_deg,
        translation_m=translation_m,
        ms={"coarse": 10.0, "masks": 5.0},
    )


def answer(frame="a", wrong=(), hidden=(), error=0.25):
    return Answer(
        frame=frame,
        group="set",
        start=0,
        axes={
            name: AxisError(start=1.0, error=error, sigma=0.125, observable=name not in hidden)
            for name in AXIS_NAMES
        },
        start_rotation_deg=2.0,
        start_translation_m=0.3,
        rotation_deg=0.2,
        translation_m=0.02,
        wrong=wrong,
        held=("yaw with left",) if hidden else (),
        reason="why",
        ms={"search": 20.0, "all": 30.0},
    )


def dataset(answers, coarses, trust=None, prior_sigma=None):
    summary = Summary(
        group="set",
        frames=len(answers),
        answers=len(answers),
        start=(1.0,) * 6,
        observable=(0.011, 0.022, 0.033, 0.044, 0.055, None),
        everything=(0.5,) * 6,
        median_observable_deg=0.07,
        median_observable_m=None,
        start_rotation_deg=2.0,
        start_translation_m=0.3,
        rotation_deg=0.2,
        translation_m=0.02,
        yaw_and_pitch=0.75,
        all_six=0.5,
        nothing=0.25,
        trust=trust,
        ms={"search": 20.0, "all": 30.0},
    )
    return Dataset(
        starts=1,
        rotation_deg=2.0,
        translation_m=0.3,
        seed=0,
        prior_sigma=prior_sigma,
        summaries=(summary,),
        coarse_summaries=(coarse_summary("set", coarses),),
        answers=tuple(answers),
        coarse=tuple(coarses),
    )


def row(text, start):
    (line,) = (line for line in text.splitlines() if line.startswith(start))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_axes_stand_in_the_order_of_the_published_table():
    text = dataset_text(dataset([answer()], [coarse()]))
    cells = row(text, "| set | 1 | 1 | refined, observable axes |")
    # forward, left, up, then roll, pitch, yaw; values are given as roll, pitch, yaw, forward, left, up.
    assert cells[4:10] == ["0.044", "0.055", "-", "0.011", "0.022", "0.033"]
    assert row(text, "| set | 1 | 1 | refined, all axes |")[10:] == ["0.020", "0.200"]
    assert row(text, "| set | 1 | 0 | coarse, no prior |")[4:] == ["-"] * 8


def test_wrong_axes_and_axes_that_are_not_seen_are_marked():
    text = dataset_text(dataset([answer(wrong=("pitch",), hidden=("yaw",))], [coarse()]))
    cells = row(text, "| set a | 0 |")
    assert cells[2:8] == [
        "+0.25/0.12",
        "**+0.25/0.12**",
        "(+0.25/0.12)",
        "+0.25/0.12",
        "+0.25/0.12",
        "+0.25/0.12",
    ]
    assert cells[8:] == ["yaw with left", "why"]


def test_trust_is_told_where_there_is_something_to_trust():
    trust = Trust(
        axes=60, within_one=0.5, within_two=0.9, confident_wrong=3, mean_square=2.5, below_95=0.8, p=0.001
    )
    cells = row(dataset_text(dataset([answer()], [coarse()], trust)), "| set | 75 %")
    assert cells[1:] == [
        "75 %",
        "50 %",
        "25 %",
        "0.070",
        "-",
        "50 %",
        "90 %",
        "2.50",
        "80 %",
        "0.001",
        "3 of 60",
    ]
    assert row(dataset_text(dataset([answer()], [coarse()])), "| set | 75 %")[6:] == ["-"] * 5 + ["0"]


def test_what_calibrate_was_told_stands_above_the_tables():
    assert "calibrate was told" not in dataset_text(dataset([answer()], [coarse()]))
    text = dataset_text(dataset([answer()], [coarse()], prior_sigma=(3.0, 0.5)))
    assert "calibrate was told that they are off by 3 deg and 0.5 m" in text.splitlines()[0]


def test_coarse_answers_are_near_or_far_or_say_why_not():
    found = [
        coarse("a", 2.9, 0.4),
        coarse("b", 3.1, 0.4),
        coarse("c", 2.9, 0.6),
        coarse("d", reason="no lanes"),
        coarse("e", reason="no lanes"),
    ]
    summary = coarse_summary("set", found)
    assert (summary.frames, summary.found, summary.near) == (5, 3, 1)
    assert summary.mean_absolute == pytest.approx((0.1, 0.2, 0.3, 0.4, 0.5, 0.6))
    assert (summary.rotation_deg, summary.translation_m) == (2.9, 0.4)
    text = dataset_text(dataset([answer()], found))
    assert row(text, "| set | 5 | 3 | 1 |")[2:] == ["3", "1", "2", "2: no lanes"]
    assert "Far: set b (3.100 deg, 0.400 m), set c (2.900 deg, 0.600 m)" in text
    empty = coarse_summary("set", found[3:])
    assert (empty.found, empty.rotation_deg, empty.mean_absolute) == (0, None, (None,) * 6)


def colours_of(data):
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return image.shape, [int((image == colour).all(axis=2).sum()) for colour in charts.COLOURS]


def test_curves_are_drawn_of_what_there_is():
    shape, with_coarse = colours_of(dataset_picture(dataset([answer()], [coarse("a", 1.0, 0.1)])))
    _, without = colours_of(dataset_picture(dataset([answer()], [coarse()])))
    assert shape == (860, 1240, 3)
    assert with_coarse[2] > without[2] + 100
    assert min(with_coarse[:3]) > 100
    nothing = dataset([answer(hidden=AXIS_NAMES)], [coarse()])
    assert colours_of(dataset_picture(nothing))[0] == shape


def basin_of(value):
    """A basin whose points are made by ``value(way, place)`` -> answers, success, deg, m."""
    sweeps = {}
    for sweep, places in OFFSETS.items():
        ways = {
            way: tuple(
                Point(offset=float(place), answers=a, success=s, rotation_deg=deg, translation_m=m)
                for place in range(len(places))
                for a, s, deg, m in [value(way, place)]
            )
            for way in WAYS
        }
        sweeps[sweep] = Curve(unit="deg", runs=4, ways=ways)
    return Basin(frames=4, starts=1, seed=0, matched={"a": 2, "b": 7}, sweeps=sweeps)


def test_basins_are_told_way_by_way():
    def value(way, place):
        if way == "method II":
            return 0, 0.0, None, None
        return 4, 0.25 * (place % 5), 0.1 * (place + 1), 0.01 * (WAYS.index(way) + 1)

    found = basin_of(value)
    text = basin_text(found)
    assert "2 to 7 a frame, fewer than three in 1 frames" in text
    cells = [row for row in text.splitlines() if row.startswith("| 3 |")]
    assert len(cells) == len(OFFSETS)
    assert cells[0] == (
        "| 3 | 75 %, 0.4 / 0.01 | no answer | 75 %, 0.4 / 0.03 | 75 %, 0.4 / 0.04 | 75 %, 0.4 / 0.05 "
        "| 75 %, 0.4 / 0.06 |"
    )
    shape, counts = colours_of(basin_picture(found))
    assert shape == (860, 1860, 3)
    # Method II has no median; each other way has curves of its own colour beyond the legend's.
    assert all(count > 100 for count in counts)


def test_a_long_legend_stays_in_its_panel():
    names = ("method I", "method II", "I from II", "Algorithm 1", "evolution", "calibrate")
    panel = charts.Panel("t", charts.steps(0, 1, 1, "x"), charts.steps(0, 1, 1, "y"), ())
    image = cv2.imdecode(np.frombuffer(charts.png([panel], names, 1), np.uint8), cv2.IMREAD_COLOR)
    for colour in charts.COLOURS:
        _, columns = np.nonzero((image[40:52] == colour).all(axis=2))
        assert len(columns) > 20
    assert (image[38:56, -3:] == 255).all()


@pytest.mark.slow
def test_a_frame_with_two_lanes_is_found_without_a_start():
    frame = list(simulated_frames(2, 0))[1]
    found = coarse_of(frame, open_segmenter(None, 1), 0, SystemClock())
    assert found.found
    assert found.near
    assert np.linalg.norm(found.errors[:3]) == pytest.approx(found.rotation_deg, rel=0.05)
    assert found.ms.keys() == {"masks", "image lines", "cloud lines", "coarse"}

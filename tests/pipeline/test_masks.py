import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import labels
from pipeline.crf import AppearanceKernel, CrfParameters, SmoothnessKernel
from pipeline.errors import InputError, RigError
from pipeline.masks import (
    REFERENCE_WIDTH_PX,
    ClassCrf,
    MaskCrf,
    MaskParameters,
    horizon_line,
    masks_from_probabilities,
)
from pipeline.records import CameraModel

ROOT = Path(__file__).parents[2]
RECORDED = (
    Path(os.environ.get("CALIBWATCH_DATA", ROOT.parent / "shared" / "data")).parent / "reference" / "crf"
)
THIN_POLES = sorted(RECORDED.glob("0[2345]_*.npz"))

PLAIN = MaskParameters(crf=None)
PUBLISHED = CrfParameters(SmoothnessKernel(3.0, 3.0, 3.0), AppearanceKernel(80.0, 80.0, (13.0,) * 3, 10.0))
"""The setting of the published examples, made for large objects."""
HARD = MaskCrf(ClassCrf(PUBLISHED, 0.5), ClassCrf(PUBLISHED, 0.3))


def probabilities_of(label, sure=0.9):
    """float32 (C,h,w): ``sure`` for the label, the rest shared evenly."""
    count = len(labels.NAMES)
    others = (1.0 - sure) / (count - 1)
    stack = np.full((count, *label.shape), others, dtype=np.float32)
    np.put_along_axis(stack, label[None], np.float32(sure), axis=0)
    return stack


def coarser(stack, factor):
    return np.stack(
        [cv2.resize(plane, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) for plane in stack]
    )


def street(widths=(2, 3, 4, 6), contrast=30, noise=8.0, width=REFERENCE_WIDTH_PX // 2, height=188):
    """Poles of the given widths before a grey ramp, one bright stripe of paint; image and labels."""
    rng = np.random.default_rng(3)
    label = np.full((height, width), labels.ROAD)
    for i, pole in enumerate(widths):
        left = (i + 1) * width // (len(widths) + 1)
        label[20:140, left : left + pole] = labels.POLE
    label[150:180, width // 2 - 60 : width // 2 - 52] = labels.LANE
    grey = 120.0 + np.linspace(0, 10, width)[None, :, None] + rng.normal(0, noise, (height, width, 3))
    grey[label == labels.POLE] -= contrast
    grey[label == labels.LANE] += 80.0
    return np.clip(grey, 0, 255).astype(np.uint8), label


def kept(mask, truth):
    return float(mask[truth].mean())


class TestThinPoles:
    @pytest.mark.parametrize("contrast", [0, 15, 20, 30, 60])
    @pytest.mark.parametrize("sure", [0.7, 0.9])
    def test_every_width_survives_the_default(self, contrast, sure):
        image, label = street(contrast=contrast)
        masks = masks_from_probabilities(probabilities_of(label, sure), image, MaskParameters())
        _, pieces = cv2.connectedComponents((label == labels.POLE).astype(np.uint8))
        assert [kept(masks.pole, pieces == piece) > 0.5 for piece in range(1, 5)] == [True] * 4
        assert masks.pole[label != labels.POLE].mean() < 0.002
        assert kept(masks.lane, label == labels.LANE) > 0.95

    def test_a_hard_crf_would_delete_them_and_is_overruled(self):
        image, label = street(contrast=15)
        stack = probabilities_of(label)
        overruled = masks_from_probabilities(stack, image, MaskParameters(crf=HARD))
        heeded = masks_from_probabilities(stack, image, MaskParameters(crf=HARD, pole_keep=0.0))
        assert kept(heeded.pole, label == labels.POLE) < 0.05
        assert kept(overruled.pole, label == labels.POLE) == 1.0

    def test_the_crf_trims_a_pole_seen_too_wide(self):
        image, label = street(widths=(6, 6, 8), contrast=80)
        fat = np.where(
            cv2.dilate((label == labels.POLE).astype(np.uint8), np.ones((1, 5), np.uint8)), labels.POLE, label
        )
        spill = (label != labels.POLE) & (fat == labels.POLE)
        stack = probabilities_of(label)
        stack[labels.POLE, spill] = 0.35
        stack[labels.ROAD, spill] = 0.55
        masks = masks_from_probabilities(stack, image, MaskParameters())
        plain = masks_from_probabilities(stack, image, PLAIN)
        assert kept(plain.pole, spill) == 1.0
        assert kept(masks.pole, spill) < 0.2
        assert kept(masks.pole, label == labels.POLE) > 0.95

    @pytest.mark.recordings
    @pytest.mark.skipif(not THIN_POLES, reason=f"no recorded CRF cases in {RECORDED}")
    @pytest.mark.parametrize("path", THIN_POLES, ids=lambda path: path.stem)
    def test_recorded_cases(self, path):
        with np.load(path) as case:
            image, unary = case["image"], case["unary"].astype(np.float64)
        pole = np.exp(-unary[1]) / np.exp(-unary).sum(axis=0)
        stack = np.zeros((len(labels.NAMES), *pole.shape), np.float32)
        stack[labels.POLE] = pole
        stack[labels.OTHER] = 1.0 - pole
        masks = masks_from_probabilities(stack, image, MaskParameters(pole_least_px2=0.0))
        # The scene's pole is the largest piece that the unary shows.
        count, pieces = cv2.connectedComponents((pole >= 0.5).astype(np.uint8))
        largest = max(range(1, count), key=lambda piece: int((pieces == piece).sum()))
        assert kept(masks.pole, pieces == largest) >= 0.5


class TestGrid:
    @pytest.mark.parametrize("factor", [1.0, 0.5, 0.25])
    def test_scale_and_place(self, factor):
        image, label = street(widths=(8,), contrast=60, width=640, height=192)
        masks = masks_from_probabilities(coarser(probabilities_of(label), factor), image, MaskParameters())
        assert masks.pole.shape == (192 * factor, 640 * factor)
        assert (masks.scale_x, masks.scale_y) == (factor, factor)
        rows, columns = np.nonzero(masks.pole)
        place = ((columns.mean() + 0.5) / factor - 0.5, (rows.mean() + 0.5) / factor - 0.5)
        truth = np.argwhere(label == labels.POLE).mean(axis=0)[::-1]
        np.testing.assert_allclose(place, truth, atol=0.6)

    def test_axes_scale_by_themselves(self):
        image, label = street(width=640, height=192)
        stack = probabilities_of(label)[:, ::4, ::2]
        masks = masks_from_probabilities(np.ascontiguousarray(stack), image, PLAIN)
        assert (masks.scale_x, masks.scale_y) == (0.5, 0.25)

    def test_a_larger_image_of_the_same_street_gives_the_same_masks(self):
        image, label = street(contrast=40)
        stack = probabilities_of(label)
        small = masks_from_probabilities(stack, image, MaskParameters())
        doubled = np.kron(image, np.ones((2, 2, 1), np.uint8))
        large = masks_from_probabilities(stack, doubled, MaskParameters())
        assert large.scale_x == 0.5
        np.testing.assert_array_equal(large.pole, small.pole)
        np.testing.assert_array_equal(large.lane, small.lane)


class TestThresholdsAndSizes:
    def test_the_largest_class_is_not_enough(self):
        stack = np.full((len(labels.NAMES), 40, 60), 0.07, np.float32)
        stack[labels.LANE] = 0.44
        image = np.full((40, 60, 3), 100, np.uint8)
        assert not masks_from_probabilities(stack, image, PLAIN).lane.any()
        assert masks_from_probabilities(
            stack, image, MaskParameters(crf=None, lane_threshold=0.44)
        ).lane.all()

    def test_specks_go_and_pieces_stay(self):
        label = np.full((100, REFERENCE_WIDTH_PX), labels.ROAD)
        label[50, 100:111] = labels.LANE
        label[60, 100:112] = labels.LANE
        label[10:33, 300] = labels.POLE
        label[10:34, 400] = labels.POLE
        image = np.zeros((*label.shape, 3), np.uint8)
        masks = masks_from_probabilities(probabilities_of(label), image, PLAIN)
        assert not masks.lane[50].any()
        assert masks.lane[60].sum() == 12
        assert not masks.pole[:, 300].any()
        assert masks.pole[:, 400].sum() == 24

    def test_a_slanted_line_is_one_piece(self):
        label = np.where(np.eye(40, dtype=bool), labels.LANE, labels.ROAD)
        image = np.zeros((40, 40, 3), np.uint8)
        parameters = MaskParameters(crf=None, lane_least_px2=12.0 * (REFERENCE_WIDTH_PX / 40) ** 2)
        assert masks_from_probabilities(probabilities_of(label), image, parameters).lane.sum() == 40

    @pytest.mark.parametrize(("factor", "left"), [(1, 12), (2, 48), (3, 108)])
    def test_least_size_grows_with_the_grid(self, factor, left):
        # A patch of 12 px at the reference width is 48 px on a grid twice as wide, whatever the image is.
        label = np.full((20 * factor, REFERENCE_WIDTH_PX * factor), labels.ROAD)
        label[: 3 * factor, : 4 * factor] = labels.LANE
        label[8 * factor : 11 * factor, : 4 * factor] = labels.LANE
        label[8 * factor, 0] = labels.ROAD
        image = np.zeros((20, REFERENCE_WIDTH_PX, 3), np.uint8)
        masks = masks_from_probabilities(probabilities_of(label), image, PLAIN)
        assert masks.lane.sum() == left

    def test_masks_share_no_pixel(self):
        stack = np.zeros((len(labels.NAMES), 30, 30), np.float32)
        stack[labels.LANE] = stack[labels.POLE] = 0.5
        masks = masks_from_probabilities(stack, np.zeros((30, 30, 3), np.uint8), PLAIN)
        assert masks.pole.all()
        assert not masks.lane.any()

    @pytest.mark.parametrize("parameters", [PLAIN, MaskParameters()])
    def test_nothing_seen_is_an_empty_mask(self, parameters):
        stack = probabilities_of(np.full((30, 40), labels.ROAD), 1.0)
        masks = masks_from_probabilities(stack, np.full((60, 80, 3), 90, np.uint8), parameters)
        assert not masks.lane.any()
        assert not masks.pole.any()

    def test_black_image(self):
        image, label = street()
        masks = masks_from_probabilities(probabilities_of(label), np.zeros_like(image), MaskParameters())
        assert np.isfinite(masks.pole_probability).all()
        assert kept(masks.pole, label == labels.POLE) > 0.5

    def test_crf_leaves_far_pixels_as_the_network_had_them(self):
        image, label = street(widths=(4,), contrast=60)
        stack = probabilities_of(label)
        masks = masks_from_probabilities(stack, image, MaskParameters())
        np.testing.assert_array_equal(masks.pole_probability[:, :100], stack[labels.POLE][:, :100])


class TestPieces:
    def test_the_crf_alone_makes_no_pole(self):
        # Two stripes of one colour on grey, sure and unsure to the network; the CRF likes both.
        image, label = street(widths=(6, 6), contrast=80)
        unsure = (label == labels.POLE) & (np.arange(label.shape[1]) > 300)
        stack = probabilities_of(label)
        for seen, stays in ((0.31, True), (0.29, False)):
            stack[labels.POLE, unsure] = seen
            masks = masks_from_probabilities(stack, image, MaskParameters(evidence=0.0, margin_px=8.0))
            assert masks.pole_probability[unsure].mean() > 0.15
            assert masks.pole[unsure].any() == stays
            assert kept(masks.pole, (label == labels.POLE) & ~unsure) > 0.9

    @pytest.mark.parametrize(("ground", "stays"), [(labels.ROAD, True), (labels.VEGETATION, False)])
    def test_paint_lies_on_a_road(self, ground, stays):
        label = np.full((100, REFERENCE_WIDTH_PX), labels.VEGETATION)
        label[20:80, 100:300] = ground
        label[30:70, 190:200] = labels.LANE
        image = np.zeros((*label.shape, 3), np.uint8)
        assert masks_from_probabilities(probabilities_of(label), image, PLAIN).lane[50, 195] == stays

    def test_paint_at_the_road_s_edge_stays(self):
        label = np.full((100, REFERENCE_WIDTH_PX), labels.VEGETATION)
        label[:, 400:] = labels.ROAD
        label[10:90, 392:400] = labels.LANE
        image = np.zeros((*label.shape, 3), np.uint8)
        assert masks_from_probabilities(probabilities_of(label), image, PLAIN).lane[50, 395]


class TestHorizon:
    CAMERA = CameraModel(
        "pinhole", np.array([[620.0, 0, 310.0], [0, 620.0, 90.0], [0, 0, 1.0]]), np.zeros(0), 621, 188
    )

    @pytest.mark.parametrize("roll", [0.0, 0.3, -0.3, np.pi])
    def test_line_against_rays(self, roll):
        up = np.array([np.sin(roll), -np.cos(roll), 0.1])
        line = horizon_line(self.CAMERA, up / np.linalg.norm(up))
        pixels = np.random.default_rng(0).uniform(0, 188, (200, 2))
        rays = np.column_stack([pixels, np.ones(200)]) @ np.linalg.inv(self.CAMERA.K).T
        np.testing.assert_array_equal(np.column_stack([pixels, np.ones(200)]) @ line > 0, rays @ up < 0)

    @pytest.mark.parametrize("factor", [1.0, 0.5])
    def test_paint_in_the_sky_goes_poles_stay(self, factor):
        image, label = street(widths=(4,))
        label[30:40, 50:90] = labels.LANE
        stack = coarser(probabilities_of(label), factor)
        level = horizon_line(self.CAMERA, np.array([0.0, -1.0, 0.0]))
        free = masks_from_probabilities(stack, image, PLAIN)
        bound = masks_from_probabilities(stack, image, PLAIN, level)
        sky = slice(0, int(60 * factor))
        assert free.lane[sky].any()
        assert not bound.lane[sky].any()
        np.testing.assert_array_equal(bound.lane[sky.stop :], free.lane[sky.stop :])
        np.testing.assert_array_equal(bound.pole, free.pole)

    @pytest.mark.parametrize("scale", [(1.0, 1.0), (0.5, 0.25), (0.25, 0.5)])
    def test_a_slanted_horizon_on_a_coarse_grid(self, scale):
        shape = (int(80 * scale[1]), int(120 * scale[0]))
        line = np.array([-1.0, 1.0, 0.3])
        parameters = MaskParameters(crf=None, horizon_slack_px=0.0, lane_least_px2=0.0, lane_road=0.0)
        stack = probabilities_of(np.full(shape, labels.LANE))
        masks = masks_from_probabilities(stack, np.zeros((80, 120, 3), np.uint8), parameters, line)
        for row, column in np.ndindex(shape):
            u, v = (column + 0.5) / masks.scale_x - 0.5, (row + 0.5) / masks.scale_y - 0.5
            assert masks.lane[row, column] == (line @ [u, v, 1.0] > 0)

    def test_slack_is_in_px_of_the_reference_width(self):
        label = np.full((100, REFERENCE_WIDTH_PX * 2), labels.LANE)
        image = np.zeros((*label.shape, 3), np.uint8)
        line = np.array([0.0, 3.0, -3.0 * 70.0])
        parameters = MaskParameters(crf=None, horizon_slack_px=10.0, lane_road=0.0)
        masks = masks_from_probabilities(probabilities_of(label), image, parameters, line)
        assert np.flatnonzero(masks.lane.any(axis=1))[0] == 50

    def test_looking_straight_down(self):
        label = np.full((50, 60), labels.LANE)
        image = np.zeros((50, 60, 3), np.uint8)
        for sign, seen in ((1.0, True), (-1.0, False)):
            line = np.array([0.0, 0.0, sign])
            masks = masks_from_probabilities(probabilities_of(label), image, PLAIN, line)
            assert masks.lane.all() == seen

    @pytest.mark.parametrize("line", [np.zeros(3), np.array([0.0, np.nan, 1.0]), np.ones(2)])
    def test_no_line(self, line):
        stack = probabilities_of(np.full((9, 9), labels.ROAD))
        with pytest.raises(InputError, match="horizon"):
            masks_from_probabilities(stack, np.zeros((9, 9, 3), np.uint8), PLAIN, line)


class TestRefusals:
    GOOD = probabilities_of(np.full((6, 8), labels.ROAD))
    IMAGE = np.zeros((12, 16, 3), np.uint8)

    @pytest.mark.parametrize("value", [np.nan, np.inf, -0.5, 1.5])
    def test_values(self, value):
        bad = self.GOOD.copy()
        bad[3, 2, 1] = value
        for parameters in (PLAIN, MaskParameters()):
            with pytest.raises(InputError, match="probabilities reach"):
                masks_from_probabilities(bad, self.IMAGE, parameters)

    @pytest.mark.parametrize("bad", [GOOD[:3], GOOD[0], GOOD.astype(np.float64), GOOD[:, :0]])
    def test_probabilities(self, bad):
        with pytest.raises(InputError, match="no float32"):
            masks_from_probabilities(bad, self.IMAGE, PLAIN)

    @pytest.mark.parametrize("bad", [IMAGE[..., 0], IMAGE[:0], IMAGE.astype(np.float32), IMAGE[..., :2]])
    def test_image(self, bad):
        with pytest.raises(InputError, match="no uint8"):
            masks_from_probabilities(self.GOOD, bad, PLAIN)

    def test_parameters(self):
        with pytest.raises(RigError, match="lane_threshold"):
            MaskParameters(lane_threshold=1.5)
        with pytest.raises(RigError, match="margin_px"):
            MaskParameters(margin_px=np.nan)
        with pytest.raises(RigError, match="after the CRF"):
            ClassCrf(PUBLISHED, 1.5)

from dataclasses import replace

import cv2
import numpy as np
import pytest

from monitor.outputs._overlays import ESTIMATED_BGR, STORED_BGR, keep, overlay
from pipeline import se3
from pipeline.cameras import project
from pipeline.records import CameraImage, CameraModel


def with_drift(frame, *drift):
    T = se3.displaced(frame.T_stored, np.array(drift), se3.AXES_CAM_IN_VEHICLE)
    return replace(frame, T_estimated=T)


def decoded(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(float)


def share_of(picture, colour):
    return (np.abs(decoded(picture) - colour).sum(axis=2) < 90).mean()


def test_a_frame_without_an_estimate_is_not_kept(drive):
    assert keep(replace(drive().frame(40), T_estimated=None)) is None


def test_kept_points_are_those_that_either_extrinsic_puts_into_the_image(drive):
    frame = with_drift(drive().frame(40), 0, 0, 0.3, 0, 0, 0)
    kept = keep(frame)
    either = np.zeros(len(frame.edge_points), dtype=bool)
    for T in (frame.T_stored, frame.T_estimated):
        either |= project(frame.camera, se3.apply(T, frame.edge_points))[1]
    np.testing.assert_array_equal(kept.points, frame.edge_points[either])
    assert 0 < either.sum() < len(either)


def test_without_edges_the_cloud_stands_in_and_is_thinned(drive):
    many = np.repeat(drive().frame(40).points, 20, axis=0)
    kept = keep(replace(drive().frame(40), edge_points=many[:0], points=many))
    assert 10_000 < len(kept.points) <= 20_000


def test_places_tell_the_true_displacement_and_do_not_overlap(drive):
    frame = with_drift(drive().frame(40), 0.004, -0.003, 0.014, 0, 0.05, 0)
    shown = overlay(keep(frame), 3)
    assert len(shown.crops) == 3
    stored, in_stored = project(frame.camera, se3.apply(frame.T_stored, frame.edge_points))
    estimated, in_estimated = project(frame.camera, se3.apply(frame.T_estimated, frame.edge_points))
    for crop in shown.crops:
        place = crop.place
        low = np.array([place.left, place.top])
        high = low + np.array([place.width, place.height])
        assert (low >= 0).all()
        assert (high <= (frame.camera.width, frame.camera.height)).all()
        inside = in_stored & in_estimated
        for uv in (stored, estimated):
            inside &= ((uv >= low) & (uv < high)).all(axis=1)
        apart = np.hypot(*(stored - estimated)[inside].T)
        assert place.points == inside.sum()
        assert place.apart_px == pytest.approx(np.median(apart))
    boxes = [crop.place for crop in shown.crops]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        one, other = boxes[a], boxes[b]
        assert abs(one.left - other.left) >= one.width or abs(one.top - other.top) >= one.height


def test_each_side_shows_its_own_colour_at_the_points(drive):
    crop = overlay(keep(drive().frame(40)), 1).crops[0]
    assert share_of(crop.stored, STORED_BGR) > 0.005
    assert share_of(crop.estimated, ESTIMATED_BGR) > 0.005
    assert share_of(crop.stored, ESTIMATED_BGR) < 0.001
    assert share_of(crop.estimated, STORED_BGR) < 0.001


def test_points_are_drawn_where_they_project_to(drive):
    # One column of points far from all lines, in a flat image: the dots' centre of mass is their projection.
    frame = drive().frame(10)
    z = np.linspace(-0.3, 0.3, 12)
    points = np.column_stack([np.full(12, 12.0), np.full(12, 0.7), z]).astype(np.float32)
    pixels = np.full((frame.camera.height, frame.camera.width, 3), 90, dtype=np.uint8)
    pixels[:, ::40] = 100  # a place without any edge in the image is not chosen
    flat = CameraImage(pixels)
    shown = overlay(keep(replace(frame, image=flat, edge_points=points, matches=())), 1)
    crop = shown.crops[0] if shown.crops else None
    assert crop is not None
    picture = decoded(crop.stored)
    rows, columns = np.nonzero(np.abs(picture - STORED_BGR).sum(axis=2) < 90)
    zoom = picture.shape[1] / crop.place.width
    seen = (np.array([columns.mean(), rows.mean()]) + 0.5) / zoom - 0.5 + (crop.place.left, crop.place.top)
    uv, _ = project(frame.camera, se3.apply(frame.T_stored, points))
    np.testing.assert_allclose(seen, uv.mean(axis=0), atol=0.25)


def test_nothing_to_see_gives_the_picture_alone(drive):
    frame = drive().frame(40)
    behind = -np.abs(frame.edge_points)
    shown = overlay(keep(replace(frame, edge_points=behind)), 3)
    assert shown.crops == ()
    assert decoded(shown.overview).shape == (269, 860, 3)


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (3, 40), (4000, 30)])
def test_images_of_any_size(drive, size):
    width, height = size
    K = np.array([[300.0, 0, width / 2], [0, 300.0, height / 2], [0, 0, 1.0]])
    camera = CameraModel("pinhole", K, np.zeros(0), width, height)
    image = CameraImage(np.zeros((height, width, 3), dtype=np.uint8))
    shown = overlay(keep(replace(drive().frame(40), camera=camera, image=image)), 3)
    assert decoded(shown.overview).shape[1] == min(width, 860)

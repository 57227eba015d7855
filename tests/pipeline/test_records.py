import dataclasses

import numpy as np
import pytest

from pipeline.errors import InputError
from pipeline.records import (
    CameraImage,
    CameraModel,
    CloudLine,
    FramePair,
    ImageLine,
    Masks,
    PointCloud,
    WitnessEstimate,
    read_only,
)

K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
XYZ = np.ones((4, 3), np.float32)
P2, P3 = np.zeros(2), np.zeros(3)
HALF = np.zeros((2, 3), np.float32)
MASK = np.zeros((2, 3), np.bool_)

GOOD = {
    "cloud": lambda: PointCloud(
        XYZ.copy(), np.ones(4, np.float32), np.ones(4, np.uint16), np.ones(4, np.float32)
    ),
    "image": lambda: CameraImage(np.zeros((2, 3, 3), np.uint8)),
    "camera": lambda: CameraModel("plumb_bob", K.copy(), np.zeros(5), 1242, 375),
    "masks": lambda: Masks(MASK.copy(), MASK.copy(), HALF.copy(), HALF.copy(), 0.5, 0.5),
    "image_line": lambda: ImageLine("lane", P2.copy(), P2.copy(), 1.0),
    "cloud_line": lambda: CloudLine("pole", P3.copy(), P3.copy(), np.arange(4), 0.03, 1.0),
    "estimate": lambda: WitnessEstimate("lines", np.zeros(6), np.eye(6), 3, 12, 1.0),
}
"""A good value of every record that holds arrays."""


def arrays(record):
    fields = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}
    return {name: value for name, value in fields.items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize("kind", GOOD)
def test_values_do_not_change(kind):
    record = GOOD[kind]()
    assert arrays(record)
    for name, array in arrays(record).items():
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(record, name, array)


@pytest.mark.parametrize("kind", GOOD)
def test_every_array_is_refused_in_another_type_or_shape(kind):
    record = GOOD[kind]()
    for name, array in arrays(record).items():
        other = np.float32 if array.dtype != np.float32 else np.float64
        for wrong in (
            array.astype(other),
            array[None],
            array.reshape(-1)[:0].reshape((0,) * (array.ndim + 1)),
        ):
            with pytest.raises(InputError, match=f"{type(record).__name__}.{name}"):
                dataclasses.replace(record, **{name: wrong})


@pytest.mark.parametrize("name", ["intensity", "ring", "time"])
def test_fields_of_a_cloud_are_as_long_as_its_points(name):
    cloud = GOOD["cloud"]()
    with pytest.raises(InputError, match=name):
        dataclasses.replace(cloud, **{name: getattr(cloud, name)[:-1]})
    assert len(dataclasses.replace(cloud, **{name: None})) == 4
    assert len(PointCloud(XYZ[:0])) == 0


@pytest.mark.parametrize("name", ["pole", "lane_probability", "pole_probability"])
def test_masks_are_of_one_size(name):
    masks = GOOD["masks"]()
    with pytest.raises(InputError, match=name):
        dataclasses.replace(masks, **{name: getattr(masks, name).T})


@pytest.mark.parametrize(
    "change",
    [
        {"K": np.diag([0.0, 700, 1])},
        {"K": np.diag([700.0, -1, 1])},
        {"K": np.diag([700.0, 700, 0])},
        {"K": K * np.nan},
        {"K": np.where(K == 600, np.inf, K)},
        {"D": np.array([0.1, np.nan])},
        {"D": np.array([np.inf])},
        {"width": 0},
        {"height": -3},
    ],
)
def test_cameras_that_can_not_be(change):
    with pytest.raises(InputError):
        dataclasses.replace(GOOD["camera"](), **change)


def test_a_camera_matrix_without_focal_length_is_told_with_what_it_should_be():
    with pytest.raises(InputError) as told:
        dataclasses.replace(GOOD["camera"](), K=np.zeros((3, 3)))
    assert "focal length" in str(told.value)
    assert "fu" in told.value.hint


def test_size_is_width_then_height_and_gap_is_image_minus_cloud():
    image = GOOD["image"]()
    assert image.size == (3, 2)
    assert FramePair("front", GOOD["cloud"](), image, 100, 130).gap_ns == 30


def test_a_view_shares_its_memory_and_leaves_the_owner_writable():
    array = np.zeros(3)
    view = read_only(array)
    array[0] = 1
    assert view[0] == 1
    with pytest.raises(ValueError, match="read-only"):
        view[0] = 2


def test_records_compare_as_themselves():
    # == on arrays raises where one answer is wanted; a record is equal to itself alone.
    cloud = GOOD["cloud"]()
    assert cloud == cloud  # noqa: PLR0124 - that is what is tested
    assert cloud != GOOD["cloud"]()

import itertools

import numpy as np
import pytest
from hypothesis import given

from monitor.messages import Message, decode
from monitor.messages.point_cloud2 import encode_point_cloud2
from pipeline.errors import InputError
from tests import strategies
from tests.monitor.messages import wire

TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
XYZ = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12], [13, 14, 15], [16, 17, 18]], np.float64)

LAYOUTS = {
    "x y z": [("x", "f4"), ("y", "f4"), ("z", "f4")],
    "z x y": [("z", "f4"), ("x", "f4"), ("y", "f4")],
    "padded": [("x", "f4"), ("_", "i1"), ("y", "f4"), ("_", "i2"), ("z", "f4"), ("_", "i4")],
    "float64": [("x", "f8"), ("y", "f8"), ("z", "f8")],
    "mixed types": [("x", "i1"), ("y", "u2"), ("z", "i4")],
    "unsigned": [("x", "u1"), ("y", "u4"), ("z", "i2")],
    "others between": [("rgb", "u4"), ("x", "f4"), ("nx", "f4"), ("y", "f4"), ("z", "f4")],
    "upper case": [("X", "f4"), ("Y", "f4"), ("Z", "f4")],
}


def packed(columns, layout, *, big=False):
    """Points packed without gaps in the order of ``layout``; fields without a column hold 7s."""
    order = ">" if big else "<"
    dtype = np.dtype(
        {"names": [f"{k}" for k in range(len(layout))], "formats": [order + t for _, t in layout]}
    )
    points = np.zeros(len(next(iter(columns.values()))), dtype)
    fields = []
    for k, (name, kind) in enumerate(layout):
        points[f"{k}"] = columns.get(name.lower(), 7)
        fields.append((name, int(dtype.fields[f"{k}"][1]), TYPES[kind]))
    return fields, points


def cloud_of(columns, layout, **options):
    """Decodes a flat cloud of these columns."""
    fields, points = packed(columns, layout)
    message = wire.point_cloud2(
        fields, points.tobytes(), width=len(points), point_step=points.dtype.itemsize, **options
    )
    return decode(message)[0].value


def with_xyz(**columns):
    count = len(next(iter(columns.values())))
    return {axis: np.arange(1, count + 1) for axis in "xyz"} | columns


@pytest.mark.parametrize(
    ("layout", "encoding", "big", "shape"),
    list(itertools.product(LAYOUTS, wire.WIRES, [False, True], ["6x1", "3x2", "3x2 rows padded"])),
    ids=lambda value: value if isinstance(value, str) else ("big" if value else "little"),
)
def test_every_layout_gives_the_same_points(layout, encoding, big, shape):
    columns = dict(zip("xyz", XYZ.T, strict=True))
    fields, points = packed(columns, LAYOUTS[layout], big=big)
    step = points.dtype.itemsize
    height = 2 if shape.startswith("3x2") else 1
    width = len(points) // height
    pad = 5 if shape.endswith("padded") else 0
    rows = [row.tobytes() + bytes(pad) for row in points.reshape(height, width)]
    message = wire.point_cloud2(
        fields,
        b"".join(rows),
        width=width,
        height=height,
        point_step=step,
        row_step=width * step + pad,
        big=big,
        wire=encoding,
    )
    (decoded,) = decode(message)
    assert np.array_equal(decoded.value.xyz, XYZ.astype(np.float32))
    assert (decoded.stamp_ns, decoded.frame) == (wire.STAMP_NS, "lidar")
    assert decoded.value.intensity is decoded.value.ring is decoded.value.time is None


def test_invalid_points_leave_every_array_together():
    nan, inf = np.nan, np.inf
    columns = {
        "x": np.array([1, nan, 0, 2, inf, 0]),
        "y": np.array([1, 0, 0, -inf, 0, 0]),
        "z": np.array([1, 0, 0, 2, 0, 5]),
        "intensity": np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
        "ring": np.arange(6),
        "t": np.arange(6) * 10**7,
    }
    layout = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2"), ("t", "u4")]
    cloud = cloud_of(columns, layout)
    assert cloud.xyz.tolist() == [[1, 1, 1], [0, 0, 5]]
    assert cloud.intensity == pytest.approx([0.1, 0.6])
    assert cloud.ring.tolist() == [0, 5]
    assert cloud.time == pytest.approx([0.0, 0.05])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1.1e4, -3e38])
@pytest.mark.parametrize("axis", "xyz")
def test_one_coordinate_that_is_no_place_drops_the_point(axis, value):
    columns = with_xyz(intensity=np.array([0.1, 0.2])) | {axis: np.array([value, 2])}
    assert cloud_of(columns, [*LAYOUTS["x y z"], ("intensity", "f4")]).xyz.tolist() == [[2, 2, 2]]


@pytest.mark.parametrize("axis", "xyz")
def test_a_point_on_an_axis_is_no_empty_return(axis):
    columns = {name: np.array([5.0 * (name == axis)]) for name in "xyz"}
    assert len(cloud_of(columns, LAYOUTS["x y z"])) == 1


def test_float64_beyond_float32_is_dropped_without_a_warning():
    cloud = cloud_of({"x": np.array([1e300, 1.0]), "y": np.ones(2), "z": np.ones(2)}, LAYOUTS["float64"])
    assert cloud.xyz.tolist() == [[1, 1, 1]]


def test_a_leading_slash_of_the_frame_is_dropped():
    fields, points = packed({"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2]}, LAYOUTS["x y z"])
    message = wire.point_cloud2(fields, points.tobytes(), width=6, point_step=12, frame="/velo", wire="ros1")
    assert decode(message)[0].frame == "velo"


@pytest.mark.parametrize("encoding", wire.WIRES)
def test_an_empty_cloud_is_a_cloud(encoding):
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("t", 18, 6)]
    message = wire.point_cloud2(fields, b"", width=0, point_step=22, wire=encoding)
    cloud = decode(message)[0].value
    assert len(cloud) == len(cloud.intensity) == len(cloud.ring) == len(cloud.time) == 0


GOOD = {
    "fields": [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)],
    "data": np.ones(12, "<f4").tobytes(),
    "width": 4,
    "point_step": 12,
}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"fields": GOOD["fields"][1:]}, "no field x"),
        ({"fields": []}, "no field x, y, z"),
        ({"row_step": 47}, "rows of 47 bytes"),
        ({"row_step": 0}, "rows of 0 bytes"),
        ({"data": GOOD["data"][:-1]}, "need 48 bytes, the data have 47"),
        ({"height": 2}, "need 96 bytes"),
        ({"height": 2**32 - 1}, "need"),
        ({"width": 2**32 - 1, "row_step": 2**32 - 1}, "rows of"),
        ({"point_step": 0}, "ends at byte"),
        ({"point_step": 11}, "ends at byte 12"),
        ({"fields": [("x", 2**32 - 1, 7), *GOOD["fields"][1:]]}, "ends at byte"),
        ({"fields": [("x", 0, 9), *GOOD["fields"][1:]]}, "unknown type number 9"),
    ],
)
def test_what_does_not_fit_is_refused_with_topic_and_reason(change, said):
    with pytest.raises(InputError, match=said) as error:
        decode(wire.point_cloud2(**(GOOD | change)))
    assert "topic /topic" in error.value.what


def test_a_field_that_nobody_reads_may_be_of_any_type():
    message = wire.point_cloud2(**(GOOD | {"fields": [*GOOD["fields"], ("label", 900, 77)]}))
    assert len(decode(message)[0].value) == 4


def test_the_cloud_owns_its_arrays():
    layout = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2"), ("time", "f4")]
    columns = with_xyz(intensity=np.array([0.1, 0.2]), ring=np.array([1, 2]), time=np.array([0.0, 0.1]))
    fields, points = packed(columns, layout)
    message = wire.point_cloud2(fields, points.tobytes(), width=2, point_step=points.dtype.itemsize)
    cloud = decode(message)[0].value
    transport = np.frombuffer(message.data, np.uint8)
    for array in (cloud.xyz, cloud.intensity, cloud.ring, cloud.time):
        assert not np.shares_memory(array, transport)
        assert not array.flags.writeable


@given(strategies.clouds(), strategies.stamps_ns, strategies.frames)
def test_what_is_written_is_read_back(cloud, stamp_ns, frame):
    data = encode_point_cloud2(cloud, stamp_ns, frame)
    (decoded,) = decode(Message("/t", "sensor_msgs/msg/PointCloud2", "cdr", data, 0))
    assert (decoded.stamp_ns, decoded.frame) == (stamp_ns, frame)
    back = decoded.value
    assert np.array_equal(back.xyz, cloud.xyz)
    assert (back.ring is None) == (cloud.ring is None)
    assert cloud.ring is None or np.array_equal(back.ring, cloud.ring)
    assert cloud.intensity is None or np.array_equal(back.intensity, cloud.intensity)
    assert cloud.time is None or back.time == pytest.approx(cloud.time, abs=1e-7)

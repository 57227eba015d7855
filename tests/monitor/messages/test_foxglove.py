import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from monitor.messages import Message, decode
from monitor.messages.image import encode_compressed_image
from pipeline.errors import InputError
from pipeline.records import CameraImage

STAMP = Timestamp(seconds=1_600_000_000, nanos=5)
STAMP_NS = 1_600_000_000_000_000_005
HALF = np.sqrt(0.5)


def decoded(message, topic="/topic"):
    name = message.DESCRIPTOR.full_name
    return decode(Message(topic, name, "protobuf", message.SerializeToString(), 0))


def cloud(layout, points, **more):
    """``layout``: name, NumPy type, Foxglove type number."""
    dtype = np.dtype([(name, kind) for name, kind, _ in layout])
    packed = np.array(points, dtype)
    fields = [
        PackedElementField(name=name, offset=dtype.fields[name][1], type=number) for name, _, number in layout
    ]
    return PointCloud(
        timestamp=STAMP,
        frame_id="lidar",
        point_stride=dtype.itemsize,
        fields=fields,
        data=packed.tobytes(),
        **more,
    )


XYZI = [("x", "<f4", 7), ("y", "<f4", 7), ("z", "<f4", 7), ("intensity", "u1", 1)]
POINTS = [(1, 2, 3, 0), (0, 0, 0, 9), (4, 5, 6, 255)]


def test_a_cloud():
    (found,) = decoded(cloud(XYZI, POINTS))
    assert (found.stamp_ns, found.frame) == (STAMP_NS, "lidar")
    assert found.value.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert found.value.intensity.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("kind", "number"),
    [("u1", 1), ("i1", 2), ("<u2", 3), ("<i2", 4), ("<u4", 5), ("<i4", 6), ("<f4", 7), ("<f8", 8)],
)
def test_every_type_of_number(kind, number):
    layout = [("pad", "u1", 0), *((axis, kind, number) for axis in "zyx")]
    assert decoded(cloud(layout, [(9, 1, 2, 3)]))[0].value.xyz.tolist() == [[3, 2, 1]]


def test_the_pose_of_a_cloud_is_applied():
    pose = Pose(position=Vector3(x=10), orientation=Quaternion(z=HALF, w=HALF))
    found = decoded(cloud(XYZI, POINTS[:1], pose=pose))[0].value
    assert found.xyz[0] == pytest.approx([10 - 2, 1, 3])
    assert found.intensity.tolist() == [0]
    unturned = decoded(cloud(XYZI, POINTS[:1], pose=Pose(position=Vector3(x=10))))[0].value
    assert unturned.xyz[0] == pytest.approx([11, 2, 3])


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (cloud(XYZI[1:], [(1, 2, 3)]), "no field x"),
        (cloud([("x", "<f4", 0), *XYZI[1:]], POINTS), "unknown type number 0"),
        (PointCloud(point_stride=0), "whole number of points"),
        (PointCloud(point_stride=5, data=bytes(12)), "whole number of points"),
        (cloud(XYZI, POINTS, pose=Pose(position=Vector3(x=np.nan))), "no motion"),
        (cloud(XYZI, POINTS, pose=Pose(orientation=Quaternion())), "no motion"),
        (cloud(XYZI, POINTS, pose=Pose(position=Vector3(x=1e300))), "out of reach"),
    ],
)
def test_clouds_that_do_not_fit_are_refused(message, said):
    with pytest.raises(InputError, match=said):
        decoded(message)


@pytest.mark.parametrize("stamp", [Timestamp(seconds=2**62), Timestamp(seconds=-1), Timestamp(nanos=-1)])
def test_stamps_that_are_no_date_are_refused(stamp):
    message = cloud(XYZI, POINTS)
    message.timestamp.CopyFrom(stamp)
    with pytest.raises(InputError, match="no date"):
        decoded(message)


def test_images():
    pixels = np.random.default_rng(2).integers(0, 256, (4, 6, 3), np.uint8)
    raw = RawImage(timestamp=STAMP, frame_id="cam", width=6, height=4, encoding="rgb8", step=18)
    raw.data = pixels[:, :, ::-1].tobytes()
    (found,) = decoded(raw)
    assert np.array_equal(found.value.pixels, pixels)
    ros = encode_compressed_image(CameraImage(pixels), 0, "", "png")
    packed = CompressedImage(timestamp=STAMP, frame_id="cam", format="png", data=ros[ros.index(b"\x89PNG") :])
    (found,) = decoded(packed)
    assert np.array_equal(found.value.pixels, pixels)
    assert (found.stamp_ns, found.frame) == (STAMP_NS, "cam")


K = [700.0, 0, 320, 0, 710, 240, 0, 0, 1]
P = [650.0, 0, 300, -45, 0, 655, 230, 0, 0, 0, 1, 0]


@pytest.mark.parametrize(("p", "rectified"), [(P, True), ([], False), ([0.0] * 12, False)])
def test_calibrations(p, rectified):
    message = CameraCalibration(
        timestamp=STAMP,
        frame_id="cam",
        width=640,
        height=480,
        distortion_model="kannala_brandt",
        D=[0.1, 0.2, 0.3, 0.4],
        K=K,
        P=p,
    )
    info = decoded(message)[0].value
    assert (info.raw.model, info.raw.D.tolist()) == ("equidistant", [0.1, 0.2, 0.3, 0.4])
    assert info.raw.K.tolist() == np.reshape(K, (3, 3)).tolist()
    assert (info.rectified is not None) == rectified
    assert not rectified or info.rectified.K[:, 2].tolist() == [300, 230, 1]


@pytest.mark.parametrize(("k", "p"), [([], []), (K[:8], []), (K, P[:9])])
def test_calibrations_of_other_lengths_are_refused(k, p):
    with pytest.raises(InputError, match="wanted 9 and 12"):
        decoded(CameraCalibration(width=640, height=480, K=k, P=p))


def test_transforms():
    turned = FrameTransform(
        timestamp=STAMP,
        parent_frame_id="base",
        child_frame_id="lidar",
        translation=Vector3(x=1, y=2, z=3),
        rotation=Quaternion(z=HALF, w=HALF),
    )
    (found,) = decoded(turned, "/tf_static")
    assert (found.value.parent, found.value.child, found.value.static) == ("base", "lidar", True)
    assert found.value.T_parent_child @ [1, 0, 0, 1] == pytest.approx([1, 3, 3, 1])
    unturned = FrameTransform(timestamp=STAMP, parent_frame_id="base", child_frame_id="cam")
    both = decoded(FrameTransforms(transforms=[turned, unturned]), "/tf")
    assert [one.value.child for one in both] == ["lidar", "cam"]
    assert np.array_equal(both[1].value.T_parent_child, np.eye(4))
    assert not both[1].value.static


def test_a_zero_quaternion_is_refused_with_its_frames():
    message = FrameTransform(parent_frame_id="a", child_frame_id="b", rotation=Quaternion())
    with pytest.raises(InputError, match="transform 'a' -> 'b'"):
        decoded(message)


def test_another_encoding_is_refused():
    with pytest.raises(InputError, match="in json encoding"):
        decode(Message("/t", "foxglove.PointCloud", "json", b"{}", 0))

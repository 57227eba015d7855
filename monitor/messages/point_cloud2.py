"""sensor_msgs/PointCloud2: any field order, type, padding and byte order, organised or not."""

import numpy as np
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointField as PointField

from monitor.messages import Codec, Decoded, Message, ros
from monitor.messages.point_fields import KNOWN, Field, Packing, cloud_of, packed_columns
from pipeline.errors import InputError
from pipeline.records import PointCloud

TYPE = "sensor_msgs/msg/PointCloud2"
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def decode(message: Message) -> tuple[Decoded, ...]:
    """The cloud of a PointCloud2; :mod:`monitor.messages.point_fields` says what its fields mean.

    Raises:
        InputError: No PointCloud2, no x, y, z, a field type that is not known, or steps that do not fit.
    """
    msg = ros.deserialize(message, PointCloud2, TYPE)
    order = ">" if msg.is_bigendian else "<"
    fields = [
        Field(field.name, field.offset, _dtype(field, order))
        for field in msg.fields
        if field.name.lower() in KNOWN
    ]
    columns = packed_columns(msg.data, Packing(msg.width, msg.height, msg.point_step, msg.row_step, fields))
    stamp_ns = ros.stamp_ns(msg.header.stamp)
    return (Decoded(stamp_ns, ros.frame_name(msg.header.frame_id), cloud_of(columns, stamp_ns)),)


def encode_point_cloud2(cloud: PointCloud, stamp_ns: int, frame: str) -> bytes:
    """A PointCloud2 in CDR with the fields that the cloud has.

    Args:
        cloud: The sweep.
        stamp_ns: Its stamp, ns.
        frame: Frame id.
    """
    columns = {
        "x": cloud.xyz[:, 0],
        "y": cloud.xyz[:, 1],
        "z": cloud.xyz[:, 2],
        "intensity": cloud.intensity,
        "time": cloud.time,
        "ring": cloud.ring,
    }
    present = {name: column for name, column in columns.items() if column is not None}
    packed = np.empty(
        len(cloud), np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in present.items()])
    )
    for name, column in present.items():
        packed[name] = column
    sizes = [column.itemsize for column in present.values()]
    fields = [
        PointField(name, offset, PointField.UINT16 if name == "ring" else PointField.FLOAT32, 1)
        for name, offset in zip(present, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True)
    ]
    step = packed.dtype.itemsize
    msg = PointCloud2(
        header=ros.header(stamp_ns, frame),
        height=1,
        width=len(cloud),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(cloud),
        data=packed.view(np.uint8),
        is_dense=True,
    )
    return ros.serialize(msg, TYPE)


def _dtype(field: PointField, order: str) -> np.dtype[np.generic]:
    if field.datatype not in _DATATYPES:
        raise InputError(f"field '{field.name}' has the unknown type number {field.datatype}")
    return np.dtype(order + _DATATYPES[field.datatype])


CODECS: dict[str, Codec] = {TYPE: decode}

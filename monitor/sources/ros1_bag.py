"""ROS 1: .bag files of version 2.0, read by rosbags; type names become ``pkg/msg/Name`` as in ROS 2."""

from pathlib import Path

from rosbags.rosbag1 import Reader

from monitor.sources.mcap_file import starts_with
from monitor.sources.rosbag2_folder import RosbagSource
from pipeline.errors import InputError

MAGIC = b"#ROSBAG V"


class Ros1Kind:
    """Kind of source: ROS 1 bags."""

    name = "ros1_bag"

    def matches(self, location: str) -> bool:
        """A file that is called .bag or starts like one."""
        path = Path(location)
        return path.suffix.lower() == ".bag" or (path.is_file() and starts_with(path, MAGIC))

    def open(self, location: str) -> RosbagSource:
        """Opens the bag."""
        path = Path(location)
        if not path.is_file():
            raise InputError(f"{path} does not exist")
        if not starts_with(path, MAGIC):
            what = "is empty" if path.stat().st_size == 0 else "is no ROS 1 bag"
            raise InputError(f"{path} {what}", hint="a bag starts with '#ROSBAG V2.0'")
        return RosbagSource(path, Reader(path), "ros1")


SOURCE = Ros1Kind()

"""``calib.json`` of a recordings folder: ``camera`` and ``T_cam_lidar``."""

from monitor.extrinsic_formats import Choice, Document, Format, Reading, defined, directed, rigid, table
from monitor.rig import calib_document
from pipeline.errors import InputError


class CalibJson:
    """calib.json."""

    name = "calib"
    title = "calib.json of a recordings folder"

    def matches(self, document: Document) -> bool:
        """An object with ``camera`` and ``T_cam_lidar``."""
        return {"camera", "T_cam_lidar"} <= table(document.data).keys()

    def read(self, document: Document, choice: Choice) -> Reading:
        """The matrix and the intrinsics, as they stand."""
        calib = table(document.data)
        rig = calib_document(calib, where=str(document.path))
        pair = rig["pairs"][0] if isinstance(rig["pairs"], list) else {}
        direction = defined(choice, "T_cam_lidar", "by its key")
        T, read_as = directed(rigid(calib["T_cam_lidar"], "T_cam_lidar"), direction, "by its key")
        name = pair["name"]
        if not isinstance(name, str):
            raise InputError(f"{document.path}: camera_name is {name!r}")
        camera = {key: value for key, value in pair["camera"].items() if value is not None}
        vehicle = calib.get("T_vehicle_lidar")
        return Reading(
            T,
            read_as,
            camera=camera,
            name=name,
            T_vehicle_lidar=None if vehicle is None else rigid(vehicle, "T_vehicle_lidar"),
        )


FORMAT: Format = CalibJson()

"""The label contract between training and run time: class order, names, colours. Imports nothing."""

VERSION = "1"
"""Changes with the order or meaning of a class; the .onnx carries it and a mismatch is refused."""

IGNORE = 255
"""Label value of pixels that take no part in training or evaluation."""

NAMES = ("other", "lane", "pole", "road", "vehicle", "construction", "vegetation", "sky", "sign")
"""Class names in the order of the network's output channels."""

OTHER, LANE, POLE, ROAD, VEHICLE, CONSTRUCTION, VEGETATION, SKY, SIGN = range(len(NAMES))

COLOURS_RGB = (
    (90, 90, 90),
    (255, 220, 0),
    (230, 40, 230),
    (70, 60, 110),
    (30, 90, 230),
    (140, 90, 60),
    (60, 140, 60),
    (140, 190, 230),
    (240, 120, 30),
)
"""One drawing colour per class, RGB 0..255."""

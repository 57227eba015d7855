"""Hypothesis strategies of the values that messages carry."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from monitor.messages import Transform
from pipeline.records import CameraImage, CameraModel, PointCloud

stamps_ns = st.integers(0, 2**31 * 10**9 - 1)
frames = st.text("abcdefghijklmnopqrstuvwxyz_0123456789", min_size=1, max_size=20)
metres = st.floats(-1e4, 1e4, width=32)


@st.composite
def clouds(draw, most=20):
    """Clouds with any combination of fields, without points that mean 'no return'."""
    count = draw(st.integers(0, most))
    xyz = draw(hnp.arrays(np.float32, (count, 3), elements=metres))
    xyz[~xyz.any(axis=1)] = 1
    unit = hnp.arrays(np.float32, count, elements=st.floats(0, 1, width=32))
    times = hnp.arrays(np.float32, count, elements=st.floats(-0.125, 0.125, width=32).map(abs), unique=True)
    rings = hnp.arrays(np.uint16, count)
    return PointCloud(
        xyz,
        draw(st.none() | unit),
        draw(st.none() | rings),
        draw(st.none() | times) if count != 1 else None,  # one time alone tells nothing and is left out
    )


@st.composite
def images(draw):
    """Images of 1 to 12 px a side."""
    shape = (draw(st.integers(1, 12)), draw(st.integers(1, 12)), 3)
    return CameraImage(draw(hnp.arrays(np.uint8, shape)))


@st.composite
def cameras(draw):
    """Cameras of every model, with the number of coefficients that the model has."""
    model, count = draw(
        st.sampled_from([("pinhole", 0), ("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4)])
    )
    width, height = draw(st.integers(1, 8000)), draw(st.integers(1, 8000))
    focal, centre = st.floats(1, 1e4), st.floats(-1e4, 1e4)
    K = np.array([[draw(focal), 0, draw(centre)], [0, draw(focal), draw(centre)], [0, 0, 1]])
    D = draw(hnp.arrays(np.float64, count, elements=st.floats(0.001, 1)))
    return CameraModel(model, K, D, width, height)


@st.composite
def motions(draw):
    """Rigid motions, float64 (4,4)."""
    turn = draw(hnp.arrays(np.float64, 3, elements=st.floats(-np.pi, np.pi)))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = draw(hnp.arrays(np.float64, 3, elements=st.floats(-1e3, 1e3)))
    return T


@st.composite
def transforms(draw):
    """Transforms as a topic that is not static states them."""
    return Transform(draw(frames), draw(frames), draw(motions()), static=False)

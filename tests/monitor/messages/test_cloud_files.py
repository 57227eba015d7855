import itertools
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.messages import decode, lzf
from pipeline.errors import InputError
from tests.monitor.messages import cloud_files, wire

XYZ = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
LAYOUTS = {
    "xyz": [("x", "<f4"), ("y", "<f4"), ("z", "<f4")],
    "double and padding": [("_1", "u1", (3,)), ("z", "<f8"), ("_2", "<f4", (2,)), ("y", "<f8"), ("x", "<f8")],
    "count of 3": [("fpfh", "<f4", (3,)), ("x", "<f4"), ("y", "<f4"), ("z", "<f4")],
    "integers": [("x", "<i2"), ("y", "<i4"), ("z", "<u2")],
    "all fields": [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("ring", "<u2"),
        ("timestamp", "<f8"),
    ],
}
VALUES = {
    "x": [1, 4, 7],
    "y": [2, 5, 8],
    "z": [3, 6, 9],
    "intensity": [0, 51, 255],
    "ring": [0, 5, 63],
    "timestamp": [1.6e9, 1.6e9 + 0.05, 1.6e9 + 0.1],
}


def points_of(layout):
    points = np.zeros(3, layout)
    for name in points.dtype.names:
        if name in VALUES:
            points[name] = VALUES[name]
    return points


def check(cloud, layout):
    assert cloud.xyz.tolist() == XYZ
    if "ring" in np.dtype(layout).names:
        assert cloud.intensity.tolist() == pytest.approx([0, 0.2, 1])
        assert cloud.ring.tolist() == [0, 5, 63]
        assert cloud.time.tolist() == pytest.approx([0, 0.05, 0.1], abs=1e-6)
    else:
        assert cloud.intensity is cloud.ring is cloud.time is None


@pytest.mark.parametrize(
    ("layout", "kind"), list(itertools.product(LAYOUTS, ["ascii", "binary", "binary_compressed"]))
)
def test_pcd(layout, kind):
    message = wire.file(
        "pcd", cloud_files.pcd(points_of(LAYOUTS[layout]), kind), stamp_ns=1_600_000_000 * 10**9
    )
    (decoded,) = decode(message)
    check(decoded.value, LAYOUTS[layout])
    assert decoded.stamp_ns == 1_600_000_000 * 10**9


def test_an_organised_pcd_without_points_and_count():
    data = cloud_files.pcd(
        points_of(LAYOUTS["xyz"]), "binary", WIDTH="1", HEIGHT="3", POINTS="", COUNT="", VIEWPOINT=""
    )
    assert decode(wire.file("pcd", data))[0].value.xyz.tolist() == XYZ


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize(
    "changes",
    [
        {"POINTS": "4"},
        {"WIDTH": "4", "POINTS": "4"},
        {"WIDTH": "999999999999999", "POINTS": "999999999999999"},
        {"WIDTH": "2"},
        {"WIDTH": "-3"},
        {"WIDTH": "3.0"},
        {"SIZE": "4 4"},
        {"SIZE": "4 4 5"},
        {"SIZE": "999999999999 4 4"},
        {"TYPE": "F F"},
        {"TYPE": "F F Q"},
        {"COUNT": "1 1 0"},
        {"COUNT": "1 1 2"},
        {"FIELDS": "x y w"},
        {"FIELDS": ""},
        {"DATA": "gzip"},
    ],
    ids=str,
)
def test_pcd_headers_that_do_not_fit_the_file_are_refused(kind, changes):
    with pytest.raises(InputError):
        decode(wire.file("pcd", cloud_files.pcd(points_of(LAYOUTS["xyz"]), kind, **changes)))


def test_compressed_data_of_more_points_than_the_header_has_are_refused():
    data = cloud_files.pcd(points_of(LAYOUTS["xyz"]), "binary_compressed", WIDTH="2", POINTS="2")
    with pytest.raises(InputError, match="2 points of 12 bytes, the file declares 36"):
        decode(wire.file("pcd", data))


@pytest.mark.parametrize("word", [b"abc", b"1e", b"--1"])
def test_ascii_words_that_are_no_numbers_are_refused(word):
    for name, data in (
        ("pcd", cloud_files.pcd(points_of(LAYOUTS["xyz"]), "ascii")),
        ("ply", cloud_files.ply(points_of(LAYOUTS["xyz"]), "ascii")),
    ):
        assert b"7.0" in data
        with pytest.raises(InputError, match="field 'x'"):
            decode(wire.file(name, data.replace(b"7.0", word)))


def test_ascii_integers_beyond_their_type_are_refused():
    data = cloud_files.pcd(points_of([("x", "u1"), ("y", "u1"), ("z", "u1")]), "ascii")
    with pytest.raises(InputError, match="field 'z'"):
        decode(wire.file("pcd", data.replace(b"7 8 9", b"7 8 300")))


def test_lzf_copies_overlapping_runs():
    assert (
        lzf.decompress(memoryview(b"\x00a\xe0\x00\x00"), 10) == b"a" * 10
    )  # 1 literal, 9 from one byte back
    assert lzf.decompress(memoryview(b"\x02abc\x60\x02"), 8) == b"abcabcab"  # 5 bytes from three back
    assert lzf.decompress(memoryview(b"\x03abcd\x20\x03"), 7) == b"abcdabc"


def lzf_oracle(instructions):
    """What a list of literals (bytes) and copies (back, length) means, byte by byte."""
    packed, plain = bytearray(), bytearray()
    for one in instructions:
        if isinstance(one, bytes):
            packed += bytes([len(one) - 1]) + one
            plain += one
            continue
        back, length = min(one[0], len(plain)), one[1]
        if back == 0:
            continue
        short = length - 2
        packed += bytes([min(short, 7) << 5 | (back - 1) >> 8])
        packed += (bytes([short - 7]) if short >= 7 else b"") + bytes([(back - 1) & 255])
        for _ in range(length):
            plain.append(plain[-back])
    return bytes(packed), bytes(plain)


@given(st.lists(st.binary(min_size=1, max_size=32) | st.tuples(st.integers(1, 8192), st.integers(3, 264))))
def test_lzf_against_its_definition(instructions):
    packed, plain = lzf_oracle(instructions)
    assert lzf.decompress(memoryview(packed), len(plain)) == plain


@pytest.mark.parametrize("size", range(12))
@pytest.mark.parametrize("back", range(1, 8))
def test_lzf_that_refers_to_bytes_before_its_start_is_refused(back, size):
    with pytest.raises(InputError, match="before their start"):
        lzf.decompress(memoryview(b"\x00a" + bytes([0xA0, back])), max(size, 1))


@pytest.mark.parametrize(
    ("data", "size"),
    [
        pytest.param(b"\x00a", 2, id="too short"),
        pytest.param(b"\x01ab", 1, id="too long"),
        pytest.param(b"\x05ab", 6, id="literals cut"),
        pytest.param(b"\x00a\x20", 4, id="copy cut"),
        pytest.param(b"\x00a\x20\x05", 4, id="before the start"),
        pytest.param(b"\x00a", 2**32 - 1, id="4 GB of two bytes"),
    ],
)
def test_lzf_that_does_not_fit_is_refused(data, size):
    with pytest.raises(InputError):
        lzf.decompress(memoryview(data), size)


PLY_LAYOUTS = {name: LAYOUTS[name] for name in ("xyz", "integers", "all fields")}


@pytest.mark.parametrize("eol", ["\n", "\r\n"], ids=["lf", "crlf"])
@pytest.mark.parametrize(
    ("layout", "form"),
    list(itertools.product(PLY_LAYOUTS, ["ascii", "binary_little_endian", "binary_big_endian"])),
)
def test_ply(layout, form, eol):
    data = cloud_files.ply(points_of(PLY_LAYOUTS[layout]), form, eol=eol)
    check(decode(wire.file("ply", data))[0].value, PLY_LAYOUTS[layout])


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply_elements_before_and_behind_the_vertices(form):
    before = "element camera 2\nproperty float focal\nproperty uchar id"
    after = "element face 1\nproperty list uchar int vertex_indices"
    head = b"1 2\n3 4\n" if form == "ascii" else struct.pack("<fBfB", 1, 2, 3, 4)
    tail = b"\n3 0 1 2\n" if form == "ascii" else struct.pack("<Biii", 3, 0, 1, 2)
    data = cloud_files.ply(points_of(LAYOUTS["xyz"]), form, before=before, after=after, head=head) + tail
    assert decode(wire.file("ply", data))[0].value.xyz.tolist() == XYZ


GOOD_PLY = cloud_files.ply(points_of(LAYOUTS["xyz"]), "binary_little_endian")


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(GOOD_PLY[:-1], id="cut short"),
        pytest.param(GOOD_PLY.replace(b"vertex 3", b"vertex 4"), id="more vertices"),
        pytest.param(GOOD_PLY.replace(b"vertex 3", b"vertex 999999999999999"), id="hostile count"),
        pytest.param(GOOD_PLY.replace(b"vertex 3", b"vertex -1"), id="negative count"),
        pytest.param(GOOD_PLY.replace(b"element vertex", b"element corner"), id="no vertices"),
        pytest.param(
            GOOD_PLY.replace(b"property float x", b"property list uchar int x"), id="list in vertex"
        ),
        pytest.param(GOOD_PLY.replace(b"property float x", b"property quad x"), id="unknown type"),
        pytest.param(GOOD_PLY.replace(b"float x", b"float w"), id="no x"),
        pytest.param(GOOD_PLY.replace(b"binary_little_endian", b"binary_middle_endian"), id="unknown format"),
        pytest.param(GOOD_PLY.replace(b"end_header", b"end_footer"), id="no end"),
        pytest.param(b"plywood", id="another file"),
    ],
)
def test_ply_that_does_not_fit_is_refused(data):
    with pytest.raises(InputError):
        decode(wire.file("ply", data))


def test_kitti_bin():
    values = np.array([[1, 2, 3, 0.99], [0, 0, 0, 0], [4, 5, 6, 0.25]], "<f4")
    (decoded,) = decode(wire.file("bin", values.tobytes(), stamp_ns=7))
    assert decoded.value.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert decoded.value.intensity.tolist() == values[[0, 2], 3].tolist()
    assert decoded.value.ring is decoded.value.time is None
    assert (decoded.stamp_ns, decoded.frame) == (7, "")


def test_nuscenes_bin():
    values = np.array([[1, 2, 3, 255, 31], [4, 5, 6, 51, 0]], "<f4")
    cloud = decode(wire.file("pcd.bin", values.tobytes()))[0].value
    assert cloud.intensity.tolist() == pytest.approx([1, 0.2])
    assert cloud.ring.tolist() == [31, 0]


@pytest.mark.parametrize(("kind", "size"), [("bin", 15), ("bin", 20), ("pcd.bin", 16)])
def test_bins_of_other_lengths_are_refused(kind, size):
    with pytest.raises(InputError, match="not a whole number of points"):
        decode(wire.file(kind, bytes(size)))


@pytest.mark.parametrize("order", ["C", "F"])
def test_npz(order):
    data = cloud_files.npz(
        xyz=np.array(XYZ, np.float32, order=order),
        intensity=np.array([0, 51, 255], np.float32),
        ring=np.array([0, 5, 63], np.uint8),
        time=np.array([0, 0.05, 0.1], np.float32),
        labels=np.array(["a", "b"]),
    )
    check(decode(wire.file("npz", data))[0].value, LAYOUTS["all fields"])


def npy(header, body=b""):
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"PK\x03\x04", id="no archive"),
        pytest.param(cloud_files.npz(points=np.zeros((3, 3))), id="no xyz"),
        pytest.param(cloud_files.npz(xyz=np.zeros((3, 4))), id="four columns"),
        pytest.param(cloud_files.npz(xyz=np.zeros(9)), id="one dimension"),
        pytest.param(cloud_files.npz(xyz=np.zeros((3, 3)), ring=np.zeros(2)), id="unequal lengths"),
        pytest.param(cloud_files.npz(xyz=np.array([[None] * 3])), id="objects, a pickle inside"),
        pytest.param(cloud_files.npz(xyz=np.zeros((3, 3), complex)), id="complex"),
        pytest.param(cloud_files.zipped(xyz=b"\x93NUMPY"), id="array cut short"),
        pytest.param(
            cloud_files.zipped(
                xyz=npy("{'descr': '<f4', 'fortran_order': f(), 'shape': (3, 3), }\n", bytes(36))
            ),
            id="code in the header",
        ),
    ],
)
def test_archives_that_do_not_fit_are_refused(data):
    with pytest.raises(InputError):
        decode(wire.file("npz", data))


@pytest.mark.parametrize("points", [2, 4, 99_999_999_999])
def test_arrays_of_another_size_than_declared_are_refused(points):
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({points}, 3), }}\n"
    with pytest.raises(InputError, match=rf"declares \({points}, 3\) of float32, has 36 bytes"):
        decode(wire.file("npz", cloud_files.zipped(xyz=npy(header, bytes(36)))))


def test_an_archive_that_declares_too_much_is_refused_unread():
    data = bytearray(cloud_files.npz(xyz=np.zeros((3, 3), np.float32)))
    at = data.index(b"PK\x01\x02")
    data[at + 24 : at + 28] = struct.pack("<I", 2**31)
    with pytest.raises(InputError, match="declares 2147483648 bytes"):
        decode(wire.file("npz", bytes(data)))

import contextlib
import itertools
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given

from monitor.messages import Message, decode
from monitor.messages.image import encode_compressed_image
from monitor.messages.picture import picture_size
from pipeline.errors import InputError
from tests import strategies
from tests.monitor.messages import wire

BGR = np.random.default_rng(4).integers(0, 256, (4, 6, 3), np.uint8)
GREY = BGR[:, :, 0]
ALPHA = np.full((4, 6, 1), 9, np.uint8)


def colour(blue, green, red):
    return np.full((4, 6, 3), (blue, green, red), np.uint8)


def mosaic(pattern):
    """One solid colour, (B, G, R) = (40, 90, 200), behind a Bayer filter."""
    values = {"b": 40, "g": 90, "r": 200}
    cell = np.array([values[letter] for letter in pattern], np.uint8).reshape(2, 2)
    return np.tile(cell, (2, 3))


EXACT = {
    "bgr8": (BGR, BGR),
    "rgb8": (BGR[:, :, ::-1], BGR),
    "bgra8": (np.dstack([BGR, ALPHA]), BGR),
    "rgba8": (np.dstack([BGR[:, :, ::-1], ALPHA]), BGR),
    "8UC3": (BGR, BGR),
    "mono8": (GREY, np.dstack([GREY] * 3)),
    "8UC1": (GREY, np.dstack([GREY] * 3)),
    **{f"bayer_{p}8": (mosaic(p), colour(40, 90, 200)) for p in ("rggb", "bggr", "gbrg", "grbg")},
}


def widened(pixels):
    """16 bits whose upper byte is the pixel; the lower one would show if the bytes were swapped."""
    return (pixels.astype(np.uint16) << 8) | 0x7F


WIDE = {
    "mono16": (widened(GREY), np.dstack([GREY] * 3)),
    "bgr16": (widened(BGR), BGR),
    "rgb16": (widened(BGR[:, :, ::-1]), BGR),
    **{f"bayer_{p}16": (widened(mosaic(p)), colour(40, 90, 200)) for p in ("rggb", "grbg")},
}


def raw(encoding, pixels, *, pad=0, **options):
    rows = [np.ascontiguousarray(row).tobytes() + bytes(pad) for row in pixels]
    return wire.image(encoding, b"".join(rows), width=6, height=4, step=len(rows[0]), **options)


@pytest.mark.parametrize(
    ("encoding", "pad", "transport"), list(itertools.product(EXACT, [0, 3], wire.WIRES)), ids=str
)
def test_every_encoding_gives_the_same_picture(encoding, pad, transport):
    pixels, expected = EXACT[encoding]
    (decoded,) = decode(raw(encoding, pixels, pad=pad, wire=transport))
    assert np.array_equal(decoded.value.pixels, expected)
    assert (decoded.stamp_ns, decoded.frame) == (wire.STAMP_NS, "cam")


@pytest.mark.parametrize(
    ("encoding", "big", "transport"), list(itertools.product(WIDE, [False, True], wire.WIRES)), ids=str
)
def test_sixteen_bits_of_both_byte_orders(encoding, big, transport):
    pixels, expected = WIDE[encoding]
    swapped = pixels.astype(">u2" if big else "<u2")
    (decoded,) = decode(raw(encoding, swapped, pad=2, big=big, wire=transport))
    assert np.array_equal(decoded.value.pixels, expected)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_counts_of_a_sensor_fill_the_eight_bits(bits):
    full = (1 << bits) - 1
    values = np.linspace(0, full, 24).astype("<u2").reshape(4, 6)
    pixels = decode(raw("mono16", values))[0].value.pixels
    assert pixels[0, 0, 0] == 0
    assert pixels[-1, -1, 0] == 255


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21"])
@pytest.mark.parametrize("bgr", [(0, 0, 255), (0, 255, 0), (255, 0, 0), (128, 128, 128)], ids=str)
def test_yuv_of_a_solid_colour(encoding, bgr):
    """BT.601, limited range: Y = 16 + 65.5 R + 128.6 G + 25 B (R, G, B in 0..1) and so on."""
    blue, green, red = (value / 255 for value in bgr)
    y = round(16 + 65.481 * red + 128.553 * green + 24.966 * blue)
    u = round(128 - 37.797 * red - 74.203 * green + 112.0 * blue)
    v = round(128 + 112.0 * red - 93.786 * green - 18.214 * blue)
    if encoding in ("nv12", "nv21"):
        chroma = [u, v] if encoding == "nv12" else [v, u]
        rows = [bytes([y] * 6) + b"\0"] * 4 + [bytes(chroma * 3) + b"\0"] * 2
        message = wire.image(encoding, b"".join(rows), width=6, height=4, step=7)
    else:
        pair = [u, y, v, y] if encoding in ("yuv422", "uyvy") else [y, u, y, v]
        message = wire.image(encoding, (bytes(pair * 3) + b"\0") * 4, width=6, height=4, step=13)
    assert decode(message)[0].value.pixels == pytest.approx(colour(*bgr).astype(float), abs=3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"encoding": "jpeg2000"}, "encoding 'jpeg2000' is not understood"),
        ({"encoding": "32FC1"}, "not understood"),
        ({"step": 17}, "rows of 17 bytes"),
        ({"data": bytes(71)}, "need 72 bytes, the data have 71"),
        ({"width": 0}, "0x4 px"),
        ({"height": 0}, "6x0 px"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "px"),
        ({"width": 4000, "height": 4000, "step": 12000}, "need"),
        ({"encoding": "yuyv", "width": 5}, "odd width"),
        ({"encoding": "nv12", "height": 3}, "even size"),
        ({"encoding": "bayer_rggb8", "height": 1}, "2x2"),
    ],
)
def test_raw_images_that_do_not_fit_are_refused(change, said):
    good = {"encoding": "bgr8", "data": bytes(72), "width": 6, "height": 4, "step": 18}
    with pytest.raises(InputError, match=said):
        decode(wire.image(**(good | change)))


@pytest.mark.parametrize("encoding", [*EXACT, *WIDE, "uyvy", "yuyv", "nv12", "nv21"])
def test_the_smallest_sizes_end_in_a_picture_or_a_refusal(encoding):
    for width, height in itertools.product(range(1, 5), repeat=2):
        message = wire.image(encoding, bytes(200), width=width, height=height, step=32)
        with contextlib.suppress(InputError):
            assert decode(message)[0].value.size == (width, height)


def test_the_last_row_may_lack_its_padding():
    message = wire.image("mono8", bytes(range(16)), width=6, height=2, step=10)
    assert decode(message)[0].value.pixels[1, :, 0].tolist() == [10, 11, 12, 13, 14, 15]


def test_the_image_owns_its_pixels():
    message = raw("bgr8", BGR)
    assert not np.shares_memory(decode(message)[0].value.pixels, np.frombuffer(message.data, np.uint8))


def written(suffix, pixels=BGR):
    return cv2.imencode(f".{suffix}", pixels)[1].tobytes()


@pytest.mark.parametrize("transport", wire.WIRES)
@pytest.mark.parametrize("suffix", ["png", "bmp"])
def test_compressed_pictures(suffix, transport):
    (decoded,) = decode(wire.compressed_image(written(suffix), form="whatever", wire=transport))
    assert np.array_equal(decoded.value.pixels, BGR)
    assert (decoded.stamp_ns, decoded.frame) == (wire.STAMP_NS, "cam")


@pytest.mark.parametrize("flags", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)], ids=["baseline", "progressive"])
@pytest.mark.parametrize("suffix", ["jpg", "jpeg"])
def test_jpeg_files(suffix, flags):
    data = cv2.imencode(".jpg", np.full((5, 7, 3), 99, np.uint8), flags)[1].tobytes()
    (decoded,) = decode(wire.file(suffix, data, stamp_ns=5))
    assert decoded.value.size == picture_size(memoryview(data)) == (7, 5)
    assert decoded.value.pixels == pytest.approx(99, abs=1)
    assert decoded.stamp_ns == 5


def test_sixteen_bit_and_grey_files_become_bgr():
    for pixels in (GREY, GREY.astype(np.uint16) << 8, np.dstack([BGR, ALPHA])):
        image = decode(wire.file("png", written("png", pixels)))[0].value
        assert image.pixels.shape == (4, 6, 3)


def test_exif_orientation_does_not_turn_the_pixels():
    data = written("jpg", np.zeros((4, 8, 3), np.uint8))
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: a quarter turn
    exif = b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff
    assert decode(wire.file("jpg", data[:2] + exif + data[2:]))[0].value.size == (8, 4)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"", id="nothing"),
        pytest.param(b"GIF89a" + bytes(50), id="gif"),
        pytest.param(written("jpg")[:-30], id="jpeg cut short"),
        pytest.param(written("png")[:-30], id="png cut short"),
        pytest.param(b"\xff\xd8" + b"\xff" * 100_000, id="jpeg of fill bytes"),
        pytest.param(b"\xff\xd8abc", id="jpeg without markers"),
        pytest.param(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\0\1\0\0" * 2 + bytes(9), id="png of 65536x65536"),
        pytest.param(b"BM" + bytes(12) + struct.pack("<Iii", 40, -5, 5) + bytes(50), id="bmp of -5 px"),
    ],
)
def test_what_is_no_picture_is_refused(data):
    with pytest.raises(InputError):
        decode(wire.file("png", data))


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp"])
@pytest.mark.parametrize("grey", [0, 128, 255])
def test_pictures_of_nothing_are_read_however_small_they_are(suffix, grey):
    data = written(suffix, np.full((600, 800, 3), grey, np.uint8))
    assert decode(wire.file(suffix, data))[0].value.size == (800, 600)


def test_a_picture_that_could_not_hold_its_pixels_is_refused_before_it_is_decoded():
    data = bytearray(written("png"))
    data[16:24] = struct.pack(">II", 8000, 8000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    with pytest.raises(InputError, match="declares 8000x8000 px"):
        decode(wire.file("png", bytes(data)))


@pytest.mark.parametrize("length", [2**20, 2**31, 2**32 - 1])
def test_a_png_chunk_that_declares_more_than_there_is_is_refused_before_it_is_decoded(length):
    data = bytearray(written("png"))
    data[33:37] = struct.pack(">I", length)
    with pytest.raises(InputError, match="ends before"):
        decode(wire.file("png", bytes(data)))


def test_a_png_with_a_wrong_sum_is_refused_before_it_is_decoded():
    data = bytearray(written("png"))
    data[-20] ^= 1
    with pytest.raises(InputError, match="damaged between bytes"):
        decode(wire.file("png", bytes(data)))


def test_an_animation_is_refused():
    data = written("png")
    chunk = b"acTL" + struct.pack(">II", 1, 0)
    chunk = struct.pack(">I", 8) + chunk + struct.pack(">I", zlib.crc32(chunk))
    with pytest.raises(InputError, match="acTL"):
        decode(wire.file("png", data[:33] + chunk + data[33:]))


def test_a_jpeg_that_declares_a_huge_size_is_refused_before_it_is_decoded():
    data = bytearray(written("jpg"))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = b"\xff\xff\xff\xff"
    with pytest.raises(InputError, match="an image of 65535x65535 px"):
        decode(wire.file("jpg", bytes(data)))


@given(strategies.images(), strategies.stamps_ns, strategies.frames)
def test_what_is_written_is_read_back(image, stamp_ns, frame):
    data = encode_compressed_image(image, stamp_ns, frame, "png")
    (decoded,) = decode(Message("/t", "sensor_msgs/msg/CompressedImage", "cdr", data, 0))
    assert (decoded.stamp_ns, decoded.frame) == (stamp_ns, frame)
    assert np.array_equal(decoded.value.pixels, image.pixels)

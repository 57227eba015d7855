"""Files become the pixels that they hold, and nothing else passes for an image."""

import io
import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from monitor.image_files import read_image, read_label
from pipeline.errors import InputError

BGR = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (48, 80, 3)).astype(np.uint8), (0, 0), 2)
GREY = np.ascontiguousarray(BGR[..., 0])


def encoded(form, pixels, options=()):
    done, data = cv2.imencode(form, pixels, list(options))
    assert done
    return data.tobytes()


def by_pillow(image, **options):
    held = io.BytesIO()
    image.save(held, "JPEG", quality=95, **options)
    return held.getvalue()


@pytest.fixture
def stored(tmp_path):
    def write(data, name="image.bin"):
        path = tmp_path / name
        path.write_bytes(data)
        return path

    return write


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (encoded(".png", BGR), BGR),
        (encoded(".bmp", BGR), BGR),
        (encoded(".png", GREY), np.dstack([GREY] * 3)),
        (encoded(".png", np.dstack([BGR, GREY])), BGR),
        (encoded(".png", BGR.astype(np.uint16) * 257), BGR),
        (encoded(".png", GREY.astype(np.uint16) * 257), np.dstack([GREY] * 3)),
        (encoded(".png", BGR[:1, :1]), BGR[:1, :1]),
        (encoded(".png", np.ascontiguousarray(BGR.transpose(1, 0, 2))), BGR.transpose(1, 0, 2)),
    ],
    ids=["png", "bmp", "grey", "alpha", "16 bits", "grey of 16 bits", "one pixel", "portrait"],
)
def test_every_kind_of_file_gives_its_pixels(stored, data, expected):
    image = read_image(stored(data))
    assert image.pixels.dtype == np.uint8
    assert np.array_equal(image.pixels, expected)
    assert image.note == ""


@pytest.mark.parametrize("mode", ["RGB", "CMYK", "L"])
@pytest.mark.parametrize("progressive", [False, True])
def test_jpegs_of_every_kind_are_read(stored, mode, progressive):
    picture = Image.fromarray(BGR[..., ::-1]).convert(mode)
    expected = np.asarray(picture.convert("RGB"))[..., ::-1].astype(int)
    found = read_image(stored(by_pillow(picture, progressive=progressive))).pixels
    assert np.abs(found - expected).mean() < 3


def test_a_rotation_in_exif_turns_nothing(stored):
    exif = Image.Exif()
    exif[0x0112] = 6
    turned = stored(by_pillow(Image.fromarray(BGR[..., ::-1]), exif=exif.tobytes()))
    assert cv2.imread(str(turned)).shape == (80, 48, 3)
    assert read_image(turned).pixels.shape == (48, 80, 3)


def test_counts_of_few_bits_in_sixteen_are_told(stored):
    counts = (BGR.astype(np.uint16) * 257) >> 4
    assert "scale counts" in read_image(stored(encoded(".png", counts))).note
    assert read_image(stored(encoded(".png", np.zeros((4, 5), np.uint16)))).note == ""
    assert read_image(stored(encoded(".png", np.full((4, 5), 9, np.uint8)))).note == ""


@settings(max_examples=60, deadline=None)
@given(
    left=st.floats(0.0, 1.0, exclude_max=True), form=st.sampled_from([".jpg", ".png", ".bmp", "progressive"])
)
def test_a_file_that_was_cut_anywhere_is_refused_and_not_filled_with_grey(tmp_path_factory, left, form):
    progressive = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1) if form == "progressive" else ()
    whole = encoded(".jpg" if form == "progressive" else form, BGR, progressive)
    path = tmp_path_factory.mktemp("cut") / "image"
    path.write_bytes(whole[: int(left * len(whole))])
    with pytest.raises(InputError, match=r"image"):
        read_image(path)
    path.write_bytes(whole)
    assert read_image(path).pixels.shape == BGR.shape


def png_of(width, height):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(1 << 20))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "has 0 bytes"),
        (b"not an image at all, but text\n", "understood: jpeg, png, bmp"),
        (encoded(".tiff", BGR), "understood: jpeg, png, bmp"),
        (encoded(".tiff", np.full((4, 5), np.nan, np.float32)), "understood: jpeg, png, bmp"),
        (b"\x93NUMPY" + bytes(80), "understood: jpeg, png, bmp"),
        (b"v/1\x01" + bytes(80), "understood: jpeg, png, bmp"),
        (png_of(60000, 60000), "an image of 60000x60000 px"),
        (png_of(2**31 - 1, 2**31 - 1), "accepted"),
        (png_of(7000, 7000), "declares 7000x7000 px"),
        (png_of(0, 5), "an image of 0x5 px"),
    ],
)
def test_what_is_no_image_is_named_with_what_to_do(stored, data, told):
    path = stored(data)
    with pytest.raises(InputError) as refused:
        read_image(path)
    assert told in str(refused.value)
    assert str(path) in refused.value.what
    assert refused.value.hint


def test_names_of_no_file_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, told in (
        (tmp_path, "is a folder"),
        (tmp_path / "none.jpg", "No such file"),
        (tmp_path / "pipe", "no regular file"),
        (tmp_path / "a\0b", "no name of a file"),
    ):
        with pytest.raises(InputError, match=told):
            read_image(path)


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge.png"
    with path.open("wb") as file:
        os.truncate(file.fileno(), 1 << 40)  # a hole: no disk is used
    with pytest.raises(InputError, match="an image has 1 to"):
        read_image(path)


def test_a_label_is_read_value_by_value(stored):
    values = np.random.default_rng(1).integers(0, 256, (7, 9)).astype(np.uint8)
    assert np.array_equal(read_label(stored(encoded(".png", values)), (9, 7)), values)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (encoded(".png", np.zeros((7, 8), np.uint8)), "8x7 px, its image has 9x7"),
        (encoded(".png", np.zeros((7, 9, 3), np.uint8)), "no label image"),
        (encoded(".png", np.zeros((7, 9), np.uint16)), "no label image"),
        (encoded(".png", np.zeros((7, 9), np.uint8))[:-20], "ends before"),
        (png_of(60000, 60000), "60000x60000"),
        (b"text", "is not understood"),
        (b"", "has 0 bytes"),
    ],
)
def test_what_is_no_label_of_its_image_is_refused(stored, data, told):
    path = stored(data)
    with pytest.raises(InputError, match=told) as refused:
        read_label(path, (9, 7))
    assert str(path) in refused.value.what
    assert refused.value.hint

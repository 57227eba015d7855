"""Where the network comes from."""

import os
from importlib import resources

import pytest

from monitor.model_file import DEFAULT_NAME, model_bytes
from pipeline.errors import ModelError


def test_without_a_name_it_is_the_one_that_ships():
    assert model_bytes(None) == (resources.files("models") / DEFAULT_NAME).read_bytes()


def test_a_named_file_is_read_as_it_is(tmp_path):
    (tmp_path / "m.onnx").write_bytes(b"\x00\x01")
    assert model_bytes(tmp_path / "m.onnx") == b"\x00\x01"


def test_what_can_not_be_read_is_named(tmp_path):
    for path in (tmp_path / "none.onnx", tmp_path):
        with pytest.raises(ModelError, match=f"model {path} can not be read"):
            model_bytes(path)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge.onnx"
    with path.open("wb") as file:
        os.truncate(file.fileno(), 1 << 40)  # a hole: no disk is used
    with pytest.raises(ModelError, match="too many for a network"):
        model_bytes(path)


def test_the_network_that_ships_names_no_file_of_the_machine_that_made_it():
    assert b".py" not in model_bytes(None)

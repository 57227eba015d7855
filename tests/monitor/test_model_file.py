"""Where the network comes from."""

import os
import re
from importlib import resources

import pytest

from monitor.model_file import DEFAULT_NAME, FREE, FREE_NAME, model_bytes, open_segmenter
from pipeline.errors import ModelError


def test_without_a_name_it_is_the_one_that_ships():
    assert model_bytes(None) == (resources.files("models") / DEFAULT_NAME).read_bytes()


def test_the_free_one_is_asked_for_by_its_word_unless_a_file_bears_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert model_bytes(FREE) == (resources.files("models") / FREE_NAME).read_bytes()
    (tmp_path / FREE).write_bytes(b"mine")
    assert model_bytes(FREE) == b"mine"


def test_both_that_ship_keep_the_contract_and_are_small():
    infos = [open_segmenter(path, threads=1).info for path in (None, FREE)]
    assert infos[0].training_data != infos[1].training_data
    assert all(len(model_bytes(path)) < 10_000_000 for path in (None, FREE))


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


@pytest.mark.parametrize("path", [None, FREE])
def test_the_networks_that_ship_name_no_file_of_the_machine_that_made_them(path):
    assert not re.search(rb"\w{4}\.py", model_bytes(path))  # fewer letters come about by chance

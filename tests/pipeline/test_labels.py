"""What labelled sets say of themselves: read as the layout says, and nonsense refused by the key."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pipeline import labels
from pipeline.labels import check_class_names, group_table, read_description

GOOD = {
    "labelled_classes": [1, 3],
    "folded_into": {"0": [0, 2, 4], "3": [3, 1]},
    "splits": {"train": ["a-1", "b_2."], "val": ["straße 7"], "test": []},
    "source": ["any note"],
}

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def test_a_description_is_read_as_the_layout_says():
    said = read_description(GOOD)
    assert said.labelled == {1, 3}
    assert said.splits == {"train": ("a-1", "b_2."), "val": ("straße 7",), "test": ()}
    assert said.groups[0].nonzero()[0].tolist() == [0, 2, 4]
    assert said.groups[3].nonzero()[0].tolist() == [1, 3]
    assert np.array_equal(said.groups[1], np.eye(len(labels.NAMES), dtype=bool)[1])


def test_without_folding_every_value_means_itself():
    said = read_description({"labelled_classes": [], "splits": {}})
    assert np.array_equal(said.groups, np.eye(len(labels.NAMES), dtype=bool))


@pytest.mark.parametrize("folded", [{0: [1, 2]}, {9: [9]}, {0: [0, 9]}, {-1: [-1]}, {0: []}])
def test_groups_outside_the_contract_are_refused(folded):
    with pytest.raises(ValueError, match="does not fit"):
        group_table(folded)


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("labelled_classes", None, "labelled_classes None"),
        ("labelled_classes", 1, "labelled_classes 1"),
        ("labelled_classes", ["1"], "labelled_classes"),
        ("labelled_classes", [True], "labelled_classes"),
        ("labelled_classes", [9], "classes 0 to 8"),
        ("labelled_classes", [-1], "labelled_classes"),
        ("labelled_classes", [1.0], "labelled_classes"),
        ("folded_into", [0], "folded_into is no object"),
        ("folded_into", {"x": [0]}, "label values"),
        ("folded_into", {"-1": [0]}, "label values"),
        ("folded_into", {"0": 0}, "folded_into 0"),
        ("folded_into", {"0": [3]}, "does not fit"),
        ("splits", None, "splits is no object"),
        ("splits", ["a"], "splits is no object"),
        ("splits", {"train": "abc"}, "split 'train' is no list"),
        ("splits", {"train": [4]}, "split 'train': id '4'"),
        ("splits", {"val": ["a", "a"]}, "split 'val' names an id twice"),
    ],
)
def test_nonsense_is_refused_by_its_key(key, value, told):
    with pytest.raises(ValueError, match=told):
        read_description(GOOD | {key: value})


@pytest.mark.parametrize(
    "identifier",
    ["../a", "/etc/passwd", "a/b", "a\\b", "..", ".", "", ".hidden", "C:a", "a\0b", "a\nb", "a" * 201, None],
)
def test_ids_that_leave_the_folder_are_refused(identifier):
    with pytest.raises(ValueError, match="no plain name of a file"):
        read_description(GOOD | {"splits": {"val": ["good", identifier]}})


@pytest.mark.parametrize("said", [None, [], "text", 4, {}])
def test_what_is_no_description_is_refused(said):
    with pytest.raises(ValueError, match=r"no object|no list"):
        read_description(said)


@given(said=st.fixed_dictionaries({}, optional=dict.fromkeys(GOOD, JSON)) | JSON)
@example(said=GOOD | {"labelled_classes": "\r"})
def test_any_json_ends_in_a_description_or_in_one_line(said):
    told = ""
    try:
        assert read_description(said).groups.diagonal().all()
    except ValueError as error:
        told = str(error)
    assert len(told.splitlines()) <= 1
    assert len(told) < 400


def test_values_that_a_set_does_not_know_are_told():
    said = read_description(GOOD)
    label = np.array([[0, 1, 3], [255, 2, 7]], np.uint8)
    assert said.strange_values(label) == [2, 7]
    assert said.strange_values(label[:1]) == []


def test_other_class_names_are_refused():
    check_class_names({"classes": list(labels.NAMES), "note": 1})
    for said in ({"classes": ["cat"]}, {"classes": list(labels.NAMES[::-1])}, {"classes": "lane"}, {}, []):
        with pytest.raises(ValueError, match=r"classes are not other, lane|no object"):
            check_class_names(said)

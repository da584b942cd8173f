"""Named transforms: their names, their matrices, and the way from one frame to another."""

import numpy as np
import pytest

from ultragray.datasets.fan import find_path, parse_matrix, read_device_set, transform_name
from ultragray.errors import DatasetInvalid


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("ProbeToTracker", ("Probe", "Tracker")),
        ("ToolToTracker", ("Tool", "Tracker")),
        ("PhantomToTorso", ("Phantom", "Torso")),
        ("TransducerOriginPixelToTransducerOrigin", ("TransducerOriginPixel", "TransducerOrigin")),
        ("Probe", None),
        ("Total", None),
        ("probetotracker", None),
    ],
)
def test_names(text, name):
    assert transform_name(text) == name


def test_matrices():
    matrix = parse_matrix("1 0 0 5\n 0 1 0 -8.23381e-005\n 0 0\t1 7  0 0 0 1", "here")
    assert matrix[:3, 3].tolist() == [5, -8.23381e-5, 7]


@pytest.mark.parametrize(
    "text",
    ["", "1 2 3", "a b c d e f g h i j k l m n o p", "nan " * 16, "0 " * 15 + "1", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2"],
)
def test_matrices_that_cannot_be_are_refused(text):
    with pytest.raises(DatasetInvalid, match=r"^here must be"):
        parse_matrix(text, "here")


def test_the_shortest_way():
    names = [("Image", "Probe"), ("Probe", "Tracker"), ("Reference", "Tracker"), ("Stylus", "Tracker")]
    assert find_path(names, "Image", "Reference") == [
        (("Image", "Probe"), False),
        (("Probe", "Tracker"), False),
        (("Reference", "Tracker"), True),
    ]
    assert find_path([*names, ("Image", "Reference")], "Image", "Reference") == [(("Image", "Reference"), False)]
    assert find_path(names, "Image", "World") is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not XML"),
        ("<a>", "not XML"),
        ("<a/>", "no Transform"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "no DOCTYPE"),
        (
            '<a><CoordinateDefinitions><Transform From="Image" To="Probe" Matrix="1 2"/></CoordinateDefinitions></a>',
            "ImageToProbe must be sixteen finite numbers",
        ),
    ],
)
def test_device_sets_that_cannot_be_read_are_named(tmp_path, content, message):
    path = tmp_path / "set.xml"
    path.write_text(content)
    with pytest.raises(DatasetInvalid, match=rf"set\.xml: .*{message}"):
        read_device_set(path)


def test_a_missing_device_set_is_named(tmp_path):
    with pytest.raises(DatasetInvalid, match=r"set\.xml: no such file"):
        read_device_set(tmp_path / "set.xml")


def test_a_device_set(device_set):
    transforms = read_device_set(device_set).transforms
    assert list(transforms) == [("Image", "Probe")]
    np.testing.assert_allclose(np.linalg.norm(transforms["Image", "Probe"][:3, :2], axis=0), [0.2, 0.1])

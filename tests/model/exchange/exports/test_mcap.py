"""MCAP as its own reader reads it, by the definitions in the file."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from ultragray import LinearProbe
from ultragray.contract import to_dict
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.exchange import ros_messages
from ultragray.exchange.poses import load_poses
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import FIGURES, Extrapolation

from .conftest import exported, header_of

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
FRAMES = 3


def written(path, poses, dtype):
    random = np.random.default_rng(3)
    frames = {
        "bmode": random.random((FRAMES, 6, 7), np.float32),
        "labels": random.integers(0, 5, (FRAMES, 6, 7), np.uint8),
    }
    told = [Extrapolation(0.5, 2.0, 0.9 - 0.1 * number, 0.75) for number in range(FRAMES - 1)]
    header = header_of("mcap", Resolved(PROBE, 6, 7, ("bmode", "labels")), dtype=dtype, poses=poses)
    exported(path, "mcap", header, frames, [*told, Extrapolation(None, None, None, 0.25)])
    return frames


def messages(path, topic):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [found.decoded_message for found in reader.iter_decoded_messages(topics=[topic])]


@pytest.mark.parametrize(("dtype", "encoding"), [("uint8", "mono8"), ("float32", "32FC1")])
def test_images_come_back_with_the_stamps_of_their_poses(tmp_path, random_poses, dtype, encoding):
    path = tmp_path / "frames.mcap"
    frames = written(path, random_poses(FRAMES), dtype)
    images = messages(path, "/ultragray/bmode")
    kind = np.dtype("u1" if dtype == "uint8" else "<f4")
    got = np.stack([np.frombuffer(one.data, kind).reshape(one.height, one.width) for one in images])
    expected = np.rint(255 * frames["bmode"]).astype("u1") if dtype == "uint8" else frames["bmode"]
    np.testing.assert_array_equal(got, expected)
    assert {(one.encoding, one.step, one.header.frame_id) for one in images} == {(encoding, 7 * kind.itemsize, "probe")}
    assert load_dataset(path, SourceOptions(image_topic="/ultragray/bmode")).train.notes == ()  # 0 is a stamp
    labels = messages(path, "/ultragray/labels")
    np.testing.assert_array_equal(np.frombuffer(labels[1].data, "u1").reshape(6, 7), frames["labels"][1])
    stamps = [[(one.header.stamp.sec, one.header.stamp.nanosec) for one in images]]
    stamps += [
        [(one.header.stamp.sec, one.header.stamp.nanosec) for one in messages(path, topic)]
        for topic in ("/ultragray/probe_pose", "/ultragray/confidence")
    ]
    assert stamps == [[(0, 0), (0, 40_000_000), (0, 80_000_000)]] * 3


def test_poses_are_metres_in_the_file_and_come_back_as_they_were(tmp_path, random_poses):
    path = tmp_path / "frames.mcap"
    poses = random_poses(FRAMES, tilt_deg=170.0, shift_mm=200.0)
    written(path, poses, "uint8")
    first = messages(path, "/ultragray/probe_pose")[0]
    place = first.pose.position
    np.testing.assert_allclose([place.x, place.y, place.z], poses[0, :3, 3] / 1000.0)
    assert first.header.frame_id == "scene"
    np.testing.assert_allclose(load_poses(path), poses, atol=1e-9)


def test_figures_and_origin_are_in_the_file(tmp_path, random_poses):
    path = tmp_path / "frames.mcap"
    written(path, random_poses(FRAMES), "uint8")
    told = [one.status[0] for one in messages(path, "/ultragray/confidence")]
    values = {one.key: float(one.value) for one in told[1].values}
    assert values == {"distance_mm": 0.5, "angle_deg": 2.0, "confidence": 0.8, "supported_share": 0.75}
    assert set(values) == set(FIGURES)
    assert [one.level for one in told] == [0, 0, 1]
    assert [one.key for one in told[2].values] == ["supported_share"], "what is not known is left out"
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        (metadata,) = reader.iter_metadata()
    assert metadata.metadata["scene"] == "one"
    assert json.loads(metadata.metadata["probe"]) == to_dict(PROBE)


def test_outlines_of_labels_run_along_their_pixels_as_foxglove_reads_them(tmp_path, random_poses):
    path = tmp_path / "frames.mcap"
    frames = written(path, random_poses(FRAMES), "uint8")
    told = messages(path, "/ultragray/annotations")
    assert len(told) == FRAMES
    for number, message in enumerate(told):
        labels = frames["labels"][number]
        image = image_annotations(message)
        assert [one.text for one in image.texts] == [str(label) for label in np.unique(labels[labels > 0])]
        for outline, name in zip(image.points, image.texts, strict=True):
            assert outline.timestamp.ToNanoseconds() == name.timestamp.ToNanoseconds() == number * 40_000_000
            assert outline.type == outline.LINE_LIST
            ends = np.array([(one.x, one.y) for one in outline.points])
            np.testing.assert_array_equal(inside_of(ends, labels.shape), labels == int(name.text))
            assert labels[int(name.position.y), int(name.position.x)] == int(name.text)
            assert outline.outline_color.a == 1.0
            assert outline.fill_color.a == 0.0


def test_a_file_without_labels_has_no_outlines(tmp_path, random_poses):
    path = tmp_path / "frames.mcap"
    header = header_of("mcap", Resolved(PROBE, 6, 7, ("bmode",)), dtype="uint8", poses=random_poses(1))
    exported(path, "mcap", header, {"bmode": np.zeros((1, 6, 7), np.float32)}, [Extrapolation(None, None, None, 0.0)])
    assert messages(path, "/ultragray/annotations") == []


def test_edges_in_a_row_are_one_line():
    labels = np.zeros((10, 12), np.uint8)
    labels[2:7, 3:9] = 5
    (outline,) = ros_messages.annotations_message(labels, 0)["points"]
    lines = np.array([(one["x"], one["y"]) for one in outline["points"]]).reshape(-1, 4)
    assert sorted(map(tuple, lines)) == [(3, 2, 3, 7), (3, 2, 9, 2), (3, 7, 9, 7), (9, 2, 9, 7)]


def image_annotations(message):
    """A message of the file as Foxglove's own schema has it, field by field."""
    schema = pytest.importorskip(
        "foxglove_schemas_protobuf.ImageAnnotations_pb2",
        reason="Foxglove's schemas are not installed: pip install 'ultragray[dev]'",
    )
    return fill(schema.ImageAnnotations(), message)


def fill(schema, message):
    for name in message.__slots__:
        value = getattr(message, name)
        if isinstance(value, list):
            for one in value:
                fill(getattr(schema, name).add(), one)
        elif name == "timestamp":
            schema.timestamp.FromNanoseconds(value.sec * 1_000_000_000 + value.nanosec)
        elif hasattr(value, "__slots__"):
            fill(getattr(schema, name), value)
        else:
            setattr(schema, name, value)
    schema.SetInParent()
    return schema


def inside_of(ends, shape):
    """The pixels that lines enclose: a ray from the left has crossed an odd number of standing lines."""
    crossed = np.zeros((shape[0], shape[1] + 1), int)
    for (x, top), (other, bottom) in ends.reshape(-1, 2, 2).astype(int):
        if x == other:
            crossed[min(top, bottom) : max(top, bottom), x] += 1
    return np.cumsum(crossed, axis=1)[:, :-1] % 2 == 1

"""MCAP recordings as sweeps: our own, and such as other programs write."""

import json
import re
import sys
from functools import partial

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType

from ultragray import ConvexProbe, LinearProbe, SteeredProbe
from ultragray.contract import to_dict
from ultragray.datasets import mcap as mcap_recording
from ultragray.datasets import mcap_messages as messages
from ultragray.datasets.checks import check_dataset
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, ExtraMissing, InvalidArgument
from ultragray.exchange import ros_messages as ros
from ultragray.exchange.rendering import render_to_file
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.rendering.display import Display
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import Extrapolation

from ...mcap_files import (
    COMPRESSED,
    GEOMETRY,
    PROBE,
    SECOND,
    START_NS,
    TRANSFORM,
    TRANSFORMS,
    WRITTEN_LATER_NS,
    Bag,
    image_at,
    image_message,
    image_time_ns,
    moving_pose,
    pose_message,
    recorded,
    transform_message,
)

COUNT = 12


@pytest.fixture
def path(tmp_path):
    return tmp_path / "sweep.mcap"


def parts(dataset):
    """Numbers, images and poses of all frames, in the order of the file."""
    numbers = np.concatenate([dataset.train.frame_numbers, dataset.val.frame_numbers])
    order = np.argsort(numbers)
    images = np.concatenate([dataset.train.images, dataset.val.images])[order]
    return numbers[order], images, np.concatenate([dataset.train.poses, dataset.val.poses])[order]


def pose_at(number):
    return moving_pose((image_time_ns(number) - START_NS) / SECOND)


def check_whole(dataset, count=COUNT):
    numbers, images, poses = parts(dataset)
    assert numbers.tolist() == list(range(count))
    np.testing.assert_array_equal(images, [image_at(number) for number in range(count)])
    np.testing.assert_allclose(poses, [pose_at(number) for number in range(count)], atol=1e-9)


@pytest.fixture
def bag(path):
    """A recording that knows its geometry."""
    bag = Bag(path)
    bag.geometry()
    return bag


def track(bag, topic, kind, *messages, numbers=range(51)):
    """What each of `messages` makes of the pose of the probe and its time, fifty times a second."""
    for number in numbers:
        time_ns = START_NS + number * SECOND // 50
        for message in messages:
            bag.write(topic, kind, message(moving_pose(number / 50), time_ns), time_ns)


def test_a_pose_lies_between_those_before_and_after_its_image(path):
    dataset = load_dataset(recorded(path))
    check_whole(dataset)
    assert (dataset.name, dataset.probe, dataset.train.notes) == ("sweep", PROBE, ())
    assert dataset.val.frame_numbers.tolist() == [2, 7]


@pytest.mark.parametrize("compression", CompressionType)
def test_chunks_of_every_compression_and_unfinished_files_are_read(path, compression):
    bag = Bag(path, compression)
    bag.geometry()
    bag.poses()
    bag.images()
    bag.images("/other", count=40)  # fills the last chunk, which is lost
    dataset = load_dataset(bag.leave(), SourceOptions(image_topic="/us/image"))
    check_whole(dataset)
    assert any("breaks off" in note for note in dataset.train.notes)
    whole = path.read_bytes()
    for length in range(len(whole) // 2, len(whole), len(whole) // 37):
        path.write_bytes(whole[:length])
        assert 2 <= len(parts(load_dataset(path, SourceOptions(image_topic="/us/image")))[0]) <= COUNT


def test_images_that_no_poses_lie_around_are_left_out_and_named(bag):
    track(bag, "/pose", ros.POSE, pose_message, numbers=(*range(11), *range(25, 51)))  # none from 0.2 to 0.5 s
    bag.images(count=20)
    dataset = load_dataset(bag.finish())
    assert parts(dataset)[0].tolist() == [0, 1, 2, 7, 8, 9, 10, 11, 12, 13, 14]
    assert dataset.train.notes == (
        "images without poses at most 200 ms apart around them were left out: "
        "3, 4, 5, 6, 15, 16, 17, 18, 19 (9 in all)",
    )


def test_frames_of_a_lifted_probe_are_left_out_with_their_times(bag):
    bag.poses()
    for number in range(COUNT):
        time_ns, image = image_time_ns(number), image_at(number) * (number not in (3, 4))
        bag.write("/us/image", ros.IMAGE, image_message(image, time_ns), time_ns)
    dataset = load_dataset(bag.finish())
    numbers, _, poses = parts(dataset)
    assert numbers.tolist() == [0, 1, 2, *range(5, COUNT)]
    np.testing.assert_allclose(poses, [pose_at(number) for number in numbers], atol=1e-9)
    times_s = np.sort(np.concatenate([dataset.train.times_s, dataset.val.times_s]))
    np.testing.assert_allclose(times_s, [(image_time_ns(number) - image_time_ns(0)) / SECOND for number in numbers])
    assert "frames in which every pixel is the same were left out: 3, 4 (2 in all)" in dataset.train.notes


def test_poses_of_a_lost_probe_are_gaps(bag):
    lost = {10: {"position": {"x": float("nan"), "y": 0.0, "z": 0.0}}, 20: {"orientation": dict.fromkeys("xyzw", 0.0)}}

    def tracked(pose, time_ns):
        message = pose_message(pose, time_ns)
        message["pose"] |= lost.get((time_ns - START_NS) * 50 // SECOND, {})
        return message

    track(bag, "/pose", ros.POSE, tracked)
    bag.images()
    dataset = load_dataset(bag.finish())
    check_whole(dataset)
    assert dataset.train.notes == ("2 poses of /pose are none, such as of a probe that was lost, and were passed over",)


def test_the_time_of_writing_stands_for_a_stamp_that_is_missing(bag):
    track(bag, "/pose", ros.POSE, lambda pose, time_ns: pose_message(pose, 0))
    for number in range(COUNT):
        bag.write("/us/image", ros.IMAGE, image_message(image_at(number), 0), image_time_ns(number))
    dataset = load_dataset(bag.finish())
    check_whole(dataset)
    assert dataset.train.notes == (
        "51 poses of /pose have no stamp: taken for those of the time that they were written at",
        f"{COUNT} images have no stamp: the time of writing is taken for it",
    )


def test_one_image_without_a_stamp_is_told_as_one(bag):
    bag.poses()
    for number in range(COUNT):
        stamp_ns = image_time_ns(number) if number else 0
        bag.write("/us/image", ros.IMAGE, image_message(image_at(number), stamp_ns), image_time_ns(number))
    (note,) = load_dataset(bag.finish()).train.notes
    assert note == "1 image has no stamp: the time of writing is taken for it"


def test_messages_that_were_written_at_the_time_of_their_stamps_have_stamps(bag):
    track(bag, "/pose", ros.POSE, lambda pose, time_ns: pose_message(pose, time_ns + WRITTEN_LATER_NS))
    bag.images()
    assert load_dataset(bag.finish()).train.notes == ()


GREY = image_at(3)
COLOUR = np.stack([GREY, GREY // 2, 255 - GREY], axis=-1)
LUMA = cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY)
ALPHA = np.full((*GREY.shape, 1), 9, np.uint8)


@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("rgb8", COLOUR, LUMA),
        ("bgr8", COLOUR[..., ::-1], LUMA),
        ("rgba8", np.concatenate([COLOUR, ALPHA], axis=-1), LUMA),
        ("bgra8", np.concatenate([COLOUR[..., ::-1], ALPHA], axis=-1), LUMA),
        ("32FC1", (GREY / 255).astype("<f4"), GREY),
        ("mono16", (255 - GREY).astype("<u2") << 8, 255 - GREY),
        ("16UC1", (255 - GREY).astype("<u2") << 4, 255 - GREY),
    ],
)
def test_every_encoding_becomes_grey(bag, encoding, stored, expected):
    bag.poses()
    for number in range(3):
        time_ns = image_time_ns(number)
        bag.write("/us/image", ros.IMAGE, image_message(stored, time_ns, encoding=encoding, padding=12), time_ns)
    np.testing.assert_array_equal(parts(load_dataset(bag.finish()))[1], [expected] * 3)


@pytest.mark.parametrize(("suffix", "tolerance", "shift"), [(".png", 0, 0), (".png", 0, 4), (".jpg", 6, 0)])
def test_compressed_images_are_read(path, suffix, tolerance, shift):
    bag = Bag(path)
    bag.geometry(topic="/us/image/geometry")
    bag.poses()
    for number in range(COUNT):
        time_ns = image_time_ns(number)
        stored = 255 - image_at(number)
        data = cv2.imencode(suffix, stored.astype(np.uint16) << shift if shift else stored)[1].tobytes()
        message = {"header": ros.header(time_ns, "probe"), "format": f"mono8; {suffix[1:]} compressed ", "data": data}
        bag.write("/us/image/compressed", COMPRESSED, message, time_ns)
    images = parts(load_dataset(bag.finish()))[1]
    truth = np.array([255 - image_at(number) for number in range(COUNT)])
    for region in (np.s_[:, :6, :6], np.s_[:, 10:, 10:]):  # a JPEG rings at the edge of the corner
        assert np.abs(images[region].astype(int) - truth[region]).max() <= tolerance


FLANGE_TO_PROBE = pose_from_position_quaternion((0.0, 12.0, 80.0), (0.0, 1.0, 0.0, 0.0))


def arm(pose, time_ns):
    """tf of the flange of a robot that holds the probe, and of a marker that a camera sees."""
    flange = transform_message(pose @ np.linalg.inv(FLANGE_TO_PROBE), time_ns, "base", "flange")
    return {"transforms": [flange, transform_message(np.eye(4), time_ns, "camera", "marker")]}


def mount(bag, flange_to_probe=FLANGE_TO_PROBE, *, topic="/tf_static", time_ns=START_NS):
    transforms = [transform_message(flange_to_probe, time_ns, "flange", "probe")]
    bag.write(topic, TRANSFORMS, {"transforms": transforms}, time_ns)


@pytest.fixture
def robot(bag):
    """The arm moves, the mount is fixed, and a camera looks on."""
    track(bag, "/tf", TRANSFORMS, arm)
    mount(bag)
    bag.write(
        "/tf_static", TRANSFORMS, {"transforms": [transform_message(np.eye(4), START_NS, "world", "base")]}, START_NS
    )
    bag.images()
    return bag


def test_tf_leads_from_the_frame_of_the_images_to_its_root(robot, path):
    robot.finish()
    dataset = load_dataset(path)
    numbers, _, poses = parts(dataset)
    assert len(numbers) == COUNT
    # The flange goes straight between two poses where the probe, 80 mm beyond it, goes along an arc.
    np.testing.assert_allclose(poses, [pose_at(number) for number in numbers], atol=1e-2)
    assert dataset.train.notes == ("poses are taken from tf: probeToworld",)
    named = load_dataset(path, SourceOptions(pose_topic="/tf", transform="probeTobase"))
    np.testing.assert_allclose(parts(named)[2], poses, atol=1e-9)
    assert named.train.notes == ()
    inverted = load_dataset(path, SourceOptions(transform="baseToprobe"))
    np.testing.assert_allclose(parts(inverted)[2], np.linalg.inv(poses), atol=1e-9)
    with pytest.raises(InvalidArgument, match=r"there are base, camera, flange, .*, world, got 'probeTomars'"):
        load_dataset(path, SourceOptions(transform="probeTomars"))
    for transform in ("probeTocamera", "worldTobase"):
        with pytest.raises(DatasetInvalid, match="no tracked transforms of tf lead from"):
            load_dataset(path, SourceOptions(transform=transform))


def tracked(frame_id, tool="probe"):
    return partial(transform_message, parent=frame_id, child=tool)


def test_a_tracker_of_transforms_is_read(bag):
    track(bag, "/ndi/probe", TRANSFORM, tracked("tracker"))
    bag.images()
    check_whole(load_dataset(bag.finish()))


@pytest.mark.parametrize(
    ("kind", "messages", "told"),
    [
        (
            TRANSFORM,
            [tracked("tracker"), tracked("tracker", "needle")],
            r"it tells those of 2: needleTotracker, probeTotracker; record",
        ),
        (
            ros.POSE,
            [partial(pose_message, frame_id=frame_id) for frame_id in ("robot_base", "camera_link")],
            r"of /track must be in one frame, .*'camera_link' .51 .* 'robot_base' .51",
        ),
    ],
    ids=["tools", "frames"],
)
def test_one_topic_of_two_tracked_things_is_refused_with_both_names(bag, kind, messages, told):
    track(bag, "/track", kind, *messages)
    bag.images()
    with pytest.raises(DatasetInvalid, match=told):
        load_dataset(bag.finish())


def test_images_of_two_probes_on_one_topic_are_refused_with_both_names(bag):
    bag.poses()
    for number in range(COUNT):
        message = image_message(image_at(number), image_time_ns(number))
        message["header"]["frame_id"] = "left" if number % 2 else "right"
        bag.write("/us/image", ros.IMAGE, message, image_time_ns(number))
    with pytest.raises(DatasetInvalid, match=r"must be of one probe, their frame_id is 'left' .* and 'right'"):
        load_dataset(bag.finish())


@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_a_transform_that_is_told_once_holds_for_all_images(bag, topic):
    track(bag, "/tf", TRANSFORMS, arm)
    mount(bag, topic=topic, time_ns=START_NS + SECOND // 2)
    bag.images()
    dataset = load_dataset(bag.finish())
    numbers, _, poses = parts(dataset)
    assert len(numbers) == COUNT
    np.testing.assert_allclose(poses, [pose_at(number) for number in numbers], atol=1e-2)
    assert [(link.transform, link.source, link.is_tracked) for link in dataset.train.chain.links[1:]] == [
        ("probeToflange", topic, False),
        ("flangeTobase", "/tf", True),
    ]
    assert ("probeToflange of /tf never changes: taken for all images" in dataset.train.notes) == (topic == "/tf")


IN_MILLIMETRES = FLANGE_TO_PROBE.copy()
IN_MILLIMETRES[:3, 3] *= 1000.0


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (
            FLANGE_TO_PROBE @ FLANGE_TO_PROBE,
            "probeToflange of /tf_static was told with other values: the last is taken for all images",
        ),
        (IN_MILLIMETRES, "probeToflange is 80.9 m long: millimetres where metres are expected?"),
    ],
    ids=["another value", "millimetres"],
)
def test_what_is_odd_about_a_static_transform_is_named(robot, other, told):
    mount(robot, other, time_ns=START_NS + SECOND)
    assert told in load_dataset(robot.finish()).train.notes


@pytest.mark.parametrize("second", ["/robot2/tf", "/tf"])
def test_two_sources_of_one_transform_are_named(bag, path, second):
    """Two robots whose frames have the same names, or two programs that both tell a transform."""
    elsewhere = plus_offset(30.0)
    track(bag, "/tf", TRANSFORMS, arm)
    track(bag, second, TRANSFORMS, lambda pose, time_ns: arm(elsewhere @ pose, time_ns + 10_000_000))
    mount(bag)
    bag.images()
    bag.finish()
    if second != "/tf":
        with pytest.raises(DatasetInvalid, match="flangeTobase is told on /robot2/tf and on /tf: record the tf of one"):
            load_dataset(path)
        return
    assert re.search(r"the poses of flangeTobase go [\d.]+ mm to and fro", "; ".join(load_dataset(path).train.notes))


def plus_offset(x_mm):
    matrix = np.eye(4)
    matrix[0, 3] = x_mm
    return matrix


def test_a_parent_that_changes_is_named_with_both(bag, path):
    for parent, numbers in (("table", range(25)), ("patient", range(25, 51))):
        link = tracked(parent)
        track(bag, "/tf", TRANSFORMS, lambda *at, link=link: {"transforms": [link(*at)]}, numbers=numbers)
    bag.images()
    bag.finish()
    with pytest.raises(DatasetInvalid, match=r"the parent of probe in tf changes between patient and table: say with"):
        load_dataset(path)
    numbers, _, poses = parts(load_dataset(path, SourceOptions(transform="probeTotable")))
    assert numbers.tolist() == [
        number for number in range(COUNT) if image_time_ns(number) <= START_NS + 24 * SECOND // 50
    ]
    np.testing.assert_allclose(poses, [pose_at(number) for number in numbers], atol=1e-9)


@pytest.mark.parametrize(("scale", "is_far"), [(1000.0, False), (1000.0, True), (0.001, False)])
def test_lengths_in_another_unit_are_told(bag, scale, is_far):
    for number in range(51):
        time_ns = START_NS + number * SECOND // 50
        message = pose_message(moving_pose(6 * number / 50), time_ns)
        for axis in "xyz":
            message["pose"]["position"][axis] *= scale
        message["pose"]["position"]["z"] -= 1949.0 * is_far
        bag.write("/pose", ros.POSE, message, time_ns)
    bag.images()
    if is_far:
        with pytest.raises(DatasetInvalid, match=r"lie within 1e\+06 mm.* \(millimetres where metres are expected\?\)"):
            load_dataset(bag.finish())
        return
    warnings = check_dataset(load_dataset(bag.finish())).warnings
    told = "millimetres where metres are expected?" if scale > 1 else "positions in metres?"
    assert any(text.endswith(told) or "positions not in millimetres?" in text for text in warnings)


def test_topics_are_chosen_or_listed(path):
    bag = Bag(path)
    bag.geometry(topic="/a/geometry")
    for topic in ("/a/image", "/b/image"):
        bag.images(topic)
    bag.poses("/goal", seconds=0.0)
    bag.poses("/tracker/pose")
    track(bag, "/tf", TRANSFORMS, arm)
    mount(bag)
    bag.finish()
    with pytest.raises(DatasetInvalid, match=r"choose one with image_topic: there are /a/image, /b/image"):
        load_dataset(path)
    with pytest.raises(DatasetInvalid, match=r"choose one with pose_topic: there are /goal, /tracker/pose, /tf"):
        load_dataset(path, SourceOptions(image_topic="/a/image"))
    with pytest.raises(InvalidArgument, match=r"image_topic must be one of /a/image, /b/image, got '/c'"):
        load_dataset(path, SourceOptions(image_topic="/c"))
    chosen = SourceOptions(image_topic="/a/image", pose_topic="/tracker/pose")
    check_whole(load_dataset(path, chosen))
    with pytest.raises(InvalidArgument, match="transform is for the poses of /tf, these are of /tracker/pose"):
        load_dataset(path, SourceOptions(image_topic="/a/image", pose_topic="/tracker/pose", transform="aTob"))


def test_a_geometry_beside_the_file_goes_before_its_own(path):
    probe = LinearProbe(width_mm=16.0, near_mm=0.0, far_mm=12.0)
    path.with_name("sweep.geometry.json").write_text(json.dumps({"probe": to_dict(probe)}))
    assert load_dataset(recorded(path)).probe == probe


def test_a_crop_moves_the_origin_to_its_own_top_centre(path):
    dataset = load_dataset(recorded(path), SourceOptions(crop="8:28,4:24", frames="0:6", val_frames="3"))
    assert dataset.probe == LinearProbe(20.0, 0.0, 20.0)
    np.testing.assert_array_equal(dataset.val.images[0], image_at(3)[4:24, 8:28])
    np.testing.assert_allclose(dataset.val.poses[0, :, 3], pose_at(3) @ [2.0, 0.0, 4.0, 1.0], atol=1e-9)
    assert (dataset.train.region.left, dataset.train.region.top) == (8, 4)


def changing(path, *, size):
    """From image 8 on of another size, or of another probe."""
    bag = Bag(path)
    bag.geometry()
    bag.poses()
    for number in range(COUNT):
        time_ns = image_time_ns(number)
        if number == 8 and not size:
            bag.geometry(json.dumps({"probe": to_dict(LinearProbe(40.0, 0.0, 30.0))}), time_ns=time_ns)
        image = image_at(number, width=40 if size and number >= 8 else 32)
        bag.write("/us/image", ros.IMAGE, image_message(image, time_ns), time_ns)
    return bag.finish()


@pytest.mark.parametrize(
    ("size", "told"),
    [
        (True, r"frame 8 has 40 x 24 pixels, frame 0 32 x 24: choose those of one size with frames, such as 0:8"),
        (
            False,
            r"frame 8: its geometry, .*, is another one than that of frame 0, .*: was the depth .* such as 0:8",
        ),
    ],
)
def test_what_changes_on_the_way_is_told_with_the_frames_to_choose(path, size, told):
    changing(path, size=size)
    with pytest.raises(DatasetInvalid, match=told):
        load_dataset(path)
    check_whole(load_dataset(path, SourceOptions(frames="0:8")), 8)
    assert parts(load_dataset(path, SourceOptions(frames="8:12")))[0].tolist() == [8, 9, 10, 11]


STANDING = {
    "probe": {"kind": "convex", "opening_angle_deg": 60, "near_mm": 40, "far_mm": 90},
    "picture": {"column_unit": "mm", "first_column": -45, "first_row_mm": 34, "column_step": 0, "row_step_mm": 0.2},
}


def small(**changes):
    """A recording with something else in it."""

    def write(bag):
        bag.geometry(changes.get("geometry", GEOMETRY))
        bag.poses()
        time_ns = image_time_ns(0) + changes.get("late_ns", 0)
        message = image_message(image_at(0), time_ns) | changes.get("image", {})
        bag.write("/us/image", ros.IMAGE, message, time_ns)

    return write


@pytest.mark.parametrize(
    ("write", "told"),
    [
        (lambda bag: None, r"a sweep needs a topic of images: there are no messages"),
        (Bag.poses, r"a sweep needs a topic of images: there are /tracker/pose \(geometry_msgs/msg/PoseStamped\)"),
        (Bag.images, r"a sweep needs a topic of poses: there are /us/image \(sensor_msgs/msg/Image\)"),
        (small(geometry="no JSON"), r"the geometry of its images cannot be read"),
        (small(geometry='{"probe": {"kind": "lunar"}}'), r"the geometry of its images cannot be read"),
        (small(geometry='{"frame_id": "probe"}'), r"it must be an object with a probe"),
        (small(geometry=json.dumps(STANDING)), r"column_step must not be 0"),
        (small(late_ns=90 * SECOND), r"none of 1 images has a pose: images are stamped .* were the clocks other ones"),
        (small(image={"encoding": "bayer_rggb8"}), r"frame 0: its encoding must be one of mono8, .*got 'bayer_rggb8'"),
        (small(image={"height": 2_000_000_000}), r"frame 0: 2000000000 rows of 32 bytes must hold 32 pixels"),
        (small(image={"step": 8}), r"frame 0: 24 rows of 8 bytes must hold 32 pixels"),
        (small(), r"at least two training frames, got 1"),
    ],
    ids=range(12),
)
def test_what_cannot_be_used_is_one_clear_error(path, write, told):
    bag = Bag(path)
    write(bag)
    with pytest.raises(DatasetInvalid, match=told):
        load_dataset(bag.finish())


STAMPED = (
    "std_msgs/Header header\n{}\n====\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n====\n"
)
STAMPED += "MSG: builtin_interfaces/Time\n{}\n"
ORDINARY_TIME = "int32 sec\nuint32 nanosec"
HEADER = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "probe"}


@pytest.mark.parametrize(
    ("kind", "definition", "message", "field"),
    [
        (ros.IMAGE, "string text", {"text": "no pixels"}, "header.stamp.sec"),
        (ros.IMAGE, STAMPED.format("string height", ORDINARY_TIME), {"header": HEADER, "height": "2"}, "height"),
        (
            ros.IMAGE,
            STAMPED.format("uint32 height", "int64 sec\nuint32 nanosec"),
            {"header": HEADER | {"stamp": {"sec": 1 << 40, "nanosec": 0}}, "height": 2},
            "header.stamp.sec",
        ),
        (ros.POSE, STAMPED.format("float64 pose", ORDINARY_TIME), {"header": HEADER, "pose": 1.0}, "pose.position.x"),
        (TRANSFORMS, "string[] transforms", {"transforms": ["up"]}, "transforms.header.stamp.sec"),
        (TRANSFORMS, "string transforms", {"transforms": "up"}, "transforms"),
        (ros.TEXT, "int32 data", {"data": 4}, "data"),
    ],
)
def test_other_messages_under_the_names_of_those_that_are_read_are_told(path, kind, definition, message, field):
    bag = Bag(path)
    bag.define(kind, definition)
    bag.write("/us/geometry", kind, message, START_NS)
    if kind != ros.POSE:
        bag.poses()
    with pytest.raises(
        DatasetInvalid, match=rf"what it calls {kind} is another kind of message: see its field {field}$"
    ):
        load_dataset(bag.finish())


def test_a_time_of_writing_beyond_all_bounds_is_refused(path):
    bag = Bag(path)
    bag.write("/us/geometry", ros.TEXT, {"data": GEOMETRY}, 1 << 63)
    with pytest.raises(
        DatasetInvalid, match=r"a message of /us/geometry was written 92\d+ ns after 1970, the limit is"
    ):
        load_dataset(bag.finish())


def test_images_without_a_geometry_say_where_to_put_it(path):
    bag = Bag(path)
    bag.poses()
    bag.images()
    with pytest.raises(DatasetInvalid, match=r"does not say which probe .* say it in sweep\.geometry\.json beside"):
        load_dataset(bag.finish())


def test_files_that_are_no_mcap_or_damaged(path):
    path.write_bytes(b"no MCAP at all")
    with pytest.raises(DatasetInvalid, match=r"sweep\.mcap: it cannot be read as MCAP"):
        load_dataset(path)
    path.write_bytes(b"")
    with pytest.raises(DatasetInvalid, match=r"sweep\.mcap: it cannot be read as MCAP: it ends too early"):
        load_dataset(path)
    whole = bytearray(recorded(path).read_bytes())
    whole[2000:2100] = bytes(100)
    path.write_bytes(whole)
    with pytest.raises(DatasetInvalid, match=r"sweep\.mcap: it cannot be read as MCAP"):
        load_dataset(path)


def test_a_file_that_is_too_large_is_refused(path, monkeypatch):
    recorded(path)
    monkeypatch.setattr(mcap_recording, "MAX_PIXEL_BYTES", 5000)
    with pytest.raises(DatasetInvalid, match=r"its frames must have at most 5,000 pixels, 12 of 32 x 24 have more"):
        load_dataset(path)
    monkeypatch.setattr(messages, "MAX_RECORD_BYTES", 3000)
    with pytest.raises(DatasetInvalid, match=r"a chunk must have at most 3,000 bytes"):
        load_dataset(path)


def test_without_the_package_the_extra_is_named(path, monkeypatch):
    recorded(path)
    for name in [one for one in sys.modules if one.startswith("ultragray.datasets.mcap")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)
    with pytest.raises(ExtraMissing, match=r"ultragray\[mcap\]"):
        load_dataset(path)


def rendered_file(path, scene, poses, probe, display, height, width):
    """Our own file of these frames."""
    told = [Extrapolation(None, None, None, None)] * len(poses)
    settings = Resolved(probe, height, width, ("bmode", "echo"), display=display)
    render_to_file(path, "mcap", scene, settings, poses, told, scene_name="one", scene_sha256="0" * 64)
    return path


CONVEX = ConvexProbe(opening_angle_deg=50.0, near_mm=10.0, far_mm=40.0)
LINEAR = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)


@pytest.mark.parametrize(
    ("probe", "display", "expected"),
    [
        (LINEAR, Display(), LINEAR),
        (CONVEX, Display(), CONVEX),
        (CONVEX, Display(flip=True), CONVEX),
        (CONVEX, Display(depth_mm=15.0), ConvexProbe(50.0, 10.0, 25.0)),
        (LINEAR, Display(depth_mm=20.0, flip=True), LinearProbe(30.0, 0.0, 20.0)),
    ],
)
def test_our_own_frames_come_back_in_every_display(path, random_scene, random_poses, probe, display, expected):
    scene, poses = random_scene(80), random_poses(6)
    numbers, images, found = parts(load_dataset(rendered_file(path, scene, poses, probe, display, 40, 30)))
    plain = rendered_file(path.with_name("plain.mcap"), scene, poses, probe, Display(), 40, 30)
    dataset = load_dataset(path)
    assert numbers.tolist() == list(range(6))
    assert dataset.probe == expected
    np.testing.assert_allclose(found, poses, atol=1e-9)
    truth = parts(load_dataset(plain))[1]
    np.testing.assert_array_equal(images, truth[:, : images.shape[1]])


@pytest.mark.parametrize(("probe", "size"), [(CONVEX, (200, 160)), (LINEAR, (100, 75))])
def test_frames_that_were_scan_converted_are_scan_lines_again(path, random_scene, random_poses, probe, size):
    scene, poses = random_scene(80), random_poses(3)
    dataset = load_dataset(rendered_file(path, scene, poses, probe, Display(pixel_mm=0.15), *size))
    _, images, found = parts(dataset)
    assert dataset.probe.box_mm == pytest.approx(probe.box_mm, abs=0.2)
    np.testing.assert_allclose(found, poses, atol=1e-6)
    truth = parts(load_dataset(rendered_file(path.with_name("plain.mcap"), scene, poses, probe, Display(), *size)))[1]
    for image, expected in zip(images, truth, strict=True):
        brought = cv2.resize(expected, image.shape[::-1], interpolation=cv2.INTER_LINEAR).astype(float)
        assert np.abs(brought - image)[4:-4, 4:-4].mean() < 3.0


def test_steered_lines_that_were_scan_converted_are_refused(path, random_scene, random_poses):
    steered = SteeredProbe(width_mm=30.0, steering_deg=10.0, near_mm=0.0, far_mm=40.0)
    scene, poses = random_scene(40), random_poses(3)
    with pytest.raises(DatasetInvalid, match=r"cannot be brought back to the scan lines of .*: record them without"):
        load_dataset(rendered_file(path, scene, poses, steered, Display(pixel_mm=0.5), 40, 30))
    assert load_dataset(rendered_file(path, scene, poses, steered, Display(), 40, 30)).probe == steered
    with pytest.raises(InvalidArgument, match="crop is for the images of linear probes"):
        load_dataset(path, SourceOptions(crop="0:9,0:9"))

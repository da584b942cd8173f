"""Recordings: frames that are added one after another, durable, by one writer at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidImageSize
from ultragray.rendering.pixels import png_file
from ultragray_workers.datasets.recording import (
    RecordedFrame,
    Recordings,
    RecordingSettings,
    recorded_dataset,
)
from ultragray_workers.errors import DatasetExists, DatasetNotFound, RecordingTaken, UploadTooLarge
from ultragray_workers.storage.local import LocalStorage

SETTINGS = RecordingSettings(LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=25.0), 16, 12)


def frames(*numbers, time_s=0.1):
    made = []
    for number in numbers:
        pose = np.eye(4)
        pose[1, 3] = 0.5 * number
        pixels = np.random.default_rng(number).integers(0, 255, (16, 12), np.uint8)
        made.append(RecordedFrame(number, time_s * number, pose, pixels))
    return made


def numbers_in(recordings, name="liver"):
    return [frame.number for block in recordings.frames(name) for frame in block]


@pytest.fixture
def recordings(tmp_path):
    made = Recordings(LocalStorage(tmp_path))
    made.begin("liver", SETTINGS)
    return made


def test_frames_come_back_as_they_were_added(recordings):
    sent = frames(0, 1, 2)
    writer = recordings.writer("liver")
    writer.append(sent[:1])
    state = writer.append(sent[1:])
    found = [frame for block in recordings.frames("liver") for frame in block]
    assert (state.frames, state.next_number, recordings.state("liver")) == (3, 3, state)
    for one, other in zip(sent, found, strict=True):
        np.testing.assert_array_equal(one.pixels, other.pixels)
        np.testing.assert_array_equal(one.pose, other.pose)
        assert one.time_s == other.time_s


def test_a_writer_goes_on_where_one_that_died_has_left_off(recordings):
    recordings.writer("liver").append(frames(0, 1))
    state = recordings.writer("liver").append(frames(2))
    assert (state.frames, numbers_in(recordings)) == (3, [0, 1, 2])


def test_a_writer_knows_the_very_frames_that_are_stored(recordings):
    writer = recordings.writer("liver")
    for numbers in ([1, 2], [4], [7, 8], [9]):
        writer.append(frames(*numbers))
    for known in (writer, recordings.writer("liver")):
        assert [one.number for one in frames(*range(12)) if known.has(one)] == [1, 2, 4, 7, 8, 9]
    (one,) = frames(7)
    assert not writer.has(replace(one, pixels=one.pixels.T.reshape(one.pixels.shape)))
    assert not writer.has(replace(one, pose=np.eye(4)))


def test_a_block_that_was_cut_off_goes_and_its_frames_are_sent_again(recordings, tmp_path):
    writer = recordings.writer("liver")
    writer.append(frames(0))
    writer.append(frames(1, 2))
    torn = max((tmp_path / "recording-blocks").rglob("0*"))
    torn.write_bytes(torn.read_bytes()[:-5])
    assert numbers_in(recordings) == [0]
    again = recordings.writer("liver")
    assert (again.state.frames, again.state.next_number) == (1, 1)
    again.append(frames(1, 2))
    assert numbers_in(recordings) == [0, 1, 2]


def test_of_two_writers_the_second_is_refused(recordings):
    first, second = recordings.writer("liver"), recordings.writer("liver")
    first.append(frames(0))
    with pytest.raises(RecordingTaken, match="liver"):
        second.append(frames(0))
    assert numbers_in(recordings) == [0]


def test_no_more_bytes_are_stored_than_allowed(recordings):
    writer = recordings.writer("liver")
    with pytest.raises(UploadTooLarge):
        writer.append(frames(0), max_bytes=100)
    assert recordings.state("liver").bytes == 0


def test_a_recording_is_begun_again_with_its_own_settings_alone(recordings):
    recordings.begin("liver", SETTINGS)
    with pytest.raises(DatasetExists):
        recordings.begin("liver", RecordingSettings(SETTINGS.probe, 20, 12))


def test_a_recording_that_was_deleted_is_not_found(recordings, tmp_path):
    recordings.writer("liver").append(frames(0))
    recordings.delete("liver")
    with pytest.raises(DatasetNotFound):
        recordings.state("liver")
    assert not list((tmp_path / "recording-blocks").rglob("0*"))


def test_a_dataset_holds_every_fifth_frame_out(recordings):
    recordings.writer("liver").append(frames(*range(8)))
    dataset, remarks = recorded_dataset(recordings, "liver")
    assert (len(dataset.train), len(dataset.val), remarks) == (6, 2, ())


@pytest.mark.parametrize(
    ("numbers", "remarks"),
    [
        ([1, 2, 3], ["1 frame is missing, lost on the way or refused, before frame 1"]),
        ([0, 1, 3, 4], ["1 frame is missing, lost on the way or refused, after frame 1"]),
        ([6, 7, 9], ["7 frames are missing, lost on the way or refused, in 2 places, the first before frame 6"]),
        (
            [0, 1, 3, 90],
            [
                "87 frames are missing, lost on the way or refused, in 2 places, the first after frame 1",
                "the recording paused once, for 9 s",
            ],
        ),
        (
            [0, 30, 90],
            [
                "88 frames are missing, lost on the way or refused, in 2 places, the first after frame 0",
                "the recording paused 2 times, at most for 6 s",
            ],
        ),
    ],
)
def test_what_is_missing_is_told(recordings, numbers, remarks):
    recordings.writer("liver").append(frames(*numbers))
    assert list(recorded_dataset(recordings, "liver")[1]) == remarks


def test_the_dataset_has_the_times_of_the_frames(recordings):
    recordings.writer("liver").append(frames(*range(8)))
    dataset, _ = recorded_dataset(recordings, "liver")
    np.testing.assert_allclose(dataset.train.times_s, [0.0, 0.1, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_allclose(dataset.val.times_s, [0.2, 0.7])


@pytest.mark.parametrize("time_s", [None, float("nan"), float("inf")])
def test_a_dataset_has_no_times_where_a_frame_has_none(recordings, time_s):
    first, *others = frames(*range(8))
    recordings.writer("liver").append([replace(first, time_s=time_s), *others])
    dataset, remarks = recorded_dataset(recordings, "liver")
    assert (dataset.train.times_s, dataset.val.times_s, remarks) == (None, None, ())


def test_a_recording_without_frames_is_no_dataset(recordings):
    with pytest.raises(DatasetInvalid):
        recorded_dataset(recordings, "liver")


def test_pixels_come_as_grey_values_or_as_a_png_file():
    (frame,) = frames(0)
    np.testing.assert_array_equal(SETTINGS.pixels(frame.pixels.tobytes()), frame.pixels)
    np.testing.assert_array_equal(SETTINGS.pixels(png_file(frame.pixels)), frame.pixels)
    with pytest.raises(InvalidImageSize, match="16x12"):
        SETTINGS.pixels(png_file(frame.pixels[:8]))
    with pytest.raises(InvalidArgument, match="constant"):
        SETTINGS.pixels(bytes(16 * 12))
    with pytest.raises(InvalidArgument, match="must be a PNG"):
        SETTINGS.pixels(b"\x89PNG, but not for long")


@pytest.mark.parametrize("count", [0, 8, 16 * 12 - 1])
def test_pixels_of_another_size_are_told_with_their_bytes(count):
    with pytest.raises(InvalidArgument, match=rf"PNG file, or 16x12 = 192 bytes of grey pixels.* got {count} bytes"):
        SETTINGS.pixels(bytes(count))

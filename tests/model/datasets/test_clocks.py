"""Clocks of images and poses: what is wrong with them is told with its number, and corrected by one option."""

import cv2
import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep, checks
from ultragray.datasets.checks import check_dataset
from ultragray.datasets.clocks import PoseTrack, clock_warnings, parse_delay_ns, poses_before
from ultragray.datasets.plus import read_plus_sweep
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.exchange import ros_messages as ros

from ...mcap_files import START_NS, Bag, image_message, pose_message

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
RATE_HZ = 20.0


def there_and_back(times_s):
    """A hand along the elevation: 15 mm there and back again within six seconds."""
    return 7.5 * (1 - np.cos(2 * np.pi * times_s / 6.0))


def one_way_and_unevenly(times_s):
    return 4.0 * times_s + 2.5 * np.sin(2.2 * times_s) + 1.2 * np.sin(5.1 * times_s + 1)


def evenly(times_s):
    return 3.0 * times_s


def tissue(places_mm, seed=0):  # [F, 48, 36] uint8
    """What planes at these places along the elevation show: texture of 2 mm, and noise."""
    random = np.random.default_rng(seed)
    volume = random.normal(size=(60, 48, 36)).astype(np.float32)
    volume = np.stack([cv2.GaussianBlur(one, (0, 0), 2.0) for one in volume])
    at = np.clip((places_mm + 10) / 1.0, 0, 58.9)
    below, share = at.astype(int), (at % 1.0)[:, None, None]
    planes = volume[below] * (1 - share) + volume[below + 1] * share
    planes = 120 + 250 * planes + random.normal(0, 6, planes.shape)
    return np.clip(planes, 1, 255).astype(np.uint8)


def recorded(motion, delay_s, count=160):
    """Frames whose images were taken `delay_s` before their stamps, at which the poses are."""
    times_s = np.arange(count) / RATE_HZ
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = motion(times_s)
    return Sweep(tissue(motion(times_s - delay_s)), poses, PROBE, np.arange(count), "it", times_s=times_s)


@pytest.fixture
def quick_checks(monkeypatch):
    """Without what the images say of the path: that takes seconds, and has tests of its own."""
    monkeypatch.setattr(checks, "agreed_path", lambda dataset: None)


def report_of(sweep):
    held_out = np.arange(len(sweep)) % 5 == 2
    return check_dataset(Dataset("it", sweep.select(np.flatnonzero(~held_out)), sweep.select(np.flatnonzero(held_out))))


@pytest.mark.usefixtures("quick_checks")
@pytest.mark.parametrize(
    ("motion", "delay_ms"),
    [(there_and_back, -180), (there_and_back, 50), (one_way_and_unevenly, -70), (one_way_and_unevenly, 300)],
)
def test_the_delay_of_the_images_is_told_with_its_number(motion, delay_ms):
    report = report_of(recorded(motion, delay_ms / 1000))
    assert report.image_delay_ms == pytest.approx(delay_ms, abs=12)
    (told,) = (text for text in report.warnings if "--image-delay-ms" in text)
    assert f"--image-delay-ms {report.image_delay_ms:.0f} corrects it" in told
    where = "after" if delay_ms > 0 else "before"
    assert f"seem to come {abs(report.image_delay_ms):.0f} ms {where} their poses" in told


@pytest.mark.usefixtures("quick_checks")
@pytest.mark.parametrize("resting_frames", [12, 15, 18])
def test_no_delay_is_told_of_a_probe_that_rests_before_tissue_that_changes_ever_faster(resting_frames):
    times_s = np.arange(resting_frames + 40) / RATE_HZ
    places_mm = 0.5 * np.maximum(np.arange(len(times_s)) - resting_frames, 0)
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, 1, 3] = places_mm
    across = np.linspace(0, 6, 36)[None, None, :] + 2e-4 * (places_mm[:, None, None] + 20) ** 2.2
    images = 120 + 80 * np.sin(across + np.linspace(0, 3, 48)[None, :, None])
    images += np.random.default_rng(0).normal(0, 2, images.shape)
    sweep = Sweep(np.clip(images, 1, 255).astype(np.uint8), poses, PROBE, np.arange(len(poses)), "it", times_s=times_s)
    assert report_of(sweep).image_delay_ms is None


@pytest.mark.usefixtures("quick_checks")
@pytest.mark.parametrize(("motion", "delay_s"), [(there_and_back, 0.0), (one_way_and_unevenly, 0.0), (evenly, 0.15)])
def test_no_delay_is_told_where_there_is_none_or_an_even_motion(motion, delay_s):
    assert report_of(recorded(motion, delay_s)).image_delay_ms is None


def test_steps_back_and_stamps_that_come_twice():
    times_s = np.array([0.0, 0.1, 0.2, 0.15, 0.3, 0.3, 0.4])
    assert list(clock_warnings(times_s, np.arange(10, 17))) == [
        "the time steps back at frame 13, by up to 50 ms: another clock, or frames in a wrong order?",
        "frames 15 have the time of the frame before: stamps that come twice",
    ]
    assert list(clock_warnings(np.arange(5) / 10, np.arange(5))) == []
    assert list(clock_warnings(np.arange(5) * 50.0, np.arange(5))) == [
        "the time goes on by 50 s from frame to frame: another unit, where seconds are expected?"
    ]


def moving(seconds):
    pose = np.eye(4)
    angle = 0.3 * seconds
    pose[:3, :3] = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    pose[:3, 3] = 5.0, 20.0 * seconds, -3.0
    return pose


def plus_sequence(folder, plus_files, stamps):
    fields = {"UltrasoundImageOrientation": "MF"}
    for frame, stamp in enumerate(stamps):
        fields[f"Seq_Frame{frame:04d}_ProbeToTrackerTransform"] = plus_files.numbers(moving(stamp))
        fields[f"Seq_Frame{frame:04d}_Timestamp"] = repr(stamp)
    path = plus_files.write_mha(folder / "s.mha", plus_files.speckle(len(stamps), 30, 20), fields)
    return path


@pytest.mark.parametrize("delay_ms", [40.0, -25.0, 100.0])
def test_a_plus_sequence_gets_the_poses_of_the_time_of_its_images(tmp_path, plus_files, device_set, delay_ms):
    stamps = [7.0 + 0.05 * frame for frame in range(30)]
    path = plus_sequence(tmp_path, plus_files, stamps)
    sweep, _ = read_plus_sweep(path, device_set=device_set, image_delay_ms=str(delay_ms), frames="3:27")
    image_to_probe = plus_files.image_to_probe
    top_centre = np.array([9.5, -0.5, 0, 1])
    for number, pose in zip(sweep.frame_numbers, sweep.poses, strict=True):
        true = moving(stamps[number] - delay_ms / 1000) @ image_to_probe
        assert np.abs(pose[:3, 3] - (true @ top_centre)[:3]).max() < 0.02
        assert np.abs(pose[:3, 0] - true[:3, 0] / np.linalg.norm(true[:3, 0])).max() < 1e-4
    assert sweep.frame_numbers.tolist() == list(range(3, 27))
    assert f"poses are those {delay_ms:g} ms before the stamps of the images" in sweep.notes
    np.testing.assert_allclose(sweep.times_s, [stamps[number] for number in sweep.frame_numbers], atol=1e-9)


def test_a_sequence_names_its_clock(tmp_path, plus_files, device_set):
    path = plus_sequence(tmp_path, plus_files, [0.0, 0.1, 0.2, 0.15, 0.3, 0.3, 0.4, 0.5])
    warnings = check_dataset(load_dataset(path, SourceOptions(device_set=device_set))).warnings
    assert any("the time steps back at frame 3, by up to 50 ms" in text for text in warnings)
    assert any("frames 5 have the time of the frame before" in text for text in warnings)
    bare = plus_files.write_mha(tmp_path / "b.mha", plus_files.speckle(4, 30, 20), plus_files.tracked_fields(4))
    with pytest.raises(InvalidArgument, match=r"image_delay_ms is for recordings with times: b\.mha has none"):
        read_plus_sweep(bare, device_set=device_set, image_delay_ms="40")
    with pytest.raises(DatasetInvalid, match="no frame has a pose 5000 ms before its time: a wrong delay"):
        read_plus_sweep(path, device_set=device_set, image_delay_ms="5000")


@pytest.mark.parametrize("odd", [None, "nan", "12:30:05", ""])
def test_times_that_are_lost_for_one_frame_are_told(tmp_path, plus_files, device_set, odd):
    fields = plus_files.tracked_fields(6) | {f"Seq_Frame{n:04d}_Timestamp": str(0.1 * n) for n in range(6)}
    fields["Seq_Frame0003_Timestamp"] = odd
    fields = {key: value for key, value in fields.items() if value is not None}
    path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(6, 20, 20), fields)
    sweep, _ = read_plus_sweep(path, device_set=device_set)
    assert sweep.times_s is None
    (told,) = (note for note in sweep.notes if "time" in note)
    assert told.startswith("1 of 6 frames has no time that can be read: those of the others are not used either")
    assert "delay" in told
    sweep, _ = read_plus_sweep(path, device_set=device_set, frames="4:")
    np.testing.assert_allclose(sweep.times_s, [0.4, 0.5])
    assert not any("time" in note for note in sweep.notes)


@pytest.mark.parametrize("text", ["fast", "nan", "inf", "1e13"])
def test_a_delay_must_be_milliseconds(text):
    with pytest.raises(InvalidArgument, match="image_delay_ms must be milliseconds"):
        parse_delay_ns(text)


def test_tracks_that_have_one_pose_or_none_near():
    track = PoseTrack(np.array([0, 100_000_000, 500_000_000]), np.stack([moving(0), moving(0.1), moving(0.5)]))
    poses, known = track.at(np.array([50_000_000, 300_000_000, 500_000_000, 600_000_000]))
    assert known.tolist() == [True, False, True, False]
    np.testing.assert_allclose(poses[0], moving(0.05), atol=1e-9)


def bag_of(path, image_offset_ns, log_lag_ns):
    """Images at 20 Hz whose stamps are those of another clock, and that are written when they come."""
    bag = Bag(path)
    bag.geometry()
    for number in range(150):
        time_ns = START_NS + number * 20_000_000
        bag.write("/pose", ros.POSE, pose_message(moving(number * 0.02), time_ns), time_ns)
    for number in range(20):
        time_ns = START_NS + 500_000_000 + number * 50_000_000
        image = np.random.default_rng(number).integers(0, 250, (24, 32), dtype=np.uint8)
        bag.write("/us/image", ros.IMAGE, image_message(image, time_ns + image_offset_ns), time_ns + log_lag_ns)
    return bag.finish()


def test_clocks_of_a_recording_that_are_apart_are_told_and_corrected(tmp_path):
    path = bag_of(tmp_path / "a.mcap", 130_000_000, 0)
    apart = load_dataset(path)
    (told,) = (note for note in apart.train.notes if "image-delay-ms" in note)
    assert "--image-delay-ms 130 corrects it" in told
    corrected = load_dataset(path, SourceOptions(image_delay_ms="130"))
    for number, pose in zip(corrected.train.frame_numbers, corrected.train.poses, strict=True):
        assert np.abs(pose - moving(0.5 + 0.05 * number)).max() < 0.02
    far = bag_of(tmp_path / "b.mcap", 3_600_000_000_000, 0)
    with pytest.raises(DatasetInvalid, match=r"were the clocks other ones .*: --image-delay-ms 3600000\)"):
        load_dataset(far)
    assert len(load_dataset(far, SourceOptions(image_delay_ms="3600000")).train) == 16


def test_poses_with_stamps_that_come_twice_or_step_back(tmp_path):
    bag = Bag(tmp_path / "c.mcap")
    bag.geometry()
    for number in range(60):
        time_ns = START_NS + (number - 2 * (number == 30)) * 20_000_000
        bag.write("/pose", ros.POSE, pose_message(moving(number * 0.02), time_ns), START_NS + number * 20_000_000)
    for number in range(10):
        image = np.random.default_rng(number).integers(0, 250, (24, 32), dtype=np.uint8)
        time_ns = START_NS + number * 50_000_000
        bag.write("/us/image", ros.IMAGE, image_message(image, time_ns), time_ns)
    notes = load_dataset(bag.finish()).train.notes
    assert "1 poses of /pose have the stamp of another one: the last of them is taken" in notes
    assert "the stamps of /pose step back 1 times: its poses were put in their order" in notes


def test_of_no_frames_no_pose_is_known_before_them(tmp_path):
    poses, is_known = poses_before(np.zeros((0, 4, 4)), np.zeros(0), 20_000_000, tmp_path)
    assert (len(poses), len(is_known)) == (0, 0)

"""The released layout: whatever it may hold is read alike, what cannot be used is named, and writing gives it back."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.datasets import Dataset
from ultragray.datasets.released import read_released, write_released
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument


@dataclass
class Layout:
    folder: Path
    images: np.ndarray
    poses: np.ndarray
    document: dict[str, Any]

    def configure(self, **changes):
        self.document |= changes
        kept = {key: value for key, value in self.document.items() if value is not None}
        (self.folder / "conf.json").write_text(json.dumps(kept))

    def save(self, name, array):
        np.save(self.folder / name, array)

    def change(self, name, place, value):
        """Another value in an array that is there."""
        array = np.load(self.folder / name)
        array[place] = value
        self.save(name, array)

    def write(self, name, content):
        (self.folder / name).write_bytes(content)

    def cut(self, name, count):
        self.write(name, (self.folder / name).read_bytes()[:-count])


@pytest.fixture
def layout(tmp_path, make_sweep):
    sweep = make_sweep(6)
    folder = tmp_path / "data" / "tiny"
    folder.mkdir(parents=True)
    names = [f"{kind}_{part}" for kind in ("images", "poses") for part in ("train", "val")]
    document = {name.replace("_", "_file_"): f"data/tiny/{name}.npy" for name in names}
    planes = {"ultrasound_near_plane": 0.5, "ultrasound_far_plane": 4.5, "ultrasound_opening_width": 3.79269}
    made = Layout(folder, sweep.images, sweep.poses, {**document, **planes, "_note": {"a": "comment"}})
    made.configure()
    for part, chosen in (("train", slice(4)), ("val", slice(4, 6))):
        made.save(f"images_{part}.npy", made.images[chosen])
        made.save(f"poses_{part}.npy", made.poses[chosen])
    return made


def test_a_conf_json_may_begin_with_a_byte_order_mark(layout):
    text = (layout.folder / "conf.json").read_text()
    for encoding in ("utf-8-sig", "utf-16"):
        (layout.folder / "conf.json").write_text(text, encoding=encoding)
        assert len(read_released(layout.folder).train) == 4


def test_a_folder_or_its_conf_json(layout):
    dataset = read_released(layout.folder)
    assert dataset.name == "tiny"
    assert dataset.probe == LinearProbe(width_mm=37.9269, near_mm=5.0, far_mm=45.0)  # in mm, and not stretched
    np.testing.assert_array_equal(dataset.train.images, layout.images[:4])
    np.testing.assert_array_equal(dataset.val.images, layout.images[4:])
    np.testing.assert_array_equal(dataset.train.poses, layout.poses[:4])
    assert dataset.train.source == str(layout.folder / "images_train.npy")
    assert dataset.train.frame_numbers.tolist() == [0, 1, 2, 3]
    assert read_released(layout.folder / "conf.json").sha256 == dataset.sha256


def test_poses_may_be_json_or_three_rows_and_images_floats(layout):
    expected = read_released(layout.folder).sha256
    layout.save("poses_train.npy", layout.poses[:4, :3])
    assert read_released(layout.folder).sha256 == expected
    (layout.folder / "p.json").write_text(json.dumps(layout.poses[:4].tolist()))
    layout.configure(poses_file_train="data/tiny/p.json")
    assert read_released(layout.folder).sha256 == expected
    layout.save("images_train.npy", (layout.images[:4, ..., None].repeat(3, axis=-1) / 255.0).astype(np.float32))
    assert read_released(layout.folder).sha256 == expected


def test_nothing_needs_to_be_held_out(layout):
    layout.configure(images_file_val=None, poses_file_val=None)
    dataset = read_released(layout.folder)
    assert (len(dataset.train), len(dataset.val)) == (4, 0)


def test_a_convex_probe(layout):
    layout.configure(ultrasound_opening_width=None, ultrasound_opening_angle=60.56)
    assert read_released(layout.folder).probe == ConvexProbe(opening_angle_deg=60.56, near_mm=5.0, far_mm=45.0)


def test_a_phased_probe(layout):
    fan = {"ultrasound_opening_width": None, "ultrasound_opening_angle": 90.5}
    layout.configure(**fan, ultrasound_near_plane=0, probe_kind="phased")
    assert read_released(layout.folder).probe == PhasedProbe(opening_angle_deg=90.5, far_mm=45.0)
    layout.configure(**fan, ultrasound_near_plane=0.5, probe_kind="phased")
    with pytest.raises(DatasetInvalid, match=r"a phased probe has .*near_plane 0, got 0.5"):
        read_released(layout.folder)
    linear = {"ultrasound_opening_width": 3.8, "ultrasound_opening_angle": None}
    layout.configure(**linear, ultrasound_near_plane=0, probe_kind="phased")
    with pytest.raises(
        DatasetInvalid, match=r"a phased probe has ultrasound_opening_angle, got ultrasound_opening_width"
    ):
        read_released(layout.folder)


def test_a_copied_folder_reads_its_own_files(layout):
    copy = layout.folder.parent / "copy"
    copy.mkdir()
    for path in layout.folder.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    np.save(copy / "images_train.npy", 255 - layout.images[:4])
    np.testing.assert_array_equal(read_released(copy).train.images, 255 - layout.images[:4])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda it: it.change("poses_train.npy", (2, 0, 3), np.nan),
            r"train\.npy: frame 2: its pose must be finite",
        ),
        (
            lambda it: it.change("poses_train.npy", (3, 0, 0), -1.0),
            r"train\.npy: frame 3: its pose must .*mirrored",
        ),
        (lambda it: it.change("images_train.npy", np.s_[:], 7), r"images_train\.npy: in each frame every pixel is the"),
        (
            lambda it: it.save("images_train.npy", it.images[:4] / [[[255.0]], [[255.0]], [[255.0]], [[np.nan]]]),
            "3 holds NaN",
        ),
        (
            lambda it: it.cut("images_train.npy", 100),
            r"images_train\.npy: not an array .*truncated: 100 bytes",
        ),
        (lambda it: it.save("images_train.npy", it.images[:0]), r"images_train\.npy: it holds no frames$"),
        (lambda it: it.configure(ultrasound_opening_width="3.8"), r"opening_width must be a finite number, got '3\.8'"),
        (lambda it: it.cut("poses_val.npy", 1), r"poses_val\.npy: not a file of poses .*truncated: 1 bytes"),
        (lambda it: it.save("images_train.npy", it.images[0]), r"images_train\.npy: images must have shape"),
        (
            lambda it: it.save("poses_train.npy", it.poses[:4, :2]),
            r"poses_train\.npy: poses must be .*\[4, 2, 4\]",
        ),
        (lambda it: it.save("poses_train.npy", it.poses[:3]), r"images_train\.npy holds 4 images, but .* 3 poses"),
        (lambda it: it.save("images_val.npy", it.images[4:, :9]), r"training frames are \[20, 16\].*\[9, 16\]"),
        (
            lambda it: [it.save("images_train.npy", it.images[:1]), it.save("poses_train.npy", it.poses[:1])],
            r"images_train\.npy: a scene needs at least two training frames, got 1",
        ),
        (lambda it: (it.folder / "images_train.npy").unlink(), r"conf\.json: images_file_train names .*not found"),
        (lambda it: it.configure(poses_file_val=None), r"conf\.json: it lacks poses_file_val"),
        (lambda it: it.configure(poses_file_val=3), r"conf\.json: poses_file_val must be a path"),
        (
            lambda it: [it.save("t.npy", np.arange(3)), it.configure(times_file_train="data/tiny/t.npy")],
            r"t\.npy: times must be numbers \[4\], got int64 \[3\]",
        ),
        (
            lambda it: [it.save("t.npy", [0.0, np.nan, 0.2, np.inf]), it.configure(times_file_train="data/tiny/t.npy")],
            r"t\.npy: times must be finite, those of frames 1, 3 are not",
        ),
        (lambda it: it.configure(times_file_val="data/tiny/t.npy"), r"times_file_val names .*not found"),
        (lambda it: it.configure(ultrasound_far_plane=0.1), r"conf\.json: far_mm must be greater"),
        (lambda it: it.write("conf.json", b"{"), r"conf\.json: not JSON"),
        (lambda it: (it.folder / "conf.json").unlink(), r"conf\.json: no such file"),
    ],
)
def test_bad_data_is_one_clear_error(layout, spoil, message):
    spoil(layout)
    with pytest.raises(DatasetInvalid, match=message):
        read_released(layout.folder)


@pytest.mark.parametrize("val_count", [0, 2])
@pytest.mark.parametrize(
    "probe", [LinearProbe(37.926892386, 0.1, 46.454218238), ConvexProbe(60.56, 1 / 8, 60), PhasedProbe(90.5, 60)]
)
def test_what_is_written_is_read_back(tmp_path, make_sweep, random_poses, probe, val_count):
    sweep = make_sweep(7, poses=random_poses(7, tilt_deg=170.0), probe=probe)
    dataset = Dataset("other", sweep, sweep.select(range(val_count)))
    write_released(dataset, tmp_path / "made" / "here")
    read = read_released(tmp_path / "made" / "here")
    assert read.sha256 == dataset.sha256
    assert read.name == "here"
    assert len(read.val) == val_count


def test_times_are_written_and_read_back(tmp_path, make_sweep):
    sweep = make_sweep(7, times_s=np.arange(7) / 10)
    write_released(Dataset("timed", sweep.select(range(5)), sweep.select([5, 6])), tmp_path / "timed")
    read = read_released(tmp_path / "timed")
    np.testing.assert_array_equal(read.train.times_s, sweep.times_s[:5])
    np.testing.assert_array_equal(read.val.times_s, sweep.times_s[5:])
    poses = np.load(tmp_path / "timed" / "poses_train.npy")
    poses[1] = np.nan  # no pose
    np.save(tmp_path / "timed" / "poses_train.npy", poses)
    np.testing.assert_array_equal(read_released(tmp_path / "timed").train.times_s, sweep.times_s[[0, 2, 3, 4]])


def test_a_delay_takes_the_poses_between_the_frames_of_both_parts(tmp_path, make_sweep):
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, 1, 3] = np.arange(7)
    sweep = make_sweep(7, poses=poses, times_s=np.arange(7) / 10)
    write_released(Dataset("timed", sweep.select([0, 1, 3, 4, 6]), sweep.select([2, 5])), tmp_path / "timed")
    read = load_dataset(tmp_path / "timed", SourceOptions(image_delay_ms="25"))
    np.testing.assert_allclose(read.train.poses[:, 1, 3], [0.75, 2.75, 3.75, 5.75])  # none is known before the first
    np.testing.assert_allclose(read.val.poses[:, 1, 3], [1.75, 4.75])
    assert read.train.frame_numbers.tolist() == [1, 2, 3, 4]
    assert "25 ms before the stamps" in read.train.notes[-1]


def test_a_delay_needs_times(layout):
    with pytest.raises(InvalidArgument, match=r"image_delay_ms is for recordings with times: .* has none"):
        read_released(layout.folder, image_delay_ms="25")


@pytest.mark.parametrize(
    ("configuration", "named"), [("conf.json", "conf"), ("liver.json", "images_train"), (None, "images_train")]
)
def test_a_dataset_is_not_overwritten(layout, configuration, named):
    dataset = read_released(layout.folder)
    if configuration is None:
        (layout.folder / "conf.json").unlink()
    else:
        (layout.folder / "conf.json").rename(layout.folder / configuration)
    before = {path.name: path.read_bytes() for path in layout.folder.iterdir()}
    with pytest.raises(InvalidArgument, match=rf"{named}\.(json|npy) already exists: choose another folder"):
        write_released(dataset, layout.folder)
    assert {path.name: path.read_bytes() for path in layout.folder.iterdir()} == before


def test_single_poses_are_not_overwritten_either(layout, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "poses_val.npy").write_bytes(b"mine")
    with pytest.raises(InvalidArgument, match=r"poses_val\.npy already exists"):
        write_released(read_released(layout.folder), tmp_path / "other")
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["poses_val.npy"]

"""Every kind of source behind one call."""

import shutil
from dataclasses import fields

import numpy as np
import pytest

from ultragray import phantom
from ultragray.datasets import Dataset
from ultragray.datasets.released import write_released
from ultragray.datasets.source import EVERY_FORMAT_TAKES, FORMATS, SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument


@pytest.fixture
def folder(tmp_path, make_sweep):
    sweep = make_sweep(10)
    write_released(Dataset("made", sweep.select(range(8)), sweep.select([8, 9])), tmp_path / "tiny")
    return tmp_path / "tiny"


def test_the_released_layout(folder):
    dataset = load_dataset(folder)
    assert (dataset.name, len(dataset.train), len(dataset.val)) == ("tiny", 8, 2)
    assert load_dataset(str(folder / "conf.json")).sha256 == dataset.sha256
    split = load_dataset(folder, SourceOptions(train_frames="0:4", val_frames="4:8", image_size="8x10"))
    assert (len(split.train), len(split.val)) == (4, 4)
    assert split.train.images.shape == (4, 10, 8)
    assert split.val.frame_numbers.tolist() == [4, 5, 6, 7]
    assert split.probe == dataset.probe


def test_a_sequence(tmp_path, plus_files, device_set):
    stored = plus_files.speckle(12, 30, 20)
    path = plus_files.write_mha(tmp_path / "name.igs.mha", stored, plus_files.tracked_fields(12))
    dataset = load_dataset(path, SourceOptions(device_set=device_set, crop="0:20,10:30", image_size="10x20"))
    assert dataset.name == "name"
    assert dataset.val.frame_numbers.tolist() == [2, 7]
    assert dataset.train.images.shape == (10, 20, 10)
    expected = stored[0, 10:30].reshape(20, 10, 2).mean(axis=-1)
    assert np.abs(dataset.train.images[0] - expected).max() <= 0.5
    chosen = load_dataset(path, SourceOptions(device_set=device_set, frames="2:8", train_frames="0:6"))
    assert chosen.train.frame_numbers.tolist() == [2, 3, 4, 5]
    assert chosen.val.frame_numbers.tolist() == [6, 7]


def test_a_folder_is_read_as_an_upload_of_it_is(tmp_path, plus_files, device_set, folder):
    place = tmp_path / "recorded" / "raw"
    place.mkdir(parents=True)
    plus_files.write_mha(place / "name.igs.mha", plus_files.speckle(12, 30, 20), plus_files.tracked_fields(12))
    shutil.copy(device_set, place)
    (place / ".hidden.igs.mha").touch()
    dataset = load_dataset(tmp_path / "recorded")
    assert (dataset.name, len(dataset.train)) == ("name", 10)
    shutil.copytree(folder, tmp_path / "recorded" / "converted")
    assert load_dataset(tmp_path / "recorded").name == load_dataset(folder).name  # a whole folder before a file
    shutil.copytree(folder, tmp_path / "recorded" / "again")
    with pytest.raises(DatasetInvalid, match=r"recorded must hold one dataset, it holds again/conf.json, converted/"):
        load_dataset(tmp_path / "recorded")


def test_the_word_phantom(monkeypatch, make_sweep):
    made = Dataset("phantom", make_sweep(6), make_sweep(2))
    monkeypatch.setattr(phantom, "load_phantom", lambda: made)
    assert load_dataset("phantom").sha256 == made.sha256
    assert len(load_dataset("phantom", SourceOptions(train_frames="0:3")).train) == 3


def test_sources_that_are_none_are_refused(folder, tmp_path):
    with pytest.raises(DatasetInvalid, match="nowhere: no such file or folder"):
        load_dataset(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetInvalid, match=r"empty must hold a folder with conf\.json .*; it holds no files"):
        load_dataset(tmp_path / "empty")
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(DatasetInvalid, match=r"a\.txt: a dataset is a folder with conf\.json"):
        load_dataset(tmp_path / "a.txt")
    for name, advice in (
        ("a.bag", r"a\.bag is not read as it is: make an \.mcap of it, by `ros2 bag convert`"),
        ("sweep.mp4", r"sweep\.mp4 is not read as it is: write its frames as pictures \(`ffmpeg -i"),
        ("scene.mrb", r"scene\.mrb is not read as it is: unpack it"),
        ("us.mat", r"us\.mat is not read as it is: write its arrays as \.npy files of a folder with a conf\.json"),
    ):
        place = tmp_path / f"of {name}"
        place.mkdir()
        (place / name).write_bytes(b"")
        for source in (place / name, place):
            with pytest.raises(DatasetInvalid, match=f"(a dataset is|must hold) a folder with conf.*; {advice}"):
                load_dataset(source)
    for options in (SourceOptions(crop="0:1,0:1"), SourceOptions(frames="0"), SourceOptions(device_set=folder)):
        takers = r"PLUS sequences(, DICOM cine loops, MCAP recordings, pose tables and TUS-REC scans)?"
        with pytest.raises(InvalidArgument, match=rf"is for {takers}, tiny is none"):
            load_dataset(folder, options)


def test_one_training_frame_is_not_enough(folder):
    with pytest.raises(DatasetInvalid, match="at least two training frames, got 1"):
        load_dataset(folder, SourceOptions(train_frames="3"))


def test_options_are_texts_of_bounded_length():
    for given in ("x" * 1001, "0:2\n"):
        with pytest.raises(InvalidArgument, match="train_frames must be at most 1000 characters") as refused:
            SourceOptions(train_frames=given)
        assert refused.value.field == "train_frames"


def test_each_format_names_options_that_there_are():
    known = {item.name for item in fields(SourceOptions)}
    for one in FORMATS.values():
        assert {*one.options, *one.companions, *EVERY_FORMAT_TAKES} <= known
        assert set(one.companions) <= set(one.options)

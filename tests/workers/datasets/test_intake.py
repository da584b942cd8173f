import contextlib
import json
import subprocess
import sys

import cv2
import h5py
import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray_workers import claims
from ultragray_workers.datasets.intake import IncomingDataset, remove_stale, take_in
from ultragray_workers.datasets.recording import RecordedFrame, RecordingSettings
from ultragray_workers.datasets.store import DatasetStore, check_dataset_name
from ultragray_workers.errors import DatasetExists, DatasetInUse, DatasetNotFound, UploadTooLarge

from ...dicom_files import write_cine


def sweep(count, offset_mm):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = np.arange(count) + offset_mm
    images = np.random.default_rng(count).integers(0, 250, (count, 20, 16), dtype=np.uint8)
    return Sweep(images, poses, LinearProbe(40.0, 0.0, 50.0), np.arange(count), "sweep")


@pytest.fixture
def files(tmp_path):
    """A dataset of the released layout: 8 training and 3 held-out frames of 20x16."""
    write_released(Dataset("tiny", sweep(8, 0.0), sweep(3, 0.5)), tmp_path / "tiny")
    return {path.name: path.read_bytes() for path in (tmp_path / "tiny").iterdir()}


@pytest.fixture
def drawn():
    """Contact sheets are drawn, which takes most of a second."""


@pytest.fixture(autouse=True)
def blank_sheets(request, monkeypatch):
    """Contact sheets are empty files, but for tests that want them `drawn`."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr("ultragray.datasets.pictures.draw_dataset", lambda dataset, path: path.touch())


@pytest.fixture
def store(tmp_path):
    return DatasetStore(tmp_path / "artifacts")


@pytest.fixture
def receive(store):
    """Uploads files; what is left of them goes at the end."""
    with contextlib.ExitStack() as stack:

        def receive_files(files):
            incoming = IncomingDataset(store, 10_000_000)
            stack.callback(incoming.discard)
            for name, content in files.items():
                incoming.begin_file(name)
                incoming.write(content)
            incoming.finish()
            return incoming

        yield receive_files


def arguments(incoming, name="tiny", **options):
    return {"folder": str(incoming.folder), "name": name, "options": options, "max_bytes": 10_000_000}


def leftovers(store):
    return sorted(path.name for path in store.folder.iterdir())


def npy(tmp_path, array):
    np.save(tmp_path / "array.npy", array)
    return (tmp_path / "array.npy").read_bytes()


def test_an_upload_becomes_a_dataset_that_training_reads(drawn, store, receive, files):
    incoming = receive(files)
    assert store.names() == []
    take_in(**arguments(incoming, train_frames="0:6"))
    record, is_new = incoming.accept("tiny")
    incoming.discard()
    assert is_new
    assert (leftovers(store), store.names()) == ([], ["tiny"])
    assert store.get("tiny") == record
    assert (record.kind, record.train_frames, record.val_frames) == ("released", 6, 3)
    assert (record.height, record.width, record.bytes) == (20, 16, sum(map(len, files.values())))
    assert record.probe == LinearProbe(40.0, 0.0, 50.0)
    assert store.load("tiny").sha256 == record.sha256
    assert store.contact_sheet("tiny").startswith(b"\x89PNG")


def test_the_built_in_phantom_is_written_where_nothing_was_sent(drawn, store, receive, monkeypatch):
    made = Dataset("phantom", sweep(8, 0.0), sweep(3, 0.5))
    monkeypatch.setattr("ultragray.phantom.load_phantom", lambda: made)  # half a minute
    incoming = receive({})
    take_in(**arguments(incoming, name="mine"), simulated=True)
    record, _ = incoming.accept("mine")
    assert (record.name, record.kind, record.train_frames, record.val_frames) == ("mine", "released", 8, 3)
    assert np.array_equal(store.load("mine").train.images, made.train.images)
    with pytest.raises(UploadTooLarge, match="100"):
        take_in(**{**arguments(receive({})), "max_bytes": 100}, simulated=True)


def test_warnings_of_the_check_are_kept(store, receive, files, tmp_path):
    images = sweep(8, 0.0).images.copy()
    images[3] = images[3] // 40
    incoming = receive({**files, "images_train.npy": npy(tmp_path, images)})
    take_in(**arguments(incoming))
    (warning,) = incoming.accept("tiny")[0].warnings
    assert warning.startswith("train: frames 3 are nearly black")


def test_a_recording_is_checked_and_kept_with_the_times_of_its_frames(store, receive):
    taken, times_s = sweep(20, 0.0), np.arange(20) / 10
    times_s[12:] -= 0.75
    store.recordings.begin("liver", RecordingSettings(taken.probe, taken.height, taken.width))
    parts = zip(times_s.tolist(), taken.poses, taken.images, strict=True)
    store.recordings.writer("liver").append([RecordedFrame(number, *part) for number, part in enumerate(parts)])
    incoming = receive({})
    take_in(**arguments(incoming, name="liver"), recorded=store.storage.location)
    record, _ = incoming.accept("liver")
    assert any("the time steps back" in warning for warning in record.warnings)
    found = store.load("liver")
    np.testing.assert_array_equal(found.val.times_s, times_s[2::5])
    np.testing.assert_array_equal(found.train.times_s, np.delete(times_s, np.s_[2::5]))


def test_scans_and_tables_of_poses_are_taken_in_with_what_belongs_to_them(store, receive, tmp_path):
    frames, poses = sweep(8, 0.0).images, np.tile(np.eye(4), (8, 1, 1))
    poses[:, 1, 3] = np.arange(8)
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["frames"], file["tforms"] = frames, poses
    scale, tool = ("\n".join(",".join(map(str, row)) for row in m) for m in (np.diag([0.5, 0.5, 1, 1]), np.eye(4)))
    table = "x_mm,y_mm,z_mm,qw,qx,qy,qz\n" + "\n".join(f"0,{number},0,1,0,0,0" for number in range(8))
    calibration = {"image_to_sensor": [[0.5, 0, 0, 0], [0, 0, 1, 0], [0, 0.5, 0, 0], [0, 0, 0, 1]]}
    uploads = {
        "tusrec": {
            "frames_transfs/000/scan.h5": (tmp_path / "scan.h5").read_bytes(),
            "calib_matrix.csv": f"scaling\n{scale}\nspatial_calibration\n{tool}\n".encode(),
        },
        "table": {
            **{f"sweep/{n}.png": cv2.imencode(".png", frame)[1].tobytes() for n, frame in enumerate(frames)},
            "sweep/poses.csv": table.encode(),
            "sweep/calibration.json": json.dumps(calibration).encode(),
        },
    }
    for kind, files in uploads.items():
        incoming = receive(files)
        take_in(**arguments(incoming))
        record = incoming.accept(kind)[0]
        assert (record.kind, record.train_frames, record.val_frames) == (kind, 6, 2)
        np.testing.assert_array_equal(store.load(kind).val.images, frames[[2, 7]])


def poisoned(tmp_path, files):
    poses = sweep(8, 0.0).poses.copy()
    poses[5, 0, 0] = np.nan
    return {**files, "poses_train.npy": npy(tmp_path, poses)}


def changed_config(files, **changes):
    return {**files, "conf.json": json.dumps({**json.loads(files["conf.json"]), **changes}).encode()}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (poisoned, r"^poses_train.npy: frame 5: its pose .*finite"),
        (
            lambda _, files: {**files, "images_train.npy": files["images_train.npy"][:-7]},
            r"^images_train.npy: .*truncated: 7 bytes are missing",
        ),
        (
            lambda _, files: {name: files[name] for name in files if name != "conf.json"},
            r"^the upload must hold a folder with conf.json .* or a PLUS sequence .*; it holds images_train.npy, ",
        ),
        (
            lambda _, files: {name: files[name] for name in files if name != "poses_val.npy"},
            r"^conf.json: poses_file_val names .* which is not in the upload",
        ),
        (
            lambda _, files: {"a/conf.json": files["conf.json"], "b/conf.json": b"{}"},
            r"must hold one dataset, it holds a/conf.json, b/conf.json",
        ),
        (lambda _, files: {**files, "conf.json": b"{"}, r"^conf.json: not JSON"),
        (lambda _, files: {}, r"it holds no files"),
    ],
    ids=["NaN pose", "truncated", "no conf.json", "a file missing", "two datasets", "bad JSON", "nothing"],
)
def test_what_is_refused_in_one_sentence(change, expected, store, receive, files, tmp_path):
    incoming = receive(change(tmp_path, files))
    with pytest.raises(DatasetInvalid, match=expected) as caught:
        take_in(**arguments(incoming))
    assert str(store.folder) not in caught.value.detail
    incoming.discard()
    assert leftovers(store) == []


def test_conf_json_reads_no_file_but_those_of_the_upload(store, receive, files, tmp_path):
    secret = tmp_path / "secret.npy"
    secret.write_bytes(files["images_train.npy"])
    for named in (str(secret), "../../../../../secret.npy"):
        incoming = receive(changed_config(files, images_file_train=named))
        with pytest.raises(DatasetInvalid, match=r"images_file_train names .* which is not in the upload"):
            take_in(**arguments(incoming))


def test_conf_json_does_not_tell_which_files_there_are_outside_the_upload(store, receive, files, tmp_path):
    (tmp_path / "there.npy").write_bytes(b"no array")
    for folder in (f"{tmp_path}/", "../../../../../", "x/../../../../../../"):
        refusals = set()
        for name in ("there.npy", "gone.npy"):
            incoming = receive(changed_config(files, images_file_train=f"{folder}{name}"))
            with pytest.raises(DatasetInvalid) as caught:
                take_in(**arguments(incoming))
            refusals.add(caught.value.detail.replace(name, "NAME"))
        assert len(refusals) == 1


def test_a_path_of_another_machine_is_found_by_its_name_in_the_upload(store, receive, files, tmp_path):
    other = tmp_path / "images_train.npy"
    other.write_bytes(npy(tmp_path, sweep(3, 0.0).images))
    incoming = receive(changed_config(files, images_file_train=str(other)))
    take_in(**arguments(incoming))
    assert incoming.accept("tiny")[0].train_frames == 8


def test_options_are_named_as_requests_write_them(store, receive, files):
    for options, field in (({"train_frames": "0:99"}, "train_frames"), ({"crop": "0:2,0:2"}, "crop")):
        with pytest.raises(InvalidArgument, match=rf"^{field}") as caught:
            take_in(**arguments(receive(files), **options))
        assert caught.value.field == field
        assert "--" not in caught.value.detail


def run_intake(given, memory_bytes):
    program = (
        "from ultragray_workers.datasets.intake import take_in; "
        "from ultragray_workers.helpers import answer_request; answer_request(take_in)"
    )
    request = {"arguments": given, "memory_bytes": memory_bytes, "what": "checking the dataset"}
    return subprocess.run([sys.executable, "-c", program], input=json.dumps(request), capture_output=True, text=True)


def test_memory_beyond_the_limit_is_one_clear_error(store, receive, files, tmp_path):
    large = changed_config(files, images_file_train="large.npy")
    incoming = receive(large)
    with (incoming.folder / "dataset" / "files" / "large.npy").open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (2000, 512, 512)}
        np.lib.format.write_array_header_1_0(file, header)
        file.truncate(file.tell() + 4 * 2000 * 512 * 512)  # a hole: nothing is written
    done = run_intake(arguments(incoming), 512 << 20)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["reason"] == "MEMORY_EXCEEDED"
    assert answer["detail"].startswith("checking the dataset takes more than 512 MiB")


def add(store, receive, files, name, **options):
    incoming = receive(files)
    take_in(**arguments(incoming, name, **options))
    is_new = incoming.accept(name)[1]
    incoming.discard()
    return is_new


def test_the_same_content_twice_is_one_dataset(store, receive, files):
    assert add(store, receive, files, "tiny")
    before = store.get("tiny")
    assert not add(store, receive, {f"deeper/{name}": content for name, content in files.items()}, "tiny")
    with pytest.raises(DatasetExists):
        add(store, receive, files, "tiny", train_frames="0:4")
    assert store.get("tiny") == before
    assert store.names() == ["tiny"]


def test_a_manifest_of_an_unknown_format_is_damaged(store, receive, files):
    add(store, receive, files, "tiny")
    manifest = store.folder.parent / "datasets" / "tiny.json"
    manifest.write_text(manifest.read_text().replace('"released"', '"nifti"'))
    with pytest.raises(DatasetInvalid, match=r"'tiny' cannot be used: .*kind must be one of released, .*'nifti'"):
        store.load("tiny")


def test_deletion(store, receive, files):
    add(store, receive, files, "tiny")
    with pytest.raises(DatasetInUse, match=r"needed by job 7 \(tiny\)"):
        store.delete("tiny", lambda name: f"job 7 ({name})")
    assert store.names() == ["tiny"]
    store.delete("tiny")
    assert list((store.folder.parent / "dataset-files").iterdir()) == []
    for call in (store.get, store.delete, store.load, store.contact_sheet):
        with pytest.raises(DatasetNotFound):
            call("tiny")


@pytest.mark.parametrize("name", ["", "..", ".incoming-1", "a/b", "x" * 129, "ü", "a\n"])
def test_names_that_no_dataset_has(store, name):
    with pytest.raises(InvalidArgument):
        check_dataset_name(name)
    with pytest.raises(DatasetNotFound):
        store.delete(name)


def test_only_what_nobody_holds_is_stale(store, receive, files, monkeypatch):
    under_way = receive(files)
    (store.folder / ".incoming-dead").mkdir()
    (store.folder / ".incoming-dead" / "lock").write_bytes(b"")
    (store.folder / ".incoming-young").mkdir()
    assert remove_stale(store) == 1
    monkeypatch.setattr(claims, "UNLOCKED_S", 0.0)
    assert remove_stale(store) == 1
    assert leftovers(store) == [under_way.folder.name]
    take_in(**arguments(under_way))
    assert under_way.accept("tiny")[1]


def test_nothing_is_written_after_a_discard(store):
    incoming = IncomingDataset(store, 1000)
    incoming.begin_file("a")
    incoming.discard()
    incoming.discard()
    with pytest.raises(ValueError, match="discarded"):
        incoming.begin_file("b")
    assert leftovers(store) == []


def test_a_cine_loop_with_its_poses_becomes_a_dataset(store, receive, tmp_path):
    path = write_cine(tmp_path)
    incoming = receive({f"deep/{name}": (tmp_path / name).read_bytes() for name in (path.name, "sweep.poses.npy")})
    take_in(**arguments(incoming, crop="4:24,2:22"))
    record, _ = incoming.accept("tiny")
    assert (record.kind, record.train_frames, record.val_frames, record.width) == ("dicom", 8, 2, 20)
    assert store.load("tiny").sha256 == record.sha256
    alone = receive({path.name: path.read_bytes()})
    with pytest.raises(DatasetInvalid, match=r"^sweep\.dcm: the poses of its frames must lie beside it"):
        take_in(**arguments(alone))

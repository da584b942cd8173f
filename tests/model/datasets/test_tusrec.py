"""Scans of TUS-REC, in files as the challenge publishes them."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, ExtraMissing
from ultragray.geometry.rotations import rotations_of

COUNT, ROWS, COLUMNS = 12, 48, 64
SCALE = np.diag([0.229389190673828, 0.220979690551758, 1.0, 1.0])
TOOL = np.eye(4)
TOOL[:3, :3] = rotations_of(np.array([[0.4, -0.7, 1.1]]))[0]
TOOL[:3, 3] = -70.7, -80.6, 117.0
FRAMES = np.random.default_rng(0).integers(0, 250, (COUNT, ROWS, COLUMNS), dtype=np.uint8)
TFORMS = np.tile(np.eye(4), (COUNT, 1, 1))
TFORMS[:, :3, :3] = rotations_of(np.linspace(0, 0.3, COUNT)[:, None] * [1.0, 2.0, 0.5])
TFORMS[:, :3, 3] = np.linspace(0, 20, COUNT)[:, None] * [1.0, -2.0, 0.3] + [100.0, 50.0, -900.0]


def rows(matrix: np.ndarray) -> str:
    return "\n".join(",".join(f"{value:.12g}" for value in row) for row in matrix)


CALIBRATION = (
    f"scaling_from_pixel_to_mm,,,\n{rows(SCALE)}\n"
    f"spatial_calibration_from_image_coordinate_system_to_tracking_tool_coordinate_system,,,\n{rows(TOOL)}\n"
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write(folder: str = "frames_transfs/000", calibration: str | None = CALIBRATION, **arrays: Any) -> Path:
        path = tmp_path / folder / "RH_Par_L_DtP.h5"
        path.parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(path, "w") as file:
            for name, array in {"frames": FRAMES, "tforms": TFORMS.astype(np.float32), **arrays}.items():
                if array is not None:
                    file[name] = array
        if calibration is not None:
            (tmp_path / "calib_matrix.csv").write_text(calibration)
        return path

    return write


def test_a_scan_has_the_poses_of_the_challenges_own_code(write: Callable[..., Path]) -> None:
    """There a pixel is T · calibration · scaling · (column, row, 0, 1), counted from 1."""
    dataset = load_dataset(write())
    sweep = dataset.train
    assert (dataset.name, sorted([*sweep.frame_numbers, *dataset.val.frame_numbers])) == (
        "RH_Par_L_DtP",
        [*range(COUNT)],
    )
    np.testing.assert_array_equal(sweep.images, FRAMES[sweep.frame_numbers])
    assert sweep.probe.far_mm == pytest.approx(ROWS * SCALE[1, 1], abs=1e-6)
    for number, pose in zip(sweep.frame_numbers, sweep.poses, strict=True):
        chain = TFORMS[number] @ TOOL @ SCALE
        for column, row in ((1, 1), (COLUMNS, ROWS)):
            theirs = (chain @ (column, row, 0, 1))[:3]
            x_mm = (column - 1 - (COLUMNS - 1) / 2) * SCALE[0, 0]
            ours = (pose @ (x_mm, 0, (row - 1 + 0.5) * SCALE[1, 1], 1))[:3]
            assert np.abs(ours - theirs).max() < 0.02
    assert [link.transform for link in sweep.chain.links] == [
        "scaling_from_pixel_to_mm",
        "spatial_calibration",
        "tforms",
    ]


def test_crops_and_ranges_of_frames(write: Callable[..., Path]) -> None:
    path = write()
    whole = load_dataset(path).train
    cut = load_dataset(path, SourceOptions(crop="10:50,8:40", frames="2:9")).train
    np.testing.assert_array_equal(cut.images, FRAMES[cut.frame_numbers, 8:40, 10:50])
    at = {int(number): pose for number, pose in zip(whole.frame_numbers, whole.poses, strict=True)}
    shift = ((10 + 50 - COLUMNS) / 2 * SCALE[0, 0], 0.0, 8 * SCALE[1, 1], 1.0)
    for number, pose in zip(cut.frame_numbers, cut.poses, strict=True):
        if number in at:
            assert np.abs(pose[:3, 3] - (at[number] @ shift)[:3]).max() < 1e-4


def test_the_calibration_may_be_named(write: Callable[..., Path], tmp_path: Path) -> None:
    path = write("alone", calibration=None)
    with pytest.raises(DatasetInvalid, match=r"its calibration calib_matrix\.csv must lie beside it"):
        load_dataset(path)
    named = tmp_path / "other.csv"
    named.write_text(CALIBRATION.replace(",,,", ""))
    found = load_dataset(path, SourceOptions(calibration=named))
    np.testing.assert_allclose(found.train.poses, load_dataset(write()).train.poses, atol=1e-9)


@pytest.mark.parametrize(
    ("arrays", "calibration", "message"),
    [
        ({"tforms": None}, CALIBRATION, "it must have frames and tforms, it has frames"),
        ({"tforms": TFORMS[:3]}, CALIBRATION, r"tforms must be numbers \[12, 4, 4\], got float64 \[3, 4, 4\]"),
        (
            {"tforms": TFORMS[:0], "frames": FRAMES[:0]},
            CALIBRATION,
            r"it holds no frames, its frames are \[0, 48, 64\]",
        ),
        ({"frames": FRAMES.astype(np.float32)}, CALIBRATION, "frames must be uint8"),
        ({"tforms": 2 * TFORMS}, CALIBRATION, "frame 0: its pose must end in the row"),
        ({}, "scaling\n1,0,0,0\n", "scaling must be sixteen finite numbers"),
        ({}, f"scaling\n{rows(SCALE)}\n", "no matrix whose name begins with spatial_calibration"),
        (
            {},
            CALIBRATION.replace(rows(SCALE), rows(np.diag([229.0, 221.0, 1, 1]))),
            r"calib_matrix\.csv makes a pixel 229",
        ),
    ],
)
def test_what_cannot_be_used_is_one_clear_error(
    write: Callable[..., Path], arrays: dict[str, Any], calibration: str, message: str
) -> None:
    with pytest.raises(DatasetInvalid, match=message):
        load_dataset(write(calibration=calibration, **arrays))


@pytest.mark.parametrize("kind", ["external link", "soft link", "external bytes", "virtual"])
def test_arrays_of_other_files_are_not_read(write: Callable[..., Path], tmp_path: Path, kind: str) -> None:
    """An upload must not show what else lies on the machine."""
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["frames"] = FRAMES
    path = write(frames=None)
    with h5py.File(path, "a") as file:
        if kind == "external link":
            file["frames"] = h5py.ExternalLink(str(secret), "/frames")
        elif kind == "soft link":
            file["other"] = FRAMES
            file["frames"] = h5py.SoftLink("/other")
        elif kind == "external bytes":
            (tmp_path / "secret.raw").write_bytes(FRAMES.tobytes())
            places = [(str(tmp_path / "secret.raw"), 0, FRAMES.nbytes)]
            file.create_dataset("frames", FRAMES.shape, "u1", external=places)
        else:
            layout = h5py.VirtualLayout(FRAMES.shape, "u1")
            layout[:] = h5py.VirtualSource(str(secret), "frames", FRAMES.shape)
            file.create_virtual_dataset("frames", layout)
    with pytest.raises(DatasetInvalid, match="frames and tforms must lie in the file itself"):
        load_dataset(path)


def test_frames_without_a_pose_are_left_out(write: Callable[..., Path]) -> None:
    tforms = TFORMS.copy()
    tforms[5] = np.nan
    dataset = load_dataset(write(tforms=tforms))
    assert 5 not in [*dataset.train.frame_numbers, *dataset.val.frame_numbers]
    assert any("were left out: 5 (1 in all)" in note for note in dataset.train.notes)


def test_files_that_are_no_hdf5(tmp_path: Path, write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    path = write()
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(DatasetInvalid, match=r"\.h5: it cannot be read as HDF5"):
        load_dataset(path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ExtraMissing, match=r"ultragray\[hdf5\]"):
        load_dataset(path)


def test_one_scan_as_other_writers_have_it(write: Callable[..., Path], tmp_path: Path) -> None:
    """Other types, orders of bytes, chunks, matrices and lines give the same poses and pixels."""
    expected = load_dataset(write()).train
    first, second = CALIBRATION.split("spatial")
    others = {
        "big endian": write("a", tforms=TFORMS.astype(">f8")),
        "one channel": write("b", frames=FRAMES[..., None]),
        "in colour": write("c", frames=np.repeat(FRAMES[..., None], 3, axis=-1)),
        "matrices in another order": write("d"),
        "lines of Windows": write("e"),
    }
    calibrations = {
        "matrices in another order": f"spatial{second}{first}",
        "lines of Windows": "\ufeff" + CALIBRATION.replace("\n", "\r\n").replace("spatial", "\r\nspatial"),
    }
    with h5py.File(write("g", frames=None), "a") as file:
        file.create_dataset("frames", data=FRAMES, chunks=(1, 16, 16), compression="gzip", shuffle=True)
    others["compressed"] = tmp_path / "g" / "RH_Par_L_DtP.h5"
    for name, path in others.items():
        (tmp_path / "calib_matrix.csv").write_text(calibrations.get(name, CALIBRATION))
        found = load_dataset(path).train
        assert np.abs(found.poses[:, :3, 3] - expected.poses[:, :3, 3]).max() < 1e-3, name
        np.testing.assert_array_equal(found.images, expected.images)
    for frames, tforms in ((FRAMES.transpose(2, 1, 0), TFORMS.transpose(2, 1, 0)), (FRAMES, TFORMS.transpose(0, 2, 1))):
        with pytest.raises(DatasetInvalid):  # as MATLAB turns axes round, and of rows instead of columns
            load_dataset(write("h", frames=frames, tforms=tforms))
    small = TOOL.copy()
    small[:3, 3] /= 1000
    metres = f"scaling\n{rows(SCALE)}\nspatial_calibration\n{rows(small)}\n"
    assert any("is its translation in metres" in note for note in load_dataset(write("i", metres)).train.notes)

"""Recordings of every kind, put together at random: what is read of them is what an independent reader finds.

Poses are compared with products of matrices and SciPy's interpolation, pixels with SimpleITK and pydicom. What differs
must be refused in words, or told by a note.
"""

import io
import json
import shutil

import cv2
import numpy as np
import pytest
import SimpleITK
from hypothesis import strategies as st
from PIL import Image
from pydicom.encaps import encapsulate
from pydicom.pixels import convert_color_space, pixel_array
from pydicom.uid import JPEG2000, ExplicitVRLittleEndian, JPEG2000Lossless, JPEGBaseline8Bit
from scipy.spatial.transform import Rotation, Slerp

from ultragray.datasets.plus import read_plus_sweep
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid
from ultragray.exchange import ros_messages as ros

from ..dicom_files import write_cine
from ..mcap_files import START_NS, Bag, image_message, pose_message
from ..model.datasets.conftest import DEVICE_SET, IMAGE_TO_PROBE, numbers, plus_files, speckle, write_mha, write_nrrd
from ..model.datasets.test_chain import FRAMES, check_poses, describe, random_chain
from ..model.datasets.test_dicom_pixels import STREAMS, luma

__all__ = ["describe", "plus_files"]

pytestmark = pytest.mark.long

SEEDS = st.integers(0, 2**32 - 1)
ORIENTATIONS = {  # of stored frames [F, rows, columns], by which way their columns and rows go
    "MF": lambda frames: frames,
    "UF": lambda frames: frames[:, :, ::-1],
    "MN": lambda frames: frames[:, ::-1],
    "UN": lambda frames: frames[:, ::-1, ::-1],
    "FM": lambda frames: frames.transpose(0, 2, 1),
    "NU": lambda frames: frames[:, ::-1, ::-1].transpose(0, 2, 1),
}
LOST = ("INVALID", "MISSING", "OUT_OF_VIEW", "REQ_TIMEOUT")


def recorded(folder, random, transforms, lost):
    """A sequence whose frames have these transforms; those of a lost frame have another status."""
    fields = {}
    for key, given in transforms.items():
        for frame, matrix in enumerate(given if isinstance(given, list) else [given] * FRAMES):
            fields[f"Seq_Frame{frame:04d}_{key}Transform"] = numbers(matrix)
            status = random.choice(LOST) if frame in lost and isinstance(given, list) else "OK"
            fields[f"Seq_Frame{frame:04d}_{key}TransformStatus"] = status
    orientation = random.choice(list(ORIENTATIONS))
    fields["UltrasoundImageOrientation"] = orientation
    stored = np.ascontiguousarray(ORIENTATIONS[orientation](speckle(FRAMES, 30, 20, int(random.integers(1000)))))
    is_packed = bool(random.random() < 0.5)
    if random.random() < 0.5:
        return write_nrrd(folder / "s.nrrd", stored, fields, encoding="gzip" if is_packed else "raw"), orientation
    return write_mha(folder / "s.mha", stored, fields, deflate=is_packed), orientation


def test_transform_chains(door, tmp_path, describe):
    def attempt(seed):
        random = np.random.default_rng(seed)
        inside, outside, products = random_chain(random)
        lost = set(np.flatnonzero(random.random(FRAMES) < 0.2)) - {0}
        path, orientation = recorded(tmp_path, random, inside, lost)
        left, top = (int(value) for value in random.integers(0, 9, 2))
        right, bottom = 20 - int(random.integers(0, 9)), 30 - int(random.integers(0, 9))
        options = {"crop": f"{left}:{right},{top}:{bottom}"} if random.random() < 0.7 else {}
        left, right, top, bottom = (left, right, top, bottom) if options else (0, 20, 0, 30)
        sweep, _ = read_plus_sweep(path, device_set=describe(outside), **options)
        kept = [frame for frame in range(FRAMES) if frame not in lost]
        assert sweep.frame_numbers.tolist() == kept
        check_poses(sweep, [products[frame] for frame in kept], left, right, top)
        if path.suffix == ".mha":  # SimpleITK takes the list of an NRRD for another axis
            stored = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(path))
            whole = ORIENTATIONS["UN" if orientation == "NU" else orientation](
                stored.transpose(0, 2, 1) if orientation == "NU" else stored
            )
            np.testing.assert_array_equal(sweep.images, whole[kept, top:bottom, left:right])

    door("transform chains").enter(SEEDS, attempt)


TOP_CENTRE = np.array([9.5, -0.5, 0.0, 1.0])  # of images of 20 columns


class Motion:
    """A hand's motion, sampled at uneven times, as a tracker tells it."""

    def __init__(self, random, count):
        steps_s = 0.03 + 0.03 * random.random(count)
        steps_s[random.random(count) < 0.05] = 0.5  # a gap
        self.times_s = np.round(5.0 + np.cumsum(steps_s), 6)
        self.rotations = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.03, (count, 3)), axis=0))
        self.positions = np.cumsum(random.normal(0, 2, (count, 3)), axis=0)

    def poses(self):  # [N, 4, 4]
        return self._matrices(self.rotations, self.positions)

    def at(self, times_s):
        """The poses between those before and after, [N, 4, 4], and which of them a recording must know: not those of
        gaps and beyond the ends; within a microsecond of either it may say what it likes."""
        slerp, within = Slerp(self.times_s, self.rotations), np.clip(times_s, self.times_s[0], self.times_s[-1])
        positions = np.stack([np.interp(within, self.times_s, one) for one in self.positions.T], axis=1)
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        is_inside = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        known = is_inside & (self.times_s[after] - self.times_s[after - 1] < 0.4)
        is_edge = np.abs(times_s[:, None] - self.times_s).min(axis=1) < 2e-6
        return self._matrices(slerp(within), positions), known, is_edge

    @staticmethod
    def _matrices(rotations, positions):
        poses = np.tile(np.eye(4), (len(positions), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = rotations.as_matrix(), positions
        return poses


def as_plus(folder, motion, images):
    fields = {"UltrasoundImageOrientation": "MF"}
    for frame, (time_s, pose) in enumerate(zip(motion.times_s, motion.poses(), strict=True)):
        fields[f"Seq_Frame{frame:04d}_ProbeToTrackerTransform"] = numbers(pose)
        fields[f"Seq_Frame{frame:04d}_Timestamp"] = repr(float(time_s))
    (folder / "set.xml").write_text(DEVICE_SET.format(matrix=numbers(IMAGE_TO_PROBE)))
    path = write_mha(folder / "s.mha", images, fields)
    return path, SourceOptions(device_set=folder / "set.xml"), IMAGE_TO_PROBE @ TOP_CENTRE


def as_table(folder, motion, images):
    folder = folder / "table"
    folder.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"{number:03d}.png"), image)
    columns = [motion.times_s[:, None], motion.positions, np.roll(motion.rotations.as_quat(), 1, axis=1)]
    rows = np.concatenate(columns, axis=1).tolist()
    lines = ["time,x_mm,y_mm,z_mm,qw,qx,qy,qz", *(",".join(map(repr, row)) for row in rows)]
    (folder / "poses.csv").write_text("\n".join(lines))
    (folder / "calibration.json").write_text(json.dumps({"image_to_sensor": IMAGE_TO_PROBE.tolist()}))
    return folder, SourceOptions(), IMAGE_TO_PROBE @ TOP_CENTRE


def as_dicom(folder, motion, images):
    steps_ms = [0.0, *(1000 * np.diff(motion.times_s)).round(3).tolist()]
    size = {"Rows": images.shape[1], "Columns": images.shape[2], "NumberOfFrames": len(images)}
    described = {"SequenceOfUltrasoundRegions": None, "PixelSpacing": [0.3, 0.3], "FrameTimeVector": steps_ms}
    path = write_cine(folder, poses=motion.poses(), data=images.tobytes(), **size, **described)
    return path, SourceOptions(), np.array([0.0, 0.0, 0.0, 1.0])


def as_mcap(folder, motion, images):
    bag = Bag(folder / "sweep.mcap")
    bag.geometry()
    ns = [START_NS + round(1e9 * time_s) for time_s in motion.times_s]
    for time_ns, pose in zip(ns, motion.poses(), strict=True):
        bag.write("/pose", ros.POSE, pose_message(pose, time_ns), time_ns)
    for time_ns, image in zip(ns, images, strict=True):
        bag.write("/us/image", ros.IMAGE, image_message(image, time_ns), time_ns)
    return bag.finish(), SourceOptions(), np.array([0.0, 0.0, 0.0, 1.0])


def test_clocks(door, tmp_path):
    def attempt(seed):
        random = np.random.default_rng(seed)
        motion, images = Motion(random, 14), speckle(14, 30, 20, seed % 1000)
        delay_ms = round(float(random.uniform(-150, 150)), 3) if random.random() < 0.8 else 0.0
        folder = tmp_path / "recording"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        path, options, origin = random.choice([as_plus, as_table, as_dicom, as_mcap])(folder, motion, images)
        options = SourceOptions(**{**vars(options), "image_delay_ms": str(delay_ms) if delay_ms else None})
        expected, known, is_edge = motion.at(motion.times_s - delay_ms / 1000)
        known |= delay_ms == 0
        try:
            dataset = load_dataset(path, options)
        except DatasetInvalid as error:
            if (known & ~is_edge).sum() >= 2:
                raise AssertionError("it was refused") from error
            return
        found = {}
        for part in (dataset.train, dataset.val):
            rows = zip(part.poses, part.images, part.times_s, strict=True)
            found |= dict(zip(part.frame_numbers.tolist(), rows, strict=True))
        for frame in range(14):
            assert frame in found or not known[frame] or is_edge[frame], f"frame {frame} was left out"
            if frame not in found:
                continue
            assert known[frame] or is_edge[frame], f"frame {frame} has a pose that nobody knows"
            pose, image, time_s = found[frame]
            np.testing.assert_array_equal(image, images[frame])
            assert np.abs(pose[:3, 3] - (expected[frame] @ origin)[:3]).max() < 0.02
            axis = expected[frame][:3, 0]
            assert np.abs(pose[:3, 0] - axis).max() < 1e-4
            assert abs((time_s - found[min(found)][2]) - (motion.times_s[frame] - motion.times_s[min(found)])) < 1e-3

    door("clocks").enter(SEEDS, attempt)


def coloured(random, kind):  # [3, 24, 32, 3] uint8
    """Grey echoes beside black, with a box of colours, or all in colour."""
    shape = (3, 4, 5, 3) if kind == "colour" else (3, 4, 5, 1)
    coarse = random.integers(20, 235, shape).astype(np.uint8)
    frames = np.stack([np.atleast_3d(cv2.resize(one, (32, 24), interpolation=cv2.INTER_CUBIC)) for one in coarse])
    frames = np.ascontiguousarray(np.broadcast_to(frames, (3, 24, 32, 3)))
    if kind == "flow":
        frames[:, 8:16, 10:22] = random.integers(0, 256, 3)
    return frames


def jpeg_2000(frame, word):
    out = io.BytesIO()
    Image.fromarray(frame).save(out, "JPEG2000", irreversible=word == "YBR_ICT", mct=int(word != "RGB"), no_jp2=True)
    return out.getvalue()


def pixels_of(random, colour):
    """The elements of a file with these colours, the word that is right for them, others, and whether a stream says so
    itself, by markers of JFIF or Adobe."""
    planar = int(random.random() < 0.5)
    kind = random.choice(["raw", "jpeg", "jpeg 2000"])
    if kind == "jpeg":
        stream = random.choice(list(STREAMS))
        data = encapsulate([STREAMS[stream](frame) for frame in colour])
        described = {"syntax": JPEGBaseline8Bit, "data": data, "PlanarConfiguration": 0}
        right = "RGB" if stream.startswith("RGB") else "YBR_FULL_422"
        return described, right, ["RGB", "YBR_FULL", "YBR_FULL_422"], "bare" not in stream
    if kind == "jpeg 2000":
        word = random.choice(["RGB", "YBR_RCT", "YBR_ICT"])
        syntax = JPEG2000 if word == "YBR_ICT" else JPEG2000Lossless
        data = encapsulate([jpeg_2000(frame, word) for frame in colour])
        return {"syntax": syntax, "data": data, "PlanarConfiguration": 0}, word, [word], False
    word = random.choice(["RGB", "YBR_FULL"])
    stored = colour if word == "RGB" else convert_color_space(colour, "RGB", "YBR_FULL")
    stored = stored.transpose(0, 3, 1, 2) if planar else stored
    described = {"syntax": ExplicitVRLittleEndian, "data": stored.tobytes(), "PlanarConfiguration": planar}
    return described, word, ["RGB", "YBR_FULL"], False


def grey_pixels(random, colour):
    bits = int(random.choice([8, 10, 12, 16]))
    stored = colour[..., 0].astype("<u2" if bits > 8 else np.uint8) << bits - 8
    described = {"BitsAllocated": 8 * stored.itemsize, "BitsStored": bits, "HighBit": bits - 1}
    return {**described, "data": stored.tobytes()}, bits


@pytest.mark.filterwarnings("ignore:The .0028,0004. 'Photometric Interpretation' value")  # of pydicom
def test_photometric_words(door, tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 1, 3] = range(3)
    size = {"Rows": 24, "Columns": 32, "NumberOfFrames": 3}
    size |= {"SequenceOfUltrasoundRegions": None, "PixelSpacing": [0.3, 0.3], "poses": poses}

    def read(**described):
        dataset = load_dataset(write_cine(tmp_path, **size, **described))
        images = {**dict(zip(dataset.train.frame_numbers.tolist(), dataset.train.images, strict=True))}
        images |= dict(zip(dataset.val.frame_numbers.tolist(), dataset.val.images, strict=True))
        return np.stack([images[frame] for frame in range(3)]).astype(float), dataset.train.notes

    def attempt(seed):
        random = np.random.default_rng(seed)
        kind = random.choice(["grey", "flow", "colour", "one sample"])
        colour = coloured(random, kind)
        if kind == "one sample":
            described, bits = grey_pixels(random, colour)
            word = random.choice(["MONOCHROME1", "MONOCHROME2"])
            images, _ = read(PhotometricInterpretation=word, **described)
            stored = pixel_array(tmp_path / "sweep.dcm") / 2 ** (bits - 8)
            assert np.abs(images - (255 - stored if word == "MONOCHROME1" else stored)).max() <= 1
            return
        described, right, words, is_marked = pixels_of(random, colour)
        described["SamplesPerPixel"] = 3
        said = random.choice(words)
        images, notes = read(PhotometricInterpretation=said, **described)
        as_said = np.rint(luma(pixel_array(tmp_path / "sweep.dcm")))
        as_is = np.rint(luma(pixel_array(write_cine(tmp_path, **size, PhotometricInterpretation=right, **described))))
        differs = np.abs(images - as_is).max() > 1
        if kind != "colour":  # what is grey as one and not as the other is read as it is
            assert not differs
        elif differs:  # nothing tells that the header is wrong
            assert np.abs(images - as_said).max() <= 1
        if np.abs(images - as_said).max() > 1 and not is_marked:
            assert any(note.startswith(f"the header says {said}") for note in notes)

    door("photometric words").enter(SEEDS, attempt)

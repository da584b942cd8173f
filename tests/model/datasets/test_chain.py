"""The way from pixels to the world: whatever file and device set say of it takes part in it, or is named."""

from itertools import pairwise

import numpy as np
import pytest

from ultragray.datasets import Dataset
from ultragray.datasets.checks import check_dataset
from ultragray.datasets.plus import read_plus_sweep
from ultragray.errors import DatasetInvalid
from ultragray.geometry.rotations import rotations_of

ROWS, COLUMNS, FRAMES = 30, 20, 5
CALIBRATION = np.array([[0.2, 0.0, 0, -3.0], [0.0, 0.0, 1, 1.0], [0.0, 0.1, 0, 2.0], [0, 0, 0, 1.0]])


def rigid(seed):
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = rotations_of(random.normal(0, 1, (1, 3)))[0]
    pose[:3, 3] = random.normal(0, 100, 3)
    return pose


def crop_of(left, top, scale=(1.0, 1.0)):
    matrix = np.diag([*scale, 1.0, 1.0])
    matrix[:2, 3] = -left * scale[0], -top * scale[1]
    return matrix


@pytest.fixture
def record(tmp_path, plus_files):
    """Write a sequence whose frames have these transforms: one matrix, or one a frame (None: missing)."""

    def write(transforms, name="s.mha", count=FRAMES, **fields):
        written = {"UltrasoundImageOrientation": "MF"}
        for key, given in transforms.items():
            matrices = given if isinstance(given, list) else [given] * count
            for frame, matrix in enumerate(matrices):
                if matrix is not None:
                    written[f"Seq_Frame{frame:04d}_{key}Transform"] = plus_files.numbers(matrix)
                    written[f"Seq_Frame{frame:04d}_{key}TransformStatus"] = "OK"
        stored = plus_files.speckle(count, ROWS, COLUMNS)
        path = plus_files.write_mha(tmp_path / name, stored, {**written, **fields})
        return path

    return write


@pytest.fixture
def describe(tmp_path, plus_files):
    """Write a device set."""

    def write(transforms, others=""):
        lines = [
            f'<Transform From="{a}" To="{b}" Matrix="{plus_files.numbers(m)}"/>' for (a, b), m in transforms.items()
        ]
        path = tmp_path / "set.xml"
        path.write_text(
            f"<PlusConfiguration><CoordinateDefinitions>{''.join(lines)}</CoordinateDefinitions>{others}"
            "</PlusConfiguration>"
        )
        return path

    return write


TRACKED = [rigid(10 + frame) for frame in range(FRAMES)]


def plus_translation(x_mm):
    matrix = np.eye(4)
    matrix[0, 3] = x_mm
    return matrix


def top_centres(transforms, columns=COLUMNS):
    return np.array([(transform @ ((columns - 1) / 2, -0.5, 0, 1))[:3] for transform in transforms])


def test_a_recording_that_plus_cropped_is_the_crop_of_the_whole_one(record):
    """PLUS writes ImageToCroppedImage into every frame that its tool crops."""
    whole = record({"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED}, "whole.mha")
    expected, _ = read_plus_sweep(whole, crop="4:14,6:26")
    for crop, resize in (((4.0, 6.0), (1.0, 1.0)), ((4.0, 6.0), (2.0, 2.0))):
        path = record(
            {"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED, "ImageToCroppedImage": crop_of(*crop, resize)}
        )
        sweep, _ = read_plus_sweep(path)
        transforms = [pose @ CALIBRATION @ np.linalg.inv(crop_of(*crop, resize)) for pose in TRACKED]
        assert np.abs(sweep.poses[:, :3, 3] - top_centres(transforms)).max() < 1e-6
        assert [str(link).partition(":")[0] for link in sweep.chain.links] == [
            "CroppedImage → Image",
            "Image → Probe",
            "Probe → Tracker",
        ]
        if resize == (1.0, 1.0):
            shift = expected.poses[:, :3, 0] * 0.2 * ((COLUMNS - 10) / 2)  # the picture is wider by ten columns
            np.testing.assert_allclose(sweep.poses[:, :3, 3], expected.poses[:, :3, 3] + shift, atol=1e-6)


@pytest.mark.parametrize(
    "transforms",
    [
        {"ImageToCroppedImage": crop_of(4, 6)},
        {"CroppedImageToImage": np.linalg.inv(crop_of(4, 6))},
        {"ImageToResizedImage": crop_of(0, 0, (0.5, 0.5)), "ResizedImageToCroppedImage": crop_of(2, 3)},
        {"ImageToFlippedImage": crop_of(COLUMNS - 1, 0, (-1.0, 1.0))},
    ],
    ids=lambda transforms: next(iter(transforms)),
)
def test_every_frame_of_pixels_takes_part(record, transforms):
    path = record({"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED, **transforms})
    sweep, _ = read_plus_sweep(path)
    to_image = np.eye(4)
    for name, matrix in transforms.items():
        to_image = to_image @ (matrix if name.endswith("ToImage") else np.linalg.inv(matrix))
    expected = top_centres([pose @ CALIBRATION @ to_image for pose in TRACKED])
    assert np.abs(sweep.poses[:, :3, 3] - expected).max() < 1e-6
    assert {link.transform for link in sweep.chain.links} == {"ImageToProbe", "ProbeToTracker", *transforms}
    assert sweep.chain.left_out == ()


def test_what_is_no_frame_of_the_pixels_is_named(record):
    plain, _ = read_plus_sweep(record({"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED}, "plain.mha"))
    path = record({"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED, "ImageToMRImage": rigid(3)})
    sweep, _ = read_plus_sweep(path)
    np.testing.assert_allclose(sweep.poses, plain.poses)
    assert sweep.chain.left_out == ("ImageToMRImage of s.mha",)
    both = {"ImageToCroppedImage": crop_of(4, 6), "ImageToResizedImage": crop_of(0, 0, (0.5, 0.5))}
    with pytest.raises(DatasetInvalid, match=r"which of the images its pixels are.*CroppedImage and ResizedImage"):
        read_plus_sweep(record({"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED, **both}))


def test_a_tracked_transform_goes_before_a_fixed_one_of_its_name(record, describe):
    path = record({"ProbeToTracker": TRACKED})
    expected, _ = read_plus_sweep(path, device_set=describe({("Image", "Probe"): CALIBRATION}))
    for pair in (("Probe", "Tracker"), ("Tracker", "Probe")):
        xml = describe({("Image", "Probe"): CALIBRATION, pair: rigid(1)})
        sweep, _ = read_plus_sweep(path, device_set=xml)
        np.testing.assert_allclose(sweep.poses, expected.poses)
        assert f"{'To'.join(pair)} of set.xml is left out: the sequence tracks ProbeToTracker" in sweep.notes
    fixed, _ = read_plus_sweep(
        path, device_set=describe({("Image", "Probe"): CALIBRATION, ("Reference", "Tracker"): rigid(2)})
    )
    assert [(link.transform, link.source, link.is_tracked) for link in fixed.chain.links] == [
        ("ImageToProbe", "set.xml", False),
        ("ProbeToTracker", "s.mha", True),
        ("ReferenceToTracker", "set.xml", False),
    ]
    np.testing.assert_allclose(fixed.poses, np.linalg.inv(rigid(2)) @ expected.poses, atol=1e-9)


def test_a_calibration_of_the_device_set_goes_before_that_of_the_sequence(record, describe):
    other = CALIBRATION.copy()
    other[0, 3] += 7.0
    path = record({"ImageToProbe": other, "ProbeToTracker": TRACKED})
    sweep, _ = read_plus_sweep(path, device_set=describe({("Image", "Probe"): CALIBRATION}))
    assert np.abs(sweep.poses[:, :3, 3] - top_centres([pose @ CALIBRATION for pose in TRACKED])).max() < 1e-6
    (told,) = (note for note in sweep.notes if "ImageToProbe" in note)
    assert "of the sequence is left out, set.xml has another one: pixels of 0.2 x 0.1 and 0.2 x 0.1 mm" in told
    assert "origins 7 mm apart" in told


def test_transforms_in_some_frames_only(record):
    reference = [rigid(1), None, rigid(1), rigid(2), None]
    once = [CALIBRATION, None, None, None, None]
    sweep, _ = read_plus_sweep(
        record({"ImageToProbe": once, "ProbeToTracker": TRACKED, "ReferenceToTracker": reference})
    )
    assert sweep.frame_numbers.tolist() == [0, 2, 3]
    expected = [np.linalg.inv(reference[frame]) @ TRACKED[frame] @ CALIBRATION for frame in (0, 2, 3)]
    assert np.abs(sweep.poses[:, :3, 3] - top_centres(expected)).max() < 1e-6
    assert "ImageToProbe is in 1 of 5 frames: taken for all" in sweep.notes
    assert "left out: 1, 4 (2 in all: ReferenceToTracker missing in 2)" in "".join(sweep.notes)


def test_another_way_that_leads_elsewhere_is_named(record):
    direct = [pose @ CALIBRATION for pose in TRACKED]
    transforms = {"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED}
    agreeing, _ = read_plus_sweep(record({**transforms, "ImageToTracker": direct}))
    assert not [note for note in agreeing.notes if "left out" in note]
    off = [TRACKED[frame] @ plus_translation(12.0) @ CALIBRATION for frame in range(FRAMES)]
    named, _ = read_plus_sweep(record({**transforms, "ImageToTracker": off, "StylusToTracker": rigid(4)}))
    assert np.abs(named.poses[:, :3, 3] - top_centres(off)).max() < 1e-6
    told = [note for note in named.notes if "is left out: it is 12 mm from the way that was taken" in note]
    assert [note.partition(" ")[0] for note in told] == ["ImageToProbe", "ProbeToTracker"]
    assert named.chain.left_out == ("ImageToProbe of s.mha", "ProbeToTracker of s.mha", "StylusToTracker of s.mha")


@pytest.mark.parametrize("word", ["INVALID", "MISSING", "OUT_OF_VIEW", "OUT_OF_VOLUME", "REQ_TIMEOUT", "SWITCH1_IS_ON"])
def test_status_words_are_named(record, word):
    path = record(
        {"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED},
        Seq_Frame0002_ProbeToTrackerTransformStatus=word,
    )
    sweep, _ = read_plus_sweep(path)
    assert sweep.frame_numbers.tolist() == [0, 1, 3, 4]
    assert f"left out: 2 (1 in all: ProbeToTracker {word} in 1)" in sweep.notes[0]


ONES = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
CLIP = '<VolumeReconstruction ClipRectangleOrigin="{}" ClipRectangleSize="{}"/>'


def test_the_rectangle_of_the_device_set_is_the_crop(record, describe):
    path = record({"ProbeToTracker": TRACKED})
    calibration = {("Image", "Probe"): CALIBRATION}
    xml = describe(calibration, CLIP.format("4 6", "10 20"))
    expected, _ = read_plus_sweep(path, device_set=xml, crop="4:14,6:26")
    sweep, _ = read_plus_sweep(path, device_set=xml)
    np.testing.assert_array_equal(sweep.images, expected.images)
    np.testing.assert_allclose(sweep.poses, expected.poses)
    assert "the device set clips to columns and rows 4:14,6:26: taken; --crop takes another part" in sweep.notes
    assert not [note for note in sweep.notes if "no crop" in note]
    beyond, _ = read_plus_sweep(path, device_set=describe(calibration, CLIP.format("4 6", "100 100")))
    assert beyond.images.shape == (FRAMES, 24, 16)
    for element in ("Device", "Segmentation"):  # the first was applied when it recorded, the second is for wires
        others = f'<{element} ClipRectangleOrigin="4 6" ClipRectangleSize="10 20"/>'
        whole, _ = read_plus_sweep(path, device_set=describe(calibration, others))
        assert whole.images.shape == (FRAMES, ROWS, COLUMNS)
        assert f"the rectangle of {element} in the device set is not taken: --crop 4:14,6:26 does" in whole.notes
    cropped = record({"ProbeToTracker": TRACKED, "ImageToCroppedImage": crop_of(2, 3)}, "cropped.mha")
    shifted, _ = read_plus_sweep(cropped, device_set=describe(calibration, CLIP.format("4 6", "10 20")))
    np.testing.assert_allclose(shifted.poses[:, :3, 3], expected.poses[:, :3, 3], atol=1e-9)


@pytest.mark.parametrize(
    ("scale", "told"),
    [
        (
            1e-3,
            r"set\.xml: ImageToProbe makes a pixel 0\.0002 x 0\.0001 mm \(width x height\), .*: lengths in metres\?",
        ),
        (1e3, r"set\.xml: ImageToProbe makes a pixel 200 x 100 mm"),
    ],
)
def test_a_calibration_that_no_image_has_is_named_with_its_file(record, describe, scale, told):
    matrix = CALIBRATION.copy()
    matrix[:3] *= scale
    with pytest.raises(DatasetInvalid, match=told):
        read_plus_sweep(record({"ProbeToTracker": TRACKED}), device_set=describe({("Image", "Probe"): matrix}))


def test_a_device_set_that_contradicts_itself_is_refused(record, describe):
    path, calibration = record({"ProbeToTracker": TRACKED}), {("Image", "Probe"): CALIBRATION}
    agreeing = describe({**calibration, ("Probe", "Image"): np.linalg.inv(CALIBRATION)})
    assert len(read_plus_sweep(path, device_set=agreeing)[0]) == FRAMES
    other = CALIBRATION @ plus_translation(1.0)
    twice = describe({**calibration, ("Probe", "Image"): np.linalg.inv(other)})
    with pytest.raises(DatasetInvalid, match=r"set\.xml: it has ProbeToImage twice, with different matrices"):
        read_plus_sweep(path, device_set=twice)
    xml = describe(calibration)
    xml.write_text(xml.read_text().replace("</Coord", f'<Transform From="Image" To="Probe" Matrix="{ONES}"/></Coord'))
    with pytest.raises(DatasetInvalid, match=r"set\.xml: it has ImageToProbe twice, with different matrices"):
        read_plus_sweep(path, device_set=xml)
    sweep, _ = read_plus_sweep(path, device_set=describe({("Image", "Probe"): np.eye(4)}))
    assert "ImageToProbe of set.xml is the identity: was the probe never calibrated?" in sweep.notes


def test_a_depth_that_changes_on_the_way_is_told_with_frames_and_sizes(record):
    deeper = CALIBRATION @ np.diag([2.0, 2.0, 1.0, 1.0])
    path = record({"ImageToProbe": [CALIBRATION] * 3 + [deeper] * 2, "ProbeToTracker": TRACKED})
    with pytest.raises(
        DatasetInvalid, match=r"frame 3, 4: a pixel is 0\.4 x 0\.2 mm, .*\(0, 1, 2\) 0\.2 x 0\.1: was the"
    ):
        read_plus_sweep(path)
    depths = {f"Seq_Frame{frame:04d}_DepthMm": "50" if frame < 3 else "80" for frame in range(FRAMES)}
    path = record({"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED}, **depths)
    with pytest.raises(DatasetInvalid, match=r"DepthMm changes on the way: 50 in 0, 1, 2; 80 in 3, 4"):
        read_plus_sweep(path)
    assert len(read_plus_sweep(path, frames="0:3")[0]) == 3


def test_names_in_the_header_are_told(record):
    path = record({"ImageToProbe": CALIBRATION, "ProbeToTracker": TRACKED}, PatientName="Doe", OperatorComment="x")
    assert "its header names a person (PatientName): convert --anonymize" in "".join(read_plus_sweep(path)[0].notes)


FRAMES_OF = ["Image", "TransducerOriginPixel", "TransducerOrigin", "Probe", "Holder", "Tracker", "Reference"]


def random_chain(random):
    """Links in the sequence or in the device set, either way round, tracked or fixed: those of each, and the product of
    each frame [4, 4]."""
    between = [name for name in FRAMES_OF[1:-2] if random.random() < 0.5 or name == "Probe"]
    frames = ["Image", *between, "Tracker", *(["Reference"] if random.random() < 0.5 else [])]
    inside, outside = {}, {}
    products = [np.eye(4) for _ in range(FRAMES)]
    for place, (origin, target) in enumerate(pairwise(frames)):
        is_tracked = origin == between[-1] or target == "Reference"
        matrices = [rigid(int(random.integers(1 << 30))) for _ in range(FRAMES)]
        if place == 0:
            matrices = [matrix @ np.diag([0.3, 0.2, 1.0, 1.0]) for matrix in matrices]
        if not is_tracked or place == 0:
            matrices = matrices[:1] * FRAMES
        products = [matrix @ product for matrix, product in zip(matrices, products, strict=True)]
        is_inverted = random.random() < 0.5
        name = (target, origin) if is_inverted else (origin, target)
        given = [np.linalg.inv(matrix) if is_inverted else matrix for matrix in matrices]
        if is_tracked or random.random() < 0.5:
            inside["To".join(name)] = given
        else:
            outside[name] = given[0]
    if random.random() < 0.5:
        crop = crop_of(*random.uniform(0, 9, 2), tuple(random.uniform(0.5, 2, 2)))
        inside["ImageToCroppedImage"] = crop
        products = [product @ np.linalg.inv(crop) for product in products]
    inside["StylusToTracker"] = rigid(5)
    return inside, outside | {("Phantom", "Table"): rigid(6)}, products


def check_poses(sweep, products, left=0, right=COLUMNS, top=0):
    """Asserts that the poses are those of these products, at the top centre of the part of the image."""
    for pose, product in zip(sweep.poses, products, strict=True):
        top_centre = product @ ((left + right - 1) / 2, top - 0.5, 0, 1)
        assert np.abs(pose[:3, 3] - top_centre[:3]).max() < 0.02
        np.testing.assert_allclose(pose[:3, 0], product[:3, 0] / np.linalg.norm(product[:3, 0]), atol=1e-6)
        assert pose[:3, 2] @ product[:3, 1] == pytest.approx(np.linalg.norm(product[:3, 1]), rel=1e-6)
    assert sweep.probe.width_mm == pytest.approx((right - left) * np.linalg.norm(products[0][:3, 0]), rel=1e-6)


@pytest.mark.parametrize("seed", range(40))
def test_random_chains_agree_with_their_product(seed, record, describe):
    inside, outside, products = random_chain(np.random.default_rng(seed))
    sweep, _ = read_plus_sweep(record(inside), device_set=describe(outside))
    check_poses(sweep, products)
    assert len(sweep.chain.links) == len(inside) + len(outside) - 2
    assert sweep.chain.left_out == ("PhantomToTable of set.xml", "StylusToTracker of s.mha")
    report = check_dataset(Dataset("s", sweep, sweep.select([])))
    assert report.chain == sweep.chain


def test_the_chain_goes_with_frames_that_are_chosen(make_sweep):
    sweep = make_sweep(6, times_s=np.arange(6) / 10)
    chosen = sweep.select([1, 4])
    assert chosen.times_s.tolist() == [0.1, 0.4]

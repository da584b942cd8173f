"""Named transforms and the way between frames; images of convex and phased probes, read as scan lines."""

import numpy as np
import pytest

from ultragray import ConvexProbe, PhasedProbe
from ultragray.datasets.fan import find_path, parse_matrix, read_device_set, transform_name
from ultragray.datasets.plus import read_plus_sweep
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument

ROWS, COLUMNS = 240, 300
PIXEL_MM = (0.2, 0.1)  # lateral, axial: as the device set of the tests says
OPENING_DEG, NEAR_MM, FAR_MM = 60.0, 10.0, 26.0
APEX = (149.5, -40.0)  # column, row
FAN = "60,10,26,149.5,-40"


def screen(value, apex=APEX):  # [rows, columns]
    """An image whose pixels hold a value of the angle in degrees and the radius in mm; 7 beyond the fan."""
    row, column = np.indices((ROWS, COLUMNS))
    x, z = (column - apex[0]) * PIXEL_MM[0], (row - apex[1]) * PIXEL_MM[1]
    angle, radius = np.degrees(np.arctan2(x, z)), np.hypot(x, z)
    within = (np.abs(angle) <= OPENING_DEG / 2 + 1) & (radius >= NEAR_MM - 0.5) & (radius <= FAR_MM + 0.5)
    return np.where(within, np.rint(value(angle, radius)), 7).astype(np.uint8)


def of_both(angle, radius):
    return 70 + 2 * angle + 3 * (radius - NEAR_MM)


def test_a_fan_becomes_scan_lines(tmp_path, plus_files, device_set):
    path = plus_files.write_mha(tmp_path / "s.mha", np.stack([screen(of_both)] * 2), plus_files.tracked_fields(2))
    sweep, _ = read_plus_sweep(path, device_set=device_set, fan=FAN)
    assert sweep.probe == ConvexProbe(OPENING_DEG, NEAR_MM, FAR_MM)
    _, rows, lines = sweep.images.shape
    assert (rows, lines) == (160, 94)  # 16 mm of .1 mm; 60° of the radius 18 mm are 18.8 mm of .2 mm
    radius = NEAR_MM + (np.arange(rows) + 0.5) / rows * (FAR_MM - NEAR_MM)
    angle = -OPENING_DEG / 2 + (np.arange(lines) + 0.5) / lines * OPENING_DEG
    expected = of_both(angle[None, :], radius[:, None])
    np.testing.assert_allclose(sweep.images[1], expected, atol=1.1)  # one grey value of rounding, twice


def test_its_pose_is_that_of_the_apex(tmp_path, plus_files, device_set):
    """A point of the image is where the probe's own geometry has it, also in a fan that leans."""
    stored, fields = np.stack([screen(of_both)] * 2), plus_files.tracked_fields(2)
    path = plus_files.write_mha(tmp_path / "s.mha", stored, fields)
    leaning = tmp_path / "leaning.xml"
    scan_conversion = (
        '<ScanConversion TransducerGeometry="CURVILINEAR" RadiusStartMm="10" RadiusStopMm="26" ThetaStartDeg="-20" '
        'ThetaStopDeg="40" TransducerCenterPixel="149.5 60"/>'
    )
    leaning.write_text(device_set.read_text().replace("</PlusConfiguration>", f"{scan_conversion}</PlusConfiguration>"))
    sweep, _ = read_plus_sweep(path, device_set=leaning)
    assert sweep.probe == ConvexProbe(60.0, 10.0, 26.0)
    assert any("fan of the device set was taken: -20 to 40°" in note for note in sweep.notes)
    plain, _ = read_plus_sweep(path, device_set=device_set)
    for row, line in ((0, 0), (80, 50), (159, 93)):
        radius = 10.0 + (row + 0.5) / 160 * 16.0
        along = np.radians(-20 + (line + 0.5) / 94 * 60)
        column, image_row = APEX[0] + radius * np.sin(along) / 0.2, APEX[1] + radius * np.cos(along) / 0.1
        top_centre = ((column - (COLUMNS - 1) / 2) * 0.2, 0.0, (image_row + 0.5) * 0.1, 1.0)
        on_scan_line = np.radians(-30 + (line + 0.5) / 94 * 60)
        in_probe = (radius * np.sin(on_scan_line), 0.0, radius * np.cos(on_scan_line), 1.0)
        np.testing.assert_allclose(sweep.poses[0] @ in_probe, plain.poses[0] @ top_centre, atol=1e-9)


def test_images_that_look_like_a_fan_are_told(tmp_path, plus_files, device_set):
    """With text beside it; not an image with dark margins, nor one whose fan is named."""
    fan = screen(of_both, (149.5, -100.0))
    fan[:4, 100:140] = fan[10:20, 5:60] = 90
    rectangle = np.full_like(fan, 7)
    rectangle[:-20, 50:-50] = 80
    for stored, options, expected in ((fan, {}, 1), (rectangle, {}, 0), (fan, {"fan": "60,10,26,149.5,-100"}, 0)):
        path = plus_files.write_mha(tmp_path / "s.mha", np.stack([stored] * 2), plus_files.tracked_fields(2))
        sweep, _ = read_plus_sweep(path, device_set=device_set, **options)
        assert sum("corners of the images are black" in note for note in sweep.notes) == expected


def test_a_fan_from_a_point_is_a_phased_probe(tmp_path, plus_files, device_set):
    path = plus_files.write_mha(tmp_path / "s.mha", np.stack([screen(of_both)] * 2), plus_files.tracked_fields(2))
    dataset = load_dataset(path, SourceOptions(device_set=device_set, fan="60,0,20,149.5,0"))
    assert dataset.probe == PhasedProbe(60.0, 20.0)


def test_the_fan_that_plus_clips_to(tmp_path, plus_files, device_set):
    path = plus_files.write_mha(tmp_path / "s.mha", np.stack([screen(of_both)] * 2), plus_files.tracked_fields(2))
    clip = (
        '<VolumeReconstruction FanAnglesDeg="-30 30" FanOriginPixel="149.5 -40" FanRadiusStartPixel="100" '
        'FanRadiusStopPixel="260"/></PlusConfiguration>'
    )
    clipping = tmp_path / "clipping.xml"
    clipping.write_text(device_set.read_text().replace("</PlusConfiguration>", clip))
    with pytest.raises(DatasetInvalid, match=r"clipping\.xml: .* pixels, which must be square: they are 0\.2 x 0\.1"):
        read_plus_sweep(path, device_set=clipping)
    cropped, _ = read_plus_sweep(path, device_set=clipping, crop="0:300,0:240")  # who crops wants no fan
    assert cropped.images.shape[1:] == (ROWS, COLUMNS)
    matrix = plus_files.image_to_probe @ np.diag([0.5, 1.0, 1.0, 1.0])  # 0.1 x 0.1 mm
    clipping.write_text(
        clipping.read_text().replace(plus_files.numbers(plus_files.image_to_probe), plus_files.numbers(matrix))
    )
    clipped, _ = read_plus_sweep(path, device_set=clipping)
    assert clipped.probe == ConvexProbe(60.0, 10.0, 26.0)
    old = clipping.read_text().replace("FanAnglesDeg", "FanAngles").replace("FanOriginPixel", "FanOrigin")
    clipping.write_text(old.replace("FanRadiusStopPixel", "FanDepth").replace('FanRadiusStartPixel="100"', ""))
    assert read_plus_sweep(path, device_set=clipping)[0].probe == PhasedProbe(60.0, 26.0)


@pytest.mark.parametrize(
    ("fan", "message"),
    [
        ("60,10,26,149.5", "fan must be opening angle .* such as 60,40,90"),
        ("60,10,26,149.5,nan", "must be finite"),
        ("200,10,26,149.5,-40", "at most 175°, got 200"),
        ("60,30,26,149.5,-40", "the end beyond the face, got 30 and 26 mm"),
        ("60,10,26,1490,-40", r"image of 300 x 240 pixels, of 0\.2 x 0\.1 mm each, at least by half: 0%"),
    ],
)
def test_fans_that_cannot_be_are_refused(tmp_path, plus_files, device_set, fan, message):
    path = plus_files.write_mha(tmp_path / "s.mha", np.stack([screen(of_both)] * 2), plus_files.tracked_fields(2))
    with pytest.raises(InvalidArgument, match=message):
        read_plus_sweep(path, device_set=device_set, fan=fan)


def test_a_tracker_is_chosen_among_several(tmp_path, plus_files, device_set):
    stored, fields = plus_files.speckle(3, 30, 20), plus_files.tracked_fields(3)
    other = np.eye(4)
    for frame in range(3):
        other[:3, 3] = (0, 10 * frame, 0)
        fields[f"Seq_Frame{frame:04d}_ProbeToCameraTransform"] = plus_files.numbers(other)
        fields[f"Seq_Frame{frame:04d}_ProbeToCameraTransformStatus"] = "OK"
    path = plus_files.write_mha(tmp_path / "s.mha", stored, fields)
    usual, _ = read_plus_sweep(path, device_set=device_set)
    camera, _ = read_plus_sweep(path, device_set=device_set, transform="ProbeToCamera")
    assert np.ptp(usual.poses[:, 1, 3]) < np.ptp(camera.poses[:, 1, 3]) == pytest.approx(20.0)
    with pytest.raises(InvalidArgument, match="there are ImageToProbe, ProbeToCamera, ProbeToTracker, got 'ProbeToNo'"):
        read_plus_sweep(path, device_set=device_set, transform="ProbeToNo")


@pytest.mark.parametrize("most_first", [False, True])
def test_sixteen_bits_become_eight(tmp_path, plus_files, device_set, most_first):
    stored = np.arange(2 * 30 * 20).reshape(2, 30, 20)  # up to 1199: 11 bits
    order = ">" if most_first else "<"
    wide = np.frombuffer(stored.astype(f"{order}u2").tobytes(), np.uint8).reshape(2, 30, 40)
    fields = plus_files.tracked_fields(2) | {"ElementType": "MET_USHORT", "DimSize": "20 30 2"}
    path = plus_files.write_mha(tmp_path / "s.mha", wide, fields | {"BinaryDataByteOrderMSB": str(most_first)})
    sweep, _ = read_plus_sweep(path, device_set=device_set)
    np.testing.assert_array_equal(sweep.images, stored >> 3)
    assert "pixels of 16 bits were made 8: 2047 became 255" in sweep.notes
    changes = {"type": "uint16", "sizes": "20 30 2", "endian": "big" if most_first else "little"}
    nrrd = plus_files.write_nrrd(tmp_path / "s.nrrd", wide, plus_files.tracked_fields(2), **changes)
    np.testing.assert_array_equal(read_plus_sweep(nrrd, device_set=device_set)[0].images, stored >> 3)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("ProbeToTracker", ("Probe", "Tracker")),
        ("ToolToTracker", ("Tool", "Tracker")),
        ("PhantomToTorso", ("Phantom", "Torso")),
        ("TransducerOriginPixelToTransducerOrigin", ("TransducerOriginPixel", "TransducerOrigin")),
        ("Probe", None),
        ("Total", None),
        ("probetotracker", None),
    ],
)
def test_names_of_transforms(text, name):
    assert transform_name(text) == name


def test_matrices():
    matrix = parse_matrix("1 0 0 5\n 0 1 0 -8.23381e-005\n 0 0\t1 7  0 0 0 1", "here")
    assert matrix[:3, 3].tolist() == [5, -8.23381e-5, 7]


@pytest.mark.parametrize(
    "text",
    ["", "1 2 3", "a b c d e f g h i j k l m n o p", "nan " * 16, "0 " * 15 + "1", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2"],
)
def test_matrices_that_cannot_be_are_refused(text):
    with pytest.raises(DatasetInvalid, match=r"^here must be"):
        parse_matrix(text, "here")


def test_the_shortest_way():
    names = [("Image", "Probe"), ("Probe", "Tracker"), ("Reference", "Tracker"), ("Stylus", "Tracker")]
    assert find_path(names, "Image", "Reference") == [
        (("Image", "Probe"), False),
        (("Probe", "Tracker"), False),
        (("Reference", "Tracker"), True),
    ]
    assert find_path([*names, ("Image", "Reference")], "Image", "Reference") == [(("Image", "Reference"), False)]
    assert find_path(names, "Image", "World") is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not XML"),
        ("<a>", "not XML"),
        ("<a/>", "no Transform"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "no DOCTYPE"),
        (
            '<a><CoordinateDefinitions><Transform From="Image" To="Probe" Matrix="1 2"/></CoordinateDefinitions></a>',
            "ImageToProbe must be sixteen finite numbers",
        ),
    ],
)
def test_device_sets_that_cannot_be_read_are_named(tmp_path, content, message):
    path = tmp_path / "set.xml"
    path.write_text(content)
    with pytest.raises(DatasetInvalid, match=rf"set\.xml: .*{message}"):
        read_device_set(path)


def test_a_missing_device_set_is_named(tmp_path):
    with pytest.raises(DatasetInvalid, match=r"set\.xml: no such file"):
        read_device_set(tmp_path / "set.xml")


def test_a_device_set(device_set):
    transforms = read_device_set(device_set).transforms
    assert list(transforms) == [("Image", "Probe")]
    np.testing.assert_allclose(np.linalg.norm(transforms["Image", "Probe"][:3, :2], axis=0), [0.2, 0.1])

"""What the words of a DICOM header say of its pixels, against what the stream holds."""

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate
from pydicom.pixels import convert_color_space, pixel_array
from pydicom.pixels.encoders import RLELosslessEncoder
from pydicom.uid import JPEG2000, ExplicitVRLittleEndian, ImplicitVRLittleEndian, JPEGBaseline8Bit, RLELossless

from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid

from ...dicom_files import FRAMES, POSES, region, write_cine

Write = Callable[..., Path]
SIZE = (96, 128)


@pytest.fixture
def write(tmp_path):
    return partial(
        write_cine,
        tmp_path,
        Rows=SIZE[0],
        Columns=SIZE[1],
        SequenceOfUltrasoundRegions=None,
        PixelSpacing=[0.3, 0.3],
    )


def echoes(seed=0):  # [10, 96, 128] smooth, black beside a sector
    random = np.random.default_rng(seed)
    frames = random.integers(20, 235, (10, 12, 16)).astype(np.uint8)
    grown = np.stack([cv2.resize(frame, SIZE[::-1], interpolation=cv2.INTER_CUBIC) for frame in frames])
    grown[:, :, :20] = 0
    return grown


def with_flow(grey):  # [10, 96, 128, 3]
    """The same in colour: a large box of red and blue, as flow is shown, and grey elsewhere."""
    colour = np.repeat(grey[..., None], 3, axis=-1)
    colour[:, 20:50, 40:110] = (200, 30, 20)
    colour[:, 50:80, 40:110] = (20, 40, 190)
    return colour


def luma(colour):
    return colour @ [0.299, 0.587, 0.114]


def without_markers(stream):
    """A JPEG stream without JFIF's marker, as many scanners write it."""
    length = int.from_bytes(stream[4:6], "big")
    assert stream[2:4] == b"\xff\xe0"
    return stream[:2] + stream[4 + length :]


def ycbcr_jpeg(colour, *, subsampled=True):
    out = io.BytesIO()
    Image.fromarray(colour).save(out, "JPEG", quality=98, subsampling=2 if subsampled else 0)
    return out.getvalue()


def rgb_jpeg(colour):
    """RGB as it is, named so by Adobe's marker."""
    out = io.BytesIO()
    Image.fromarray(colour).save(out, "JPEG", quality=98, keep_rgb=True, subsampling=0)
    return out.getvalue()


def without_adobe(stream):
    """RGB that nothing names: neither a marker nor the components, which are 1, 2 and 3."""
    place = stream.find(b"\xff\xee")
    if place >= 0:
        length = int.from_bytes(stream[place + 2 : place + 4], "big")
        stream = stream[:place] + stream[place + 2 + length :]
    for marker, offset, step in ((b"\xff\xc0", 10, 3), (b"\xff\xda", 5, 2)):
        at = stream.find(marker)
        changed = bytearray(stream)
        for channel in range(3):
            changed[at + offset + channel * step] = channel + 1
        stream = bytes(changed)
    return stream


STREAMS = {
    "YCbCr with JFIF": ycbcr_jpeg,
    "YCbCr bare": lambda frame: without_markers(ycbcr_jpeg(frame)),
    "YCbCr bare, not subsampled": lambda frame: without_markers(ycbcr_jpeg(frame, subsampled=False)),
    "RGB with Adobe's marker": rgb_jpeg,
    "RGB bare": lambda frame: without_adobe(rgb_jpeg(frame)),
}


@pytest.mark.parametrize("word", ["RGB", "YBR_FULL", "YBR_FULL_422"])
@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("colours", [lambda grey: np.repeat(grey[..., None], 3, axis=-1), with_flow])
def test_a_jpeg_stream_is_read_as_it_is_whatever_the_header_calls_it(write, word, stream, colours):
    is_bare, is_rgb = "bare" in stream, stream.startswith("RGB")
    described = {"syntax": JPEGBaseline8Bit, "SamplesPerPixel": 3, "PlanarConfiguration": 0}
    described["data"] = encapsulate([STREAMS[stream](frame) for frame in colours(echoes())])
    right = pixel_array(write(PhotometricInterpretation="RGB" if is_rgb else "YBR_FULL_422", **described))
    sweep = load_dataset(write(PhotometricInterpretation=word, **described)).val
    assert np.abs(sweep.images - luma(right)[[2, 7]]).max() <= 1
    told = [note for note in sweep.notes if note.startswith("the header says")]
    assert bool(told) == (is_bare and is_rgb != (word == "RGB"))


def compressed(path, syntax):
    """The file in another transfer syntax, written by GDCM."""
    gdcm = pytest.importorskip("gdcm")
    reader, change, writer = gdcm.ImageReader(), gdcm.ImageChangeTransferSyntax(), gdcm.ImageWriter()
    reader.SetFileName(str(path))
    assert reader.Read()
    change.SetTransferSyntax(gdcm.TransferSyntax(getattr(gdcm.TransferSyntax, syntax)))
    change.SetInput(reader.GetImage())
    assert change.Change()
    writer.SetFileName(str(path))
    writer.SetFile(reader.GetFile())
    writer.SetImage(change.GetOutput())
    assert writer.Write()
    return path


COLOUR = {"SamplesPerPixel": 3, "PhotometricInterpretation": "RGB", "PlanarConfiguration": 0}


@pytest.mark.parametrize("syntax", ["JPEGLosslessProcess14_1", "JPEGLSLossless"])
@pytest.mark.parametrize("bits", [8, 12, 24])
def test_compressions_without_loss(write, syntax, bits):
    if bits == 24:
        described = {**COLOUR, "data": with_flow(echoes()).tobytes()}
    else:
        stored = echoes().astype(np.uint8 if bits == 8 else np.uint16) << bits - 8
        described = {"BitsAllocated": 8 * stored.itemsize, "BitsStored": bits, "HighBit": bits - 1}
        described["data"] = stored.tobytes()
    expected = load_dataset(write(**described)).val
    found = load_dataset(compressed(write(**described), syntax)).val
    np.testing.assert_array_equal(found.images, expected.images)
    assert found.notes == expected.notes


def test_lossy_jpeg_of_12_bits_is_refused_in_words(write):
    stored = echoes().astype(np.uint16) * 16
    path = write(BitsAllocated=16, BitsStored=12, HighBit=11, data=stored.tobytes())
    with pytest.raises(DatasetInvalid, match=r"12 bits compressed as JPEG Extended .*: install pylibjpeg-libjpeg"):
        load_dataset(compressed(path, "JPEGExtendedProcess2_4"))


@pytest.mark.parametrize("word", ["MONOCHROME1", "MONOCHROME2"])
def test_grey_jpeg(write, word):
    grey = echoes()
    shown = 255 - grey if word == "MONOCHROME1" else grey
    data = encapsulate([cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes() for frame in grey])
    found = load_dataset(write(syntax=JPEGBaseline8Bit, PhotometricInterpretation=word, data=data)).val.images
    assert np.abs(found.astype(int) - shown[[2, 7]]).max() <= 8
    assert np.abs(found.astype(int) - shown[[2, 7]]).mean() <= 1


def test_a_stream_of_another_size_is_not_decoded(write, monkeypatch):
    large = cv2.imencode(".jpg", np.full((2000, 2000), 90, np.uint8))[1].tobytes()
    path = write(syntax=JPEGBaseline8Bit, data=encapsulate([large] * 10))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(DatasetInvalid, match="frame 0: it cannot be read as JPEG of 128 x 96 pixels"):
        load_dataset(path)


@pytest.mark.parametrize("word", ["RGB", "YBR_FULL"])
@pytest.mark.parametrize("stored", ["RGB", "YBR_FULL"])
def test_raw_colours_are_read_as_they_are(write, word, stored):
    colour = with_flow(echoes())
    data = colour if stored == "RGB" else convert_color_space(colour, "RGB", "YBR_FULL")
    path = write(SamplesPerPixel=3, PhotometricInterpretation=word, PlanarConfiguration=0, data=data.tobytes())
    sweep = load_dataset(path).val
    assert any("the header says" in note for note in sweep.notes) == (word != stored)
    right = colour if stored == "RGB" else convert_color_space(data, "YBR_FULL", "RGB")
    assert np.abs(sweep.images - luma(right)[[2, 7]]).max() <= 1


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian])
def test_pixels_that_share_their_colours(write, syntax):
    """As PS3.3 C.7.6.3.1.2 stores YBR_FULL_422, of which pydicom takes the bytes of one frame for those of another."""
    ybr = convert_color_space(with_flow(echoes()), "RGB", "YBR_FULL")
    lumas, blue, red = np.moveaxis(ybr, -1, 0)
    data = np.stack([lumas[..., ::2], lumas[..., 1::2], blue[..., ::2], red[..., ::2]], axis=-1)
    described = {"SamplesPerPixel": 3, "PhotometricInterpretation": "YBR_FULL_422", "PlanarConfiguration": 0}
    ybr[:, :, 1::2, 1:] = ybr[:, :, ::2, 1:]
    expected = luma(convert_color_space(ybr, "YBR_FULL", "RGB"))
    path = write(**described, data=data.tobytes(), syntax=syntax)
    for part in (load_dataset(path).val, load_dataset(path, SourceOptions(frames="2:9:3")).train):
        assert np.abs(part.images - expected[part.frame_numbers]).max() <= 1
    with pytest.raises(DatasetInvalid, match="frame 9: truncated"):
        load_dataset(write(**described, data=data.tobytes()[:-100], syntax=syntax))


@pytest.mark.parametrize("planar", [0, 1])
def test_planes_of_colour(write, planar):
    colour = with_flow(echoes())
    data = colour if planar == 0 else colour.transpose(0, 3, 1, 2)
    path = write(
        SamplesPerPixel=3,
        PhotometricInterpretation="RGB",
        PlanarConfiguration=planar,
        data=np.ascontiguousarray(data).tobytes(),
    )
    assert np.abs(load_dataset(path).val.images - luma(colour)[[2, 7]]).max() <= 1


@pytest.mark.parametrize("word", ["RGB", "YBR_RCT", "YBR_ICT"])
def test_colour_jpeg_2000(write, word):
    colour = with_flow(echoes())
    streams = []
    for frame in colour:
        out = io.BytesIO()
        Image.fromarray(frame).save(out, "JPEG2000", irreversible=word == "YBR_ICT", mct=1, no_jp2=True)
        streams.append(out.getvalue())
    path = write(
        syntax=JPEG2000,
        SamplesPerPixel=3,
        PhotometricInterpretation=word,
        PlanarConfiguration=0,
        data=encapsulate(streams),
    )
    assert np.abs(load_dataset(path).val.images - luma(pixel_array(path))[[2, 7]]).max() <= 1


def test_a_palette(write):
    indices = echoes()
    table = np.random.default_rng(1).integers(0, 256, (256, 3))
    luts = {}
    for channel, name in enumerate(("Red", "Green", "Blue")):
        luts[f"{name}PaletteColorLookupTableDescriptor"] = [256, 0, 16]
        luts[f"{name}PaletteColorLookupTableData"] = (table[:, channel].astype("<u2") * 257).tobytes()
    path = write(PhotometricInterpretation="PALETTE COLOR", data=indices.tobytes(), **luts)
    sweep = load_dataset(path).val
    assert np.abs(sweep.images - luma(table[indices])[[2, 7]]).max() <= 1
    assert sweep.notes[1:] == ("colours of 16 bits were made 8: 65535 became 255",)


def test_more_bits_are_made_eight(write):
    stored = echoes().astype(np.uint16) * 16 + 5
    path = write(BitsAllocated=16, BitsStored=12, HighBit=11, data=stored.astype("<u2").tobytes())
    sweep = load_dataset(path).val
    np.testing.assert_array_equal(sweep.images, echoes()[[2, 7]])
    assert "pixels of 12 bits were made 8: 4095 became 255" in sweep.notes


def rle(frames, bits, word):
    """Frames compressed by run lengths."""
    described = {"rows": SIZE[0], "columns": SIZE[1], "samples_per_pixel": 3 if frames.ndim == 4 else 1}
    described |= {"bits_allocated": bits, "bits_stored": bits, "pixel_representation": 0, "number_of_frames": 1}
    described |= {"photometric_interpretation": word, "planar_configuration": 0}
    return encapsulate([RLELosslessEncoder.encode(frame.tobytes(), **described) for frame in frames])


def sixteen(frames, shift=0, extra=0):
    return ((frames.astype("<u2") << shift) | extra).tobytes()


BITS = {bits: {"BitsAllocated": 16, "BitsStored": bits, "HighBit": bits - 1} for bits in (8, 10, 12, 16)}
SAMPLES = {"SamplesPerPixel": 3, "PlanarConfiguration": 0}
GREY_VENDORS = {
    "10 bits": {**BITS[10], "data": sixteen(echoes(), 2)},
    "16 bits": {**BITS[16], "data": sixteen(echoes(), 8)},
    "12 bits of the 16 that are said": {**BITS[16], "data": sixteen(echoes(), 4)},
    "8 bits of the 16 that are said": {**BITS[16], "data": sixteen(echoes())},
    "an overlay in the bits above": {**BITS[12], "data": sixteen(echoes(), 4, 0xA000)},
    "8 bits in 16 with an overlay": {**BITS[8], "data": sixteen(echoes(), 0, 0x100)},
    "white is 0": {"PhotometricInterpretation": "MONOCHROME1", "data": (255 - echoes()).tobytes()},
    "white is 0 in 12 bits": {
        **BITS[12],
        "PhotometricInterpretation": "MONOCHROME1",
        "data": (4095 - (echoes().astype("<u2") << 4)).tobytes(),
    },
    "implicit": {"syntax": ImplicitVRLittleEndian, "data": echoes().tobytes()},
    "run lengths": {"syntax": RLELossless, "data": partial(rle, echoes(), 8, "MONOCHROME2")},
    "run lengths of 16 bits": {
        **BITS[12],
        "syntax": RLELossless,
        "data": partial(rle, echoes().astype("<u2") << 4, 16, "MONOCHROME2"),
    },
    "run lengths of colour": {
        **SAMPLES,
        "syntax": RLELossless,
        "PhotometricInterpretation": "RGB",
        "data": partial(rle, np.repeat(echoes()[..., None], 3, axis=-1), 8, "RGB"),
    },
    "run lengths of YBR": {
        **SAMPLES,
        "syntax": RLELossless,
        "PhotometricInterpretation": "YBR_FULL",
        "data": partial(
            rle, convert_color_space(np.repeat(echoes()[..., None], 3, axis=-1), "RGB", "YBR_FULL"), 8, "YBR_FULL"
        ),
    },
}


@pytest.mark.parametrize("described", GREY_VENDORS.values(), ids=GREY_VENDORS)
def test_one_picture_as_vendors_store_it(write, described):
    data = described["data"]
    sweep = load_dataset(write(**described | {"data": data() if callable(data) else data})).val
    assert np.abs(sweep.images.astype(int) - echoes()[[2, 7]]).max() <= 1


def test_bits_in_another_place_are_refused(write):
    with pytest.raises(DatasetInvalid, match="HighBit must be BitsStored - 1, 11, got 15"):
        load_dataset(write(**{**BITS[12], "HighBit": 15}, data=sixteen(echoes(), 8)))


def measures(spacing):
    shared, one = Dataset(), Dataset()
    one.PixelSpacing = spacing
    shared.PixelMeasuresSequence = [one]
    return [shared]


def code(meaning):
    one = Dataset()
    one.CodeMeaning = meaning
    return [one]


BOX = {"RegionLocationMinX0": 10, "RegionLocationMinY0": 4, "RegionLocationMaxX1": 109, "RegionLocationMaxY1": 83}


@pytest.mark.parametrize(
    ("described", "size_mm", "told"),
    [
        ({"PixelSpacing": None, "SharedFunctionalGroupsSequence": measures([0.2, 0.3])}, (38.4, 19.2), ""),
        (
            {"TransducerType": None, "TransducerGeometryCodeSequence": code("Linear ultrasound transducer geometry")},
            (38.4, 28.8),
            "",
        ),
        (
            {"SequenceOfUltrasoundRegions": [region(**BOX, PhysicalDeltaX=0.03, PhysicalDeltaY=0.02)]},
            (30.0, 16.0),
            "PixelSpacing says pixels of 0.3 x 0.3 mm, its regions 0.3 x 0.2: these count",
        ),
        (
            {
                "PixelSpacing": None,
                "DepthOfScanField": 16,
                "SequenceOfUltrasoundRegions": [region(**BOX, PhysicalDeltaX=0.3, PhysicalDeltaY=0.2)],
            },
            (300.0, 160.0),
            r"it sees 16 mm deep \(DepthOfScanField\), its region is 160 mm high: a length in another unit",
        ),
        (
            {"SequenceOfUltrasoundRegions": [region(PhysicalUnitsXDirection=0, PhysicalUnitsYDirection=0)]},
            (38.4, 28.8),
            "no region in centimetres: the whole image of 128 x 96 pixels",
        ),
        ({"RescaleSlope": 2, "RescaleIntercept": -5}, (38.4, 28.8), "stored times 2 plus -5: taken as stored"),
    ],
)
def test_lengths_as_vendors_say_them(write, described, size_mm, told):
    train = load_dataset(write(data=echoes().tobytes(), **described)).train
    assert (train.probe.width_mm, train.probe.far_mm) == pytest.approx(size_mm, abs=1e-6)
    assert re.search(told, "; ".join(train.notes))
    assert not any("does not name its transducer" in note for note in train.notes)


def test_a_curved_transducer_of_an_enhanced_file_is_not_taken_for_a_linear_one(write):
    described = {"TransducerType": None, "TransducerGeometryCodeSequence": code("Curved linear transducer")}
    with pytest.raises(DatasetInvalid, match="the probe is not linear, TransducerType is CURVED LINEAR"):
        load_dataset(write(data=echoes().tobytes(), **described))


SMALL = {"Rows": FRAMES.shape[1], "Columns": FRAMES.shape[2], "PixelSpacing": None}


@pytest.mark.parametrize("end", [{"RegionLocationMaxX1": 32}, {"RegionLocationMaxY1": 24}])
def test_a_region_that_ends_one_pixel_beyond_is_clipped_by_it(write, end):
    whole = {"RegionLocationMaxX1": 31, "RegionLocationMaxY1": 23}
    expected = load_dataset(write(**SMALL, SequenceOfUltrasoundRegions=[region(**whole)]))
    found = load_dataset(write(**SMALL, SequenceOfUltrasoundRegions=[region(**{**whole, **end})]))
    np.testing.assert_array_equal(found.val.images, expected.val.images)
    np.testing.assert_allclose(found.val.poses, expected.val.poses)
    assert "ends one pixel beyond the image: clipped by that pixel" in "".join(found.val.notes)
    assert not expected.val.notes


def test_several_regions_are_listed_and_one_is_chosen_by_a_crop(write):
    left, right = region(RegionLocationMaxX1=13), region(RegionLocationMinX0=16, PhysicalDeltaX=0.1)
    path = write(**SMALL, SequenceOfUltrasoundRegions=[left, right])
    with pytest.raises(DatasetInvalid, match=r"one with crop: 4:14,2:22 \(pixels .*; 16:24,2:22 \(pixels of 1 x"):
        load_dataset(path)
    alone = write(**SMALL, SequenceOfUltrasoundRegions=[right])
    expected = load_dataset(alone, SourceOptions(crop="16:24,3:20"))
    path = write(**SMALL, SequenceOfUltrasoundRegions=[left, right])
    found = load_dataset(path, SourceOptions(crop="16:24,3:20"))
    np.testing.assert_array_equal(found.train.images, expected.train.images)
    np.testing.assert_allclose(found.train.poses, expected.train.poses)
    assert found.probe == expected.probe
    flow = region(RegionDataType=2, RegionLocationMinX0=8)
    both = load_dataset(write(**SMALL, SequenceOfUltrasoundRegions=[region(), flow, region()]))
    assert both.train.images.shape[1:] == (20, 20)


@pytest.mark.parametrize("kind", ["null", "NaN"])
def test_a_frame_without_a_pose_is_left_out_and_named(write, tmp_path, kind):
    path = write(
        data=echoes().tobytes(),
        poses=None if kind == "null" else np.where(np.isin(np.arange(10), [3, 7])[:, None, None], np.nan, POSES),
    )
    if kind == "null":
        rows = [None if number in (3, 7) else pose[:3].tolist() for number, pose in enumerate(POSES)]
        (tmp_path / "sweep.poses.json").write_text(str(rows).replace("None", "null"))
    sweep = load_dataset(path)
    numbers = sorted([*sweep.train.frame_numbers, *sweep.val.frame_numbers])
    assert numbers == [0, 1, 2, 4, 5, 6, 8, 9]
    assert any(note.endswith("were left out: 3, 7 (2 in all)") for note in sweep.train.notes)
    np.testing.assert_array_equal(sweep.val.images, echoes()[sweep.val.frame_numbers])


def test_names_and_burnt_in_text_are_told(write):
    notes = load_dataset(write(data=echoes().tobytes(), PatientName="Doe^Jane", BurnedInAnnotation="YES")).train.notes
    assert "its header names a person (PatientName): convert --anonymize leaves it out" in notes
    assert any("BurnedInAnnotation YES" in note for note in notes)
    notes = load_dataset(write(data=echoes().tobytes(), PatientName="Anonymous", PatientID="")).train.notes
    assert not any("person" in note for note in notes)


TOP_CENTRE = np.array([0.0, 0.0, 0.0, 1.0])


def test_a_delay_of_the_images_by_the_times_of_the_frames(write):
    path = write(data=echoes().tobytes(), FrameTime=40.0)
    found = load_dataset(path, SourceOptions(image_delay_ms="20"))
    numbers = [*found.train.frame_numbers, *found.val.frame_numbers]
    assert sorted(numbers) == list(range(1, 10))
    at = dict(enumerate(POSES))
    for number, pose in zip(found.train.frame_numbers, found.train.poses, strict=True):
        middle = (at[number] + at[number - 1]) / 2 @ TOP_CENTRE
        assert np.abs(pose[:3, 3] - middle[:3]).max() < 0.02

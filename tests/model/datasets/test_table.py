"""Pictures in a folder with a table of poses."""

import io
import json

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.datasets.table import rotation_of_angles
from ultragray.errors import DatasetInvalid, InvalidArgument

COUNT, ROWS, COLUMNS = 12, 40, 60
FRAMES = np.random.default_rng(2).integers(0, 250, (COUNT, ROWS, COLUMNS), dtype=np.uint8)
TIMES = 3.0 + 0.05 * np.arange(COUNT)
TURNS = Rotation.from_rotvec(np.linspace(0, 0.5, COUNT)[:, None] * [0.3, 1.0, -0.4])
PLACES = np.linspace(0, 1, COUNT)[:, None] * [4.0, 20.0, -3.0] + [100.0, -50.0, 30.0]
CALIBRATION = np.array([[0.2, 0.0, 0.0, -6.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.25, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture
def write(tmp_path):
    def write(header, rows, *, pictures=".", names="frame_{}.png", **calibration):
        folder = tmp_path / "sweep"
        (folder / pictures).mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(FRAMES):
            cv2.imwrite(str(folder / pictures / names.format(number)), frame)
        lines = [header, *(",".join("" if value is None else str(value) for value in row) for row in rows)]
        (folder / "poses.csv").write_text("\n".join(lines))
        document = {"image_to_sensor": CALIBRATION.tolist(), **calibration}
        (folder / "calibration.json").write_text(json.dumps(document))
        return folder

    return write


def quaternions():  # [N, 4] w, x, y, z
    return np.roll(TURNS.as_quat(), 1, axis=1)


def table(*columns):
    return [list(row) for row in np.concatenate([np.atleast_2d(one.T).T for one in columns], axis=1).tolist()]


def check(folder, options=None, shift_s=0.0):
    dataset = load_dataset(folder, options)
    for part in (dataset.train, dataset.val):
        np.testing.assert_array_equal(part.images, FRAMES[part.frame_numbers])
        for number, pose in zip(part.frame_numbers, part.poses, strict=True):
            share = (TIMES[number] - shift_s - TIMES[0]) / (TIMES[-1] - TIMES[0])
            true = np.eye(4)
            true[:3, :3] = Rotation.from_rotvec(0.5 * share * np.array([0.3, 1.0, -0.4])).as_matrix()
            true[:3, 3] = share * np.array([4.0, 20.0, -3.0]) + [100.0, -50.0, 30.0]
            true = true @ CALIBRATION
            top_centre = (true @ ((COLUMNS - 1) / 2, -0.5, 0, 1))[:3]
            assert np.abs(pose[:3, 3] - top_centre).max() < 0.02
            assert np.abs(pose[:3, 0] - true[:3, 0] / 0.2).max() < 1e-5
            assert np.abs(pose[:3, 2] - true[:3, 1] / 0.25).max() < 1e-5


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1.0), ("cm", 0.1), ("m", 0.001)])
@pytest.mark.parametrize("is_in_name", [True, False])
def test_positions_in_their_unit_and_quaternions(write, unit, scale, is_in_name):
    suffix = f"_{unit}" if is_in_name else ""
    header = f"time,x{suffix},y{suffix},z{suffix},qw,qx,qy,qz"
    folder = write(
        header, table(TIMES, PLACES * scale, quaternions()), **({} if is_in_name else {"position_unit": unit})
    )
    check(folder)
    check(folder / "poses.csv")
    assert load_dataset(folder / "poses.csv").name == "sweep"
    assert f"pose (x, y, z in {unit}, quaternion)" in str(load_dataset(folder).train.chain.links[1])


@pytest.mark.parametrize("order", ["ZYX", "XYZ", "xyz", "zyx", "YXZ", "ZXZ"[:2] + "Y"])
@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_angles_in_their_order_and_unit(write, order, unit):
    angles = TURNS.as_euler(order, degrees=unit == "deg")
    by_axis = np.empty_like(angles)
    for place, axis in enumerate(order.upper()):
        by_axis[:, "XYZ".index(axis)] = angles[:, place]
    header = f"t,tx_mm,ty_mm,tz_mm,rx_{unit},ry_{unit},rz_{unit}"
    check(write(header, table(TIMES, PLACES, by_axis), euler_order=order))


def test_turns_agree_with_another_library():
    angles = np.array([0.3, -0.8, 1.2])
    for order in ("XYZ", "ZYX", "YZX", "xyz", "zxy"):
        theirs = Rotation.from_euler(order, [angles["XYZ".index(axis)] for axis in order.upper()]).as_matrix()
        np.testing.assert_allclose(rotation_of_angles(angles, order), theirs, atol=1e-12)


def test_rows_name_their_pictures(write, tmp_path):
    rows = table(TIMES, PLACES, quaternions())
    named = [[*row, f"images/us{number}.jpg.png"] for number, row in enumerate(rows)]
    folder = write("time,x_mm,y_mm,z_mm,qw,qx,qy,qz,file", named, pictures="images", names="us{}.jpg.png")
    check(folder)
    (folder / "images" / "us3.jpg.png").unlink()
    with pytest.raises(DatasetInvalid, match=r"the picture 'images/us3\.jpg\.png' was not found"):
        load_dataset(folder)


def test_poses_between_rows_at_the_times_of_pictures(write):
    dense = np.linspace(TIMES[0] - 0.2, TIMES[-1] + 0.2, 60)
    share = (dense - TIMES[0]) / (TIMES[-1] - TIMES[0])
    places = share[:, None] * [4.0, 20.0, -3.0] + [100.0, -50.0, 30.0]
    turns = Rotation.from_rotvec(0.5 * share[:, None] * [0.3, 1.0, -0.4])
    rows = table(1000 * dense, places, np.roll(turns.as_quat(), 1, axis=1))
    folder = write("time_ms,x_mm,y_mm,z_mm,qw,qx,qy,qz", rows)
    with pytest.raises(DatasetInvalid, match=r"it has 60 poses for 12 pictures: name them in a column file, or their"):
        load_dataset(folder)
    stamped = "\n".join(["file,time", *(f"frame_{number}.png,{time}" for number, time in enumerate(TIMES))])
    (folder / "images.csv").write_text(stamped)
    check(folder)
    check(folder, SourceOptions(image_delay_ms="60"), shift_s=0.06)
    check(folder, SourceOptions(image_delay_ms="-35"), shift_s=-0.035)


@pytest.mark.parametrize("word", ["nan", "NULL", "NA", "N/A", "None", " - ", "MISSING"])
def test_rows_without_a_pose_are_left_out(write, word):
    rows = table(TIMES, PLACES, quaternions())
    rows[4][1:4] = [None, None, None]
    rows[8][4] = word
    dataset = load_dataset(write("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", rows))
    assert "pictures without a pose were left out: 4, 8 (2 in all)" in dataset.train.notes
    assert sorted([*dataset.train.frame_numbers, *dataset.val.frame_numbers]) == [0, 1, 2, 3, 5, 6, 7, 9, 10, 11]


@pytest.mark.parametrize(
    ("header", "calibration", "message"),
    [
        ("time,x,y,z,qw,qx,qy,qz", {}, "does not say in which unit its positions are: name columns such as x_mm"),
        ("time,x_mm,y_mm,z_mm,rx,ry,rz,other", {}, "angles need their unit and order"),
        ("time,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg,other", {}, "angles need their unit and order"),
        ("time,x_mm,y_mm,q,qw,qx,qy,qz", {}, r"it lacks columns of a position \(x, y, z\), it has time, x_mm"),
        ("time,x_mm,y_mm,z_mm,qw,qx,qy,other", {}, "it lacks columns of a quaternion"),
        ("time,x_mm,y_mm,z_mm,qx,qy,qz,qw", {}, None),
        ("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", {"euler_order": "XX"}, "euler_order must be the three letters XYZ"),
        ("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", {"euler_order": "ZYZ"}, "euler_order must be the three letters XYZ"),
        ("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", {"image_to_sensor": [1, 2]}, "image_to_sensor must be 16 finite numbers"),
        (
            "time,x_mm,y_mm,z_mm,qw,qx,qy,qz",
            {"image_to_sensor": [10**400] * 16},
            "the calibration cannot be read: int too large",
        ),
        ("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", {"position_unit": "inch"}, "the calibration cannot be read: position_unit"),
        (
            "time,x_mm,y_mm,z_mm,qw,qx,qy,qz",
            {"image_to_sensor": (np.diag([1e-3, 1e-3, 1e-3, 1]) @ CALIBRATION).tolist()},
            r"calibration\.json: image_to_sensor makes a pixel 0\.0002 x 0\.00025 mm .* metres\?",
        ),
    ],
)
def test_what_cannot_be_used_is_one_clear_error(write, header, calibration, message):
    folder = write(header, table(TIMES, PLACES, quaternions()), **calibration)
    if message is None:  # any order of columns
        assert len(load_dataset(folder).train) > 0
        return
    with pytest.raises(DatasetInvalid, match=message):
        load_dataset(folder)


def test_pictures_that_do_not_go_with_it(write):
    rows = table(TIMES, PLACES, quaternions())
    folder = write("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", rows)
    with pytest.raises(InvalidArgument, match="fan must be given without crop"):
        load_dataset(folder, SourceOptions(crop="0:9,0:9", fan="60,40,90,1,1"))
    cv2.imwrite(str(folder / "frame_5.png"), FRAMES[5][:20])
    with pytest.raises(DatasetInvalid, match=r"frame_5\.png: it has 60 x 20 pixels of uint8, frame_0\.png 60 x 40"):
        load_dataset(folder)
    (folder / "frame_5.png").write_bytes(b"no picture")
    with pytest.raises(DatasetInvalid, match=r"frame_5\.png: it cannot be read as a picture"):
        load_dataset(folder)


def test_pictures_without_a_row_are_told_and_names_may_begin_with_the_folder(write):
    rows = [[*row, f"{'./' if number % 2 else ''}frame_{number}.png"] for number, row in enumerate(WHOLE)][:-2]
    dataset = load_dataset(write(f"{NAMES},file", rows))
    assert len(dataset.train) + len(dataset.val) == 10
    assert (
        "pictures without a row in poses.csv were left out: frame_10.png, frame_11.png (2 in all)"
        in dataset.train.notes
    )


def test_angles_in_radians_beyond_a_whole_turn_are_told(write):
    header = "time,x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad,other"
    for scale, count in ((1.0, 0), (180 / np.pi, 1)):
        angles = scale * turned_by("ZYX", "rad")
        notes = load_dataset(write(header, table(TIMES, PLACES, angles, TIMES), euler_order="ZYX")).train.notes
        assert sum("beyond a whole turn: are they degrees?" in note for note in notes) == count


def test_a_quaternion_of_zeros_is_no_pose(write):
    rows = table(TIMES, PLACES, quaternions())
    rows[5][4:] = [0.0, 0.0, 0.0, 0.0]
    assert "pictures without a pose were left out: 5 (1 in all)" in load_dataset(write(NAMES, rows)).train.notes


def test_rows_without_a_time_are_told(write):
    rows = table(TIMES, PLACES, quaternions())
    rows[4][0] = rows[7][0] = None
    folder = write("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", rows)
    (told,) = (note for note in load_dataset(folder).train.notes if "time" in note)
    assert told.startswith("2 of 12 frames have no time that can be read")
    assert load_dataset(folder, SourceOptions(frames="8:")).train.times_s is not None


@pytest.mark.parametrize(
    ("text", "found"), [("", "no rows"), ("\n \n", "no rows"), ("time,x_mm\n", "only one row, 'time,x_mm'")]
)
def test_a_table_without_rows_is_one_clear_error(write, text, found):
    folder = write("", [])
    (folder / "poses.csv").write_text(text)
    with pytest.raises(DatasetInvalid, match=rf"poses\.csv: it must have a row of names and rows of .* it has {found}"):
        load_dataset(folder)


def text_of(header, rows, separator, spell=repr):
    return "\n".join([header, *(separator.join(map(spell, row)) for row in rows)])


def turned_by(order, unit):  # [N, 3] about x, y, z
    angles = TURNS.as_euler(order, degrees=unit == "deg")
    return np.stack([angles[:, order.lower().index(axis)] for axis in "xyz"], axis=1)


WHOLE = table(TIMES, PLACES, quaternions())
NAMES = "time,x_mm,y_mm,z_mm,qw,qx,qy,qz"


@pytest.mark.parametrize(
    ("text", "calibration"),
    [
        (text_of(NAMES.replace(",", ";"), WHOLE, ";", lambda value: repr(value).replace(".", ",")), {}),
        (text_of(NAMES.replace(",", "\t"), WHOLE, "\t", lambda value: f" {value!r} "), {}),
        (
            "# ground truth\n# a tracker's\n"
            + text_of(
                "# timestamp tx ty tz qx qy qz qw",
                table(TIMES, PLACES / 1000, TURNS.as_quat()),
                " ",
                lambda value: f"{value:14.9f}",
            ),
            {"position_unit": "m"},
        ),
        (text_of("Tx,Ty,Tz,Q0,Qx,Qy,Qz,", table(PLACES, quaternions()), ","), {"position_unit": "mm"}),
        (
            text_of(
                "\ufeffT [us], X [cm], Y [cm], Z [cm],qw,qx,qy,qz", table(TIMES * 1e6, PLACES / 10, quaternions()), ","
            ),
            {},
        ),
        (
            text_of("t_ns,x(m),y(m),z(m),qw,qx,qy,qz", table(TIMES * 1e9, PLACES / 1e3, quaternions()), ",") + "\n\n",
            {},
        ),
        (
            text_of(
                "x_mm,y_mm,z_mm,yaw (°),pitch (°),roll (°)", table(PLACES, turned_by("ZYX", "deg")[:, ::-1]), ","
            ),
            {"euler_order": "ZYX"},
        ),
        (
            text_of("x_mm,y_mm,z_mm,rx,ry,rz", table(PLACES, turned_by("zxy", "rad")), ","),
            {"euler_order": "zxy", "angle_unit": "rad"},
        ),
        (text_of(NAMES, WHOLE, ",", lambda value: f'"{value!r}"').replace("\n", ",\r\n"), {}),
    ],
    ids=["decimal commas", "tabs", "TUM", "NDI", "brackets", "SI", "yaw first", "fixed axes", "quoted"],
)  # fmt: skip
def test_tables_as_other_tools_write_them(write, text, calibration):
    folder = write("", [], **calibration)
    (folder / "poses.csv").write_bytes(text.encode())
    check(folder)
    times_s = load_dataset(folder).train.times_s
    numbers = load_dataset(folder).train.frame_numbers
    assert times_s is None or np.abs(times_s - TIMES[numbers]).max() < 1e-3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            text_of(NAMES, WHOLE, ",", lambda value: repr(value).replace(".", ",")),
            "row 2: it has 16 cells under 8 names: commas in its numbers",
        ),
        (
            text_of(f"{NAMES},qw,qx,qy,qz", [row + row[4:] for row in WHOLE], ","),
            "several columns are called qw: leave",
        ),
        (
            text_of(NAMES, table(TIMES * 1e3, PLACES, quaternions()), ","),
            "its column time has no unit and steps of 50, which are no seconds: name it time_ms",
        ),
    ],
    ids=["decimal commas between commas", "two tools", "milliseconds without a word"],
)
def test_tables_that_would_be_read_wrongly_are_refused(write, text, message):
    folder = write("", [])
    (folder / "poses.csv").write_text(text)
    with pytest.raises(DatasetInvalid, match=message):
        load_dataset(folder)


def test_pictures_of_other_kinds_have_the_same_pixels(write):
    folder = write(NAMES, WHOLE)
    kinds = {
        "12 bits.png": lambda frame: cv2.imencode(".png", frame.astype(np.uint16) << 4)[1],
        "16 bits.tif": lambda frame: cv2.imencode(".tif", frame.astype(np.uint16) << 8)[1],
        "grey.bmp": lambda frame: cv2.imencode(".bmp", frame)[1],
        "colour.tiff": lambda frame: cv2.imencode(".tiff", np.repeat(frame[..., None], 3, axis=2))[1],
        "alpha.png": lambda frame: cv2.imencode(".png", np.dstack([frame, frame, frame, 255 - frame]))[1],
        "palette.png": lambda frame: saved(Image.fromarray(frame).quantize(256, dither=Image.Dither.NONE)),
        "grey and alpha.png": lambda frame: saved(
            Image.merge("LA", (Image.fromarray(frame), Image.new("L", (60, 40))))
        ),
        "white is zero.tif": lambda frame: saved(Image.fromarray(frame), "TIFF", tiffinfo={262: 0}),
    }
    for name, encode in kinds.items():
        for number, frame in enumerate(FRAMES):
            for old in folder.glob(f"{number:03d} *"):
                old.unlink()
            (folder / f"frame_{number}.png").unlink(missing_ok=True)
            (folder / f"{number:03d} {name}").write_bytes(bytes(encode(frame)))
        train = load_dataset(folder).train
        assert np.abs(train.images.astype(int) - FRAMES[train.frame_numbers]).max() <= 1, name
        assert ("bits" in name) == any("pixels of 16 bits were made 8" in note for note in train.notes)


def saved(picture, kind="PNG", **described):
    out = io.BytesIO()
    picture.save(out, kind, **described)
    return out.getvalue()


def test_pictures_named_by_times_are_in_their_order_or_refused(write):
    rows = table(TIMES, PLACES, quaternions())
    folder = write(NAMES, rows, names="nothing.png")
    (folder / "nothing.png").unlink()
    for number, frame in enumerate(FRAMES):
        cv2.imwrite(str(folder / f"us_{TIMES[number]:.2f}.png"), frame)
    check(folder)
    (folder / "us_3.50.png").rename(folder / "us_3.5.png")
    with pytest.raises(DatasetInvalid, match="the order of its pictures cannot be told from names such as us_3"):
        load_dataset(folder)


def test_a_video_in_place_of_pictures_is_told_what_to_do_with(write):
    folder = write(NAMES, WHOLE, pictures="images")
    for picture in (folder / "images").iterdir():
        picture.unlink()
    (folder / "sweep.avi").write_bytes(b"RIFF")
    with pytest.raises(DatasetInvalid, match=r"it holds no pictures .*; sweep\.avi is not read as it is: write its"):
        load_dataset(folder)


def test_pictures_of_several_folders_are_never_mixed_up(write):
    rows = table(TIMES, PLACES, quaternions())
    folder = write(NAMES, rows, pictures="images")
    (folder / "annotations").mkdir()
    for number, frame in enumerate(FRAMES):
        cv2.imwrite(str(folder / "annotations" / f"frame_{number}.png"), 255 - frame)
    with pytest.raises(
        DatasetInvalid, match="pictures lie in several folders, annotations, images: name them as FOLDER"
    ):
        load_dataset(folder)
    named = [[*row, f"images/frame_{number}.png"] for number, row in enumerate(rows)]
    check(write(NAMES + ",file", named, pictures="images"))
    ambiguous = [[*row, f"frame_{number}.png"] for number, row in enumerate(rows)]
    with pytest.raises(DatasetInvalid, match="pictures lie in several folders"):
        load_dataset(write(NAMES + ",file", ambiguous, pictures="images"))


def test_a_picture_beside_the_folder_of_pictures_and_hidden_files_are_none_of_them(write):
    named = [[*row, f"frame_{number}.png"] for number, row in enumerate(table(TIMES, PLACES, quaternions()))]
    folder = write(NAMES + ",file", named, pictures="images")
    cv2.imwrite(str(folder / "overview.png"), FRAMES[0])
    (folder / "images" / "._frame_0.png").write_bytes(b"of a Mac")
    check(folder)
    assert not any("without a row" in note for note in load_dataset(folder).train.notes)
    bare = write(NAMES, WHOLE)
    (bare / "overview.png").unlink()
    (bare / "._frame_0.png").write_bytes(b"of a Mac")
    check(bare)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (
            1.7e9 + TIMES,
            r"none of 12 pictures has a pose: pictures are of 1700000003\.000 to .* s, rows of 3\.000 to 3\.5",
        ),
        (1.7e12 + 1000 * TIMES, "were the clocks other ones, or is a unit wrong"),
        (["2026-03-01T10:00:00"] * COUNT, "row 2: time_s must be a number, got '2026-03-01T10:00:00': write dates"),
    ],
)
def test_pictures_and_rows_of_other_clocks_are_one_clear_error(write, times, message):
    folder = write(NAMES, WHOLE)
    lines = [f"frame_{number}.png,{time}" for number, time in enumerate(times)]
    (folder / "images.csv").write_text("\n".join(["file,time_s", *lines]))
    with pytest.raises(DatasetInvalid, match=message):
        load_dataset(folder)


def test_pictures_between_rows_that_lie_far_apart_are_told(write):
    folder = write(NAMES, [WHOLE[place] for place in (0, 6, 7, 11)])
    (folder / "images.csv").write_text("\n".join(["file,time", *(f"frame_{n}.png,{t}" for n, t in enumerate(TIMES))]))
    (told,) = (note for note in load_dataset(folder).train.notes if "left out" in note)
    assert told == "pictures without a pose between rows at most 200 ms apart were left out: 1, 2, 3, 4, 5 (5 in all)"

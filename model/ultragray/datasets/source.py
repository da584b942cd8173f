"""load_dataset: every format of tracked sweeps behind one call, and the registry of the formats.

Readers are imported when they are needed, so that help texts and uploads can list the formats without them. Another
package adds a format of its own by an entry point of the group `ultragray.dataset_formats`, which is a `DatasetFormat`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from ultragray.contract import Contract, described
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.installation import missing_extra

if TYPE_CHECKING:
    from ultragray.learn.sweep import Dataset


MAX_OPTION_LENGTH = 1000
PHANTOM = "phantom"


@dataclass(frozen=True)
class SourceOptions(Contract):
    """Options of reading a source. None leaves the choice to the source."""

    __topic__ = "Reading the sweep"
    train_frames: str | None = described(
        "Frames to train from, such as 0:90 or 0:90,100:120:2: places in the training file, or in the sequence.", None
    )
    val_frames: str | None = described("Frames to hold out, counted likewise.", None)
    frames: str | None = described("Frames of a sequence to read at all, such as 0:90,100:120:2.", None)
    device_set: Path | None = described("PLUS device set (.xml) with the calibration ImageToProbe of a sequence.", None)
    calibration: Path | None = described(
        "Calibration of the images, of a TUS-REC scan (.csv) or a table of poses (.json); else it lies beside.", None
    )
    crop: str | None = described(
        "Region of a sequence's image that shows ultrasound: columns,rows, such as 188:632,12:600 (ends left out).",
        None,
    )
    fan: str | None = described(
        "Fan on the screen, of a recording with a convex or phased probe: opening angle (degrees), radius of the face "
        "and of the end (mm), column and row of the apex, such as 60,40,90,319.5,-120.",
        None,
    )
    transform: str | None = described(
        "Tracked transform of a sequence to take, such as ProbeToTracker, where there are several; of a recording two "
        "frames of tf, such as probeTobase.",
        None,
    )
    image_size: str | None = described("Resize the frames: WIDTHxHEIGHT, such as 192x256.", None)
    image_topic: str | None = described("Topic of a recording to take images from, where there are several.", None)
    pose_topic: str | None = described("Topic of a recording to take poses from; /tf: from the transforms of tf.", None)
    image_delay_ms: str | None = described(
        "By how much images are stamped later than they were taken (negative: earlier): each gets the pose of that "
        "much before its stamp.",
        None,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, str) and (len(value) > MAX_OPTION_LENGTH or not value.isprintable()):
                raise InvalidArgument(
                    f"{item.name} must be at most {MAX_OPTION_LENGTH} characters of text", field=item.name
                )


def options_of(words: dict[str, str]) -> SourceOptions:
    """The options of an upload."""
    given: dict[str, Any] = dict(words)
    return SourceOptions(**given)


@dataclass(frozen=True)
class DatasetFormat:
    """A format of tracked sweeps.

    `reader` is imported when a source is read, and is given the source's path (a built-in format: nothing) and the
    `options`, by their names. It returns a `Dataset` whose parts are split already, or a `Sweep` and the number of
    frames in its file, and raises DatasetInvalid and InvalidArgument. An upload in this format holds one file whose
    name, in lower case, matches one of `files`.
    """

    name: str
    noun: str  # what a source in this format is, as messages say it
    meaning: str  # the same with its files, for help texts
    is_source: Callable[[str], bool]  # whether a user who writes this means the format
    reader: str  # "module:function"
    files: tuple[str, ...] = ()  # none: built in, never a file
    options: tuple[str, ...] = ()  # fields of SourceOptions that it takes, beside EVERY_FORMAT_TAKES
    beside: tuple[str, ...] = ()  # endings of the files that lie beside such a file, with its stem, and belong to it
    is_folder: bool = False  # whether the whole folder of such a file belongs to it
    companions: Mapping[str, str] = field(default_factory=dict)  # pattern of the file of an upload that is an option
    upload_check: str | None = None  # "module:function" of (source, folder): raises where it needs files elsewhere

    def load(self, source: str, options: SourceOptions) -> Dataset:
        """The dataset of a source with all options but `image_size` applied. Raises as the reader, ExtraMissing."""
        from ultragray.learn.sweep import Dataset, split_parts, split_sequence

        path = Path(source)
        given = {name: getattr(options, name) for name in self.options}
        found = self._function(self.reader)(*([path] if self.files else []), **given)
        wanted = options.train_frames, options.val_frames
        if isinstance(found, Dataset):
            train, val = split_parts(found.train, found.val, *wanted)
            return replace(found, train=train, val=val)
        sweep, frame_count = found
        place = path.resolve().parent if self.is_folder and path.is_file() else path
        return Dataset(place.name.split(".")[0], *split_sequence(sweep, frame_count, *wanted))

    def check_upload(self, source: Path, folder: Path) -> None:
        """Raises DatasetInvalid where an upload in this format names files outside of its folder."""
        if self.upload_check is not None:
            self._function(self.upload_check)(source, folder)

    def _function(self, place: str) -> Any:
        try:
            return EntryPoint(self.name, place, "").load()
        except ImportError as error:
            raise missing_extra(error, f"the {self.noun}") from error

    @property
    def upload_meaning(self) -> str:
        """The meaning, with the files that are options."""
        files = (f", with its {option.replace('_', ' ')} ({pattern})" for option, pattern in self.companions.items())
        return self.meaning + "".join(files)

    def is_file(self, path: PurePath) -> bool:
        """Whether a file of an upload is the one by which its source is known."""
        return any(fnmatchcase(path.name.lower(), pattern) for pattern in self.files)


EVERY_FORMAT_TAKES = ("train_frames", "val_frames", "image_size")


def load_dataset(source: str | Path, options: SourceOptions | None = None) -> Dataset:
    """The dataset that a source holds, in any of the FORMATS.

    Every fifth frame of a sequence is held out unless `options` says otherwise. Raises DatasetInvalid, naming the file,
    the frame and the reason; InvalidArgument, naming the field, for options that cannot be met.
    """
    options, name = options or SourceOptions(), Path(source).name
    if Path(source).is_dir():
        found = find_source(Path(source))
        source = found.path
        beside: dict[str, Any] = {n: path for n, path in found.companions.items() if getattr(options, n) is None}
        options = replace(options, **beside)
    chosen = format_of(source)
    for item in fields(options):
        if getattr(options, item.name) is not None and item.name not in (*EVERY_FORMAT_TAKES, *chosen.options):
            *takers, last = (f"{one.noun}s" for one in FORMATS.values() if item.name in one.options)
            listed = f"{', '.join(takers)} and {last}" if takers else last
            raise InvalidArgument(f"{item.name} is for {listed}, {name} is none", field=item.name)
    dataset = chosen.load(str(source), options)
    if options.image_size is None:
        return dataset
    from ultragray.datasets.images import parse_image_size, resize_frames

    size = parse_image_size(options.image_size)
    train, val = (replace(part, images=resize_frames(part.images, *size)) for part in (dataset.train, dataset.val))
    return replace(dataset, train=train, val=val)


def format_of(source: str | Path) -> DatasetFormat:
    """The format that a source is in, by its name; nothing is read. Raises DatasetInvalid where there is none."""
    path = Path(source)
    if path.is_dir():
        return find_source(path).format
    for one in FORMATS.values():
        if one.is_source(str(source)):
            if one.files and not path.is_file():  # a pipe would never end
                break
            return one
    if not path.is_file():
        raise DatasetInvalid(f"{path}: no such file or folder")
    *meanings, last = (one.meaning for one in FORMATS.values())
    raise DatasetInvalid(f"{path}: a dataset is {', '.join(meanings)} or {last}{advice_for([path])}")


@dataclass(frozen=True)
class FoundSource:
    """The file by which the dataset of a folder is known, and the files beside it that are options of it."""

    format: DatasetFormat
    path: Path
    companions: dict[str, Path]  # by the name of the option


def find_source(folder: Path) -> FoundSource:
    """The dataset of a folder, of an upload or of a user, nearest to its top; a whole folder goes before a file in it.

    Hidden files are passed over. Raises DatasetInvalid, naming files from that folder, where there is not one dataset.
    """
    paths = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    plain = [path for path in paths if not any(part.startswith((".", "__MACOSX")) for part in path.parts)]
    formats = [one for one in FORMATS.values() if one.files]
    ranked = [
        ((len(path.parts), not one.is_folder), one, path) for one in formats for path in plain if one.is_file(path)
    ]
    if not ranked:
        expected = " or ".join(one.upload_meaning for one in formats)
        raise DatasetInvalid(
            f"{folder} must hold {expected}; it holds {_listed(plain) or 'no files'}{advice_for(plain)}"
        )
    least = min(rank for rank, _, _ in ranked)
    sources = [(one, path) for rank, one, path in ranked if rank == least]
    if len(sources) > 1:
        raise DatasetInvalid(f"{folder} must hold one dataset, it holds {_listed([path for _, path in sources])}")
    ((found, source),) = sources
    companions = {}
    for option, pattern in found.companions.items():
        matching = [path for path in plain if fnmatchcase(path.name.lower(), pattern)]
        if len(matching) > 1:
            raise DatasetInvalid(f"{folder} must hold at most one {option} ({pattern}), it holds {_listed(matching)}")
        if matching:
            companions[option] = folder / matching[0]
    return FoundSource(found, folder / source, companions)


def advice_for(paths: Iterable[PurePath]) -> str:
    """What to do with the first of the files that is in a format of other programs, after a semicolon; else nothing."""
    for path in paths:
        for pattern, advice in OTHER_FORMATS.items():
            if fnmatchcase(path.name.lower(), pattern):
                return f"; {path.name} is not read as it is: {advice}"
    return ""


def _listed(paths: list[Path]) -> str:
    shown = ", ".join(map(str, paths[:_NAMES_IN_MESSAGE]))
    return shown + (f" and {len(paths) - _NAMES_IN_MESSAGE} more" if len(paths) > _NAMES_IN_MESSAGE else "")


_NAMES_IN_MESSAGE = 5
PLUS_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr")
FORMATS: Mapping[str, DatasetFormat] = {
    one.name: one
    for one in (
        DatasetFormat(
            name="released",
            noun="folder of the released layout",
            meaning="a folder with conf.json and .npy files (or its conf.json)",
            is_source=lambda source: source.lower().endswith(".json"),
            reader="ultragray.datasets.released:read_released",
            files=("conf.json",),
            options=("image_delay_ms",),
            is_folder=True,
            upload_check="ultragray.datasets.released:require_files_below",
        ),
        DatasetFormat(
            name="plus",
            noun="PLUS sequence",
            meaning=f"a PLUS sequence ({', '.join(PLUS_SUFFIXES)})",
            is_source=lambda source: source.lower().endswith(PLUS_SUFFIXES),
            reader="ultragray.datasets.plus:read_plus_sweep",
            files=tuple(f"*{suffix}" for suffix in PLUS_SUFFIXES),
            options=("frames", "device_set", "crop", "fan", "transform", "image_delay_ms"),
            beside=(".raw", ".zraw", ".raw.gz"),
            companions={"device_set": "*.xml"},
        ),
        DatasetFormat(
            name="dicom",
            noun="DICOM cine loop",
            meaning="a DICOM cine loop (.dcm) with its poses beside it (.poses.npy or .poses.json)",
            is_source=lambda source: source.lower().endswith(".dcm"),
            reader="ultragray.datasets.dicom:read_dicom_sweep",
            files=("*.dcm",),
            options=("frames", "crop", "fan", "image_delay_ms"),
            beside=(".poses.npy", ".poses.json"),
        ),
        DatasetFormat(
            name="mcap",
            noun="MCAP recording",
            meaning="an MCAP recording of ROS 2 (.mcap) with images and poses, its geometry in it or beside it "
            "(.geometry.json)",
            is_source=lambda source: source.lower().endswith(".mcap"),
            reader="ultragray.datasets.mcap:read_mcap_sweep",
            files=("*.mcap",),
            options=("frames", "crop", "transform", "image_topic", "pose_topic", "image_delay_ms"),
            beside=(".geometry.json",),
        ),
        DatasetFormat(
            name="table",
            noun="pose table",
            meaning="a folder of pictures with their poses.csv and calibration.json (or its poses.csv)",
            is_source=lambda source: source.lower().endswith(".csv"),
            reader="ultragray.datasets.table:read_table_sweep",
            files=("poses.csv",),
            options=("frames", "crop", "fan", "calibration", "image_delay_ms"),
            is_folder=True,
        ),
        DatasetFormat(
            name="tusrec",
            noun="TUS-REC scan",
            meaning="a scan of TUS-REC (.h5) with its calibration (calib_matrix.csv, beside it or above)",
            is_source=lambda source: source.lower().endswith(".h5"),
            reader="ultragray.datasets.tusrec:read_tusrec_sweep",
            files=("*.h5",),
            options=("frames", "crop", "fan", "calibration"),
            companions={"calibration": "*.csv"},
        ),
        DatasetFormat(  # the last: a word, no file
            name=PHANTOM,
            noun="built-in phantom",
            meaning=f"the word {PHANTOM}",
            is_source=lambda source: source == PHANTOM,
            reader="ultragray.phantom:load_phantom",
        ),
        *(point.load() for point in entry_points(group="ultragray.dataset_formats")),
    )
}
# What people have and no reader takes, and what to do with it.
OTHER_FORMATS: Mapping[str, str] = {
    **dict.fromkeys(
        ("*.bag", "*.db3"), "make an .mcap of it, by `ros2 bag convert` or `rosbags-convert --dst-storage mcap`"
    ),
    **dict.fromkeys(
        ("*.mp4", "*.avi", "*.mov", "*.mkv", "*.wmv"),
        "write its frames as pictures (`ffmpeg -i VIDEO frame_%05d.png`) beside a poses.csv and an images.csv",
    ),
    **dict.fromkeys(("*.zip", "*.mrb", "*.tar", "*.tgz", "*.tar.gz", "*.7z"), "unpack it"),
    **dict.fromkeys(
        ("*.mat", "*.npz", "*.npy", "*.hdf5"), "write its arrays as .npy files of a folder with a conf.json"
    ),
    "transforms*.json": "write its poses into a poses.csv, and from pixels to the sensor a calibration.json",
}
UPLOADED_FORMATS = tuple(one for one in FORMATS.values() if one.files)
COMPANIONS = tuple(dict.fromkeys(option for one in UPLOADED_FORMATS for option in one.companions))
# What an upload may be given in words; the other options are files of it.
UPLOAD_OPTIONS = {
    item.name: str(item.metadata["description"]) for item in fields(SourceOptions) if item.name not in COMPANIONS
}

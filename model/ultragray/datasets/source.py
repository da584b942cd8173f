"""load_dataset: every kind of source behind one call."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import DatasetInvalid, InvalidArgument
from .images import parse_image_size, resize_frames
from .plus import SEQUENCE_SUFFIXES, read_plus_sweep
from .released import read_released
from .splits import split_parts, split_sequence
from .sweep import Dataset, Sweep

PHANTOM = "phantom"


@dataclass(frozen=True)
class SourceOptions:
    """How a source is read. None leaves the choice to the source."""

    train_frames: str | None = None  # "0:90,100:120:2": places in the training part, or frame numbers of a sequence
    val_frames: str | None = None
    frames: str | None = None  # the frames of a sequence that are read at all
    device_set: Path | None = None  # PLUS device set (XML) that holds the calibration of the image
    crop: str | None = None  # "188:632,12:600": columns and rows, half open, of a sequence's image, x lateral, y depth
    image_size: str | None = None  # "192x256": width x height after the crop


def load_dataset(source: str | Path, options: SourceOptions | None = None) -> Dataset:
    """The dataset in a folder of the released layout (or its conf.json), in a PLUS sequence, or the built-in `phantom`.

    Sequences are .mha, .mhd, .nrrd (so also .igs.mha and .seq.nrrd); every fifth of their frames is held out unless
    `options` says otherwise. Raises DatasetInvalid, naming the file, the frame and the reason; InvalidArgument for
    options that cannot be met.
    """
    options = options or SourceOptions()
    path = Path(source)
    if str(source) == PHANTOM:
        from .phantom import load_phantom

        return _from_parts(load_phantom(), options)
    if path.is_dir() or path.suffix.lower() == ".json":
        return _from_parts(read_released(path), options)
    if not path.is_file():  # a pipe would never end
        raise DatasetInvalid(f"{path}: no such file or folder")
    if path.suffix.lower() not in SEQUENCE_SUFFIXES:
        raise DatasetInvalid(
            f"{path}: a dataset is a folder with conf.json, a PLUS sequence ({', '.join(SEQUENCE_SUFFIXES)}) or the "
            f"word {PHANTOM}"
        )
    sweep, frame_count = read_plus_sweep(path, device_set=options.device_set, frames=options.frames, crop=options.crop)
    train, val = split_sequence(_resized(sweep, options), frame_count, options.train_frames, options.val_frames)
    return Dataset(name=path.name.split(".")[0], train=train, val=val)


def _from_parts(dataset: Dataset, options: SourceOptions) -> Dataset:
    for name in ("frames", "device_set", "crop"):
        if getattr(options, name) is not None:
            option = "--" + name.replace("_", "-")
            raise InvalidArgument(f"{option} is for PLUS sequences, {dataset.name} is none", field=option)
    train, val = split_parts(dataset.train, dataset.val, options.train_frames, options.val_frames)
    return Dataset(name=dataset.name, train=_resized(train, options), val=_resized(val, options))


def _resized(sweep: Sweep, options: SourceOptions) -> Sweep:
    if options.image_size is None:
        return sweep
    return replace(sweep, images=resize_frames(sweep.images, *parse_image_size(options.image_size)))

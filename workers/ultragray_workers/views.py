"""Work of helper processes, each filling a folder to look at: a dataset's frames, a training's last checkpoint, a
scene's thumbnail, a scene beside held-out frames.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import Probe
from ultragray.geometry.scan_conversion import with_square_pixels
from ultragray.rendering.pixels import encoded_image, to_uint8
from ultragray.rendering.settings import Encoding
from ultragray_workers.datasets.store import open_datasets
from ultragray_workers.helpers import replaced, write_stacks
from ultragray_workers.storage.cache import DEFAULT_MAX_BYTES

if TYPE_CHECKING:
    from ultragray.learn.evaluation.scoring import Evaluation


POSES_NAME = "poses.json"
PARTS = ("train", "val")


def lay_out(
    folder: str,
    artifact_folder: str,
    dataset: str,
    storage: str | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
) -> None:
    """Fill `folder` with the poses and frames of the dataset of this name. Raises DatasetNotFound, DatasetInvalid."""
    sweeps = open_datasets(artifact_folder, storage, max_copies_bytes).load(dataset)
    parts = dict(zip(PARTS, (sweeps.train, sweeps.val), strict=True))
    write_stacks(Path(folder), {part: sweep.images for part, sweep in parts.items()}, sweeps.probe)
    poses = {part: sweep.poses.reshape(-1, 16).tolist() for part, sweep in parts.items()}
    (Path(folder) / POSES_NAME).write_text(json.dumps(poses), encoding="utf-8")


# Work of a helper process: rendering a running training as its last checkpoint has it, beside the true frame.


PREVIEW_PICTURES = ("truth", "rendering")


def draw_preview(
    folder: str,
    artifact_folder: str,
    dataset: str,
    checkpoint: str,
    storage: str | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
) -> None:
    """Write truth and rendering of one frame of the dataset of this name into `folder`.

    The frame is the middle one of those held out, else of those trained from; the scene is that of `checkpoint`.
    Raises DatasetNotFound, DatasetInvalid, TrainingStateInvalid.
    """
    import torch

    from ultragray.learn.evaluation.scoring import render_sweep
    from ultragray.learn.training.checkpointing import read_checkpoint
    from ultragray.scene.gaussians import PARAMETERS, GaussianScene
    from ultragray.scene.info import SceneInfo

    torch.set_num_threads(1)
    header, tensors = read_checkpoint(Path(checkpoint))
    sweeps = open_datasets(artifact_folder, storage, max_copies_bytes).load(dataset)
    scene = GaussianScene.from_splats(
        {name: tensors[f"parameter.{name}"] for name in PARAMETERS},
        info=SceneInfo(centre_mm=sweeps.centre_mm.tolist(), probe=sweeps.probe, intensity=header.config.intensity),
    )
    part = sweeps.val if len(sweeps.val) else sweeps.train
    frame = part.select(np.array([len(part) // 2]))
    truth = (frame.images / 255.0).astype(np.float32)
    pictures = dict(zip(PREVIEW_PICTURES, (truth, render_sweep(scene, frame, backend="cpu")), strict=True))
    write_stacks(Path(folder), pictures, sweeps.probe)


# Work of a helper process: the picture by which a scene is known in lists.


THUMBNAIL_NAME = "thumbnail.png"
THUMBNAIL_SIDE = 128  # scan lines, samples, and pixels of the longer side


COMPRESSED_NAME = "scene.ugz"


def draw_thumbnail(folder: str, scene_path: str, **_places: object) -> None:
    """Write the middle view of the training sweep of a scene, which knows its probe, into `folder`.

    Raises SceneFileInvalid.
    """
    import torch

    from ultragray.rendering.frames import render
    from ultragray.scene.gaussians import GaussianScene

    torch.set_num_threads(1)
    scene = GaussianScene.load(scene_path)
    probe = scene.info.probe_or(None)
    pose = scene.training_poses[len(scene.training_poses) // 2]
    side = THUMBNAIL_SIDE
    with torch.no_grad():
        frames = render(scene, probe, pose, height=side, width=side, outputs=("bmode",), backend="cpu")
    picture = with_square_pixels(frames["bmode"][0].numpy(), probe, side)
    (Path(folder) / THUMBNAIL_NAME).write_bytes(encoded_image(to_uint8(picture), Encoding.PNG))


def compress_scene(folder: str, scene_path: str, **_places: object) -> None:
    """Write a scene, compressed, into `folder`. Raises SceneFileInvalid."""
    from ultragray.scene.gaussians import GaussianScene

    GaussianScene.load(scene_path).save(Path(folder) / COMPRESSED_NAME)


# Work of a helper process: comparing a scene with the held-out frames of the dataset that it was trained from.
#
# What is known of a frame is written at once, for those who look meanwhile: `INDEX.npy` has as many of PICTURES as are
# drawn, FRAMES_NAME a row a frame with the figures that are measured, and null for the others. A figure is there only
# where its picture is.


FRAMES_NAME = "frames.json"
CLASSICAL = ("nearest", "linear", "median")  # of ultragray.learn.evaluation.baselines.BASELINES; the slowest last
PICTURES = ("truth", "rendering", "difference", *CLASSICAL)  # in the order in which they are drawn
_COMPARED = ("psnr_db", "ms_ssim", "gms", "gmsd")
_FIGURES = (*_COMPARED, "histogram_distance")


def compare(
    folder: str,
    artifact_folder: str,
    dataset: str | None,
    scene_path: str,
    storage: str | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
) -> None:
    """Fill `folder` with metrics and pictures of a scene on the frames that the dataset of this name holds out.

    None is the built-in phantom, which is simulated frame by frame: those held out first. Raises DatasetNotFound,
    DatasetInvalid where the dataset holds out none, SceneFileInvalid, InvalidImageSize for frames too small to measure.
    """
    import torch

    from ultragray.learn.evaluation.baselines import affordable_voxel_mm, compound, predict
    from ultragray.learn.evaluation.scoring import check_same_origin, evaluate_frames, render_sweep, require_frames
    from ultragray.learn.evaluation.side_by_side import DIFFERENCE_GAIN
    from ultragray.phantom.sweeps import phantom_poses, scan_phantom
    from ultragray.scene.confidence import Assessor
    from ultragray.scene.gaussians import GaussianScene

    torch.set_num_threads(1)
    scene = GaussianScene.load(scene_path)
    if dataset is None:
        trained, poses = phantom_poses()
        numbers = np.arange(len(trained), len(trained) + len(poses))
        held_out = (scan_phantom(poses[[place]], first=len(trained) + place) for place in range(len(poses)))
    else:
        sweeps = open_datasets(artifact_folder, storage, max_copies_bytes).load(dataset)
        check_same_origin(scene.info, sweeps)
        require_frames(sweeps.val)
        poses, numbers = sweeps.val.poses, sweeps.val.frame_numbers
        held_out = (sweeps.val.select(np.array([place])) for place in range(len(poses)))
    comparison = _Comparison(Path(folder), numbers.tolist(), poses.tolist())
    assessor = Assessor(scene.info, scene.training_poses)
    truths = []
    for index, truth in enumerate(held_out):
        truths.append(truth)
        rendered = render_sweep(scene, truth, backend="cpu")
        coverage = render_sweep(scene, truth, backend="cpu", output="coverage")
        (trusted,) = assessor.assess(truth.poses, truth.probe, coverage=coverage)
        difference = np.minimum(np.abs(rendered - truth.images / np.float32(255.0)) * DIFFERENCE_GAIN, 1.0)
        pictures = (truth.images[0], rendered[0], difference[0])
        measured = _metrics(evaluate_frames(rendered, truth))
        comparison.add(index, truth.probe, pictures, {"confidence": trusted.confidence, **measured})
    train = scan_phantom(trained) if dataset is None else sweeps.train
    for name in CLASSICAL:
        volume = compound(train, name, affordable_voxel_mm(train)) if name == "median" else None
        for index, truth in enumerate(truths):
            if volume is None:
                expected = predict(train, truth.poses, name)
            else:
                expected = volume.reslice(train.probe, truth.poses, train.height, train.width)
            measured = _metrics(evaluate_frames(expected, truth))
            figures = {f"{name}_{metric}": value for metric, value in measured.items()}
            comparison.add(index, truth.probe, (expected[0],), figures)


class _Comparison:
    """The folder of a comparison under way."""

    def __init__(self, folder: Path, numbers: list[int], poses: list[Any]) -> None:
        self._folder = folder
        prefixes = ("", *(f"{name}_" for name in CLASSICAL))
        unknown = dict.fromkeys(("confidence", *(f"{prefix}{metric}" for prefix in prefixes for metric in _FIGURES)))
        self._frames = [
            {"index": index, "frame_number": number, "pose": pose, **unknown}
            for index, (number, pose) in enumerate(zip(numbers, poses, strict=True))
        ]
        self._pictures: list[list[npt.NDArray[np.uint8]]] = [[] for _ in numbers]
        self._write()

    def add(
        self, index: int, probe: Probe, pictures: Sequence[npt.NDArray[Any]], figures: Mapping[str, float | None]
    ) -> None:
        """Pictures [H, W], uint8 or float32 in [0, 1], that follow those of this frame, and what was measured."""
        self._pictures[index] += map(to_uint8, pictures)
        write_stacks(self._folder, {str(index): np.stack(self._pictures[index])}, probe)
        self._frames[index].update(figures)
        self._write()

    def _write(self) -> None:
        with replaced(self._folder / FRAMES_NAME) as path:
            path.write_text(json.dumps(self._frames), encoding="utf-8")


def _metrics(evaluation: Evaluation) -> dict[str, float]:
    """The metrics of the only frame."""
    own = {name: getattr(evaluation.frames[0], name) for name in _COMPARED}
    return {**own, "histogram_distance": evaluation.frame_speckle[0].histogram_distance}

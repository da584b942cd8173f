"""Checkpoints of a running training: one safetensors file that a killed run continues from, bit for bit.

Tensors: `parameter.*` (the raw parameters), `adam.*` (moments and step counts), `pull.total` and `pull.seen` (the
statistics of the next refinement), `floor` (the least intensity of each Gaussian), `beam.*` (a learned beam), `pose.*`
(corrections of poses that are trained, and their moments), `waiting` (frames of this round that were not seen yet) and
`generator` (the state of the run's random numbers). Metadata: one JSON object with the fields of `CheckpointHeader`.
Nothing is pickled.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ultragray.errors import InvalidArgument, TrainingStateInvalid
from ultragray.files import require_version, write_whole
from ultragray.learn.training.beam import expected_beam_tensors
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.optimizer import MOMENTS, is_trained
from ultragray.scene.info import expected_shapes

FORMAT_VERSION = 2
METADATA_KEY = "ultragray-training"


@dataclass(frozen=True)
class CheckpointHeader:
    """The description of its run that a checkpoint holds."""

    step: int  # steps done
    elapsed_s: float
    dataset_sha256: str
    config: TrainingConfig


def write_checkpoint(path: Path, header: CheckpointHeader, tensors: Mapping[str, Tensor]) -> None:
    """Replaces the file whole or not at all. Raises OSError where it cannot be written."""
    document = {"format_version": FORMAT_VERSION, **asdict(header)}
    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    data = save(stored, metadata={METADATA_KEY: json.dumps(document, sort_keys=True)})
    write_whole(path, data)


def read_checkpoint_header(path: Path) -> CheckpointHeader:
    """Raises TrainingStateInvalid, naming the file and the reason, where it is no checkpoint of a training."""
    return read_checkpoint(path, with_tensors=False)[0]


def read_checkpoint(path: Path, *, with_tensors: bool = True) -> tuple[CheckpointHeader, dict[str, Tensor]]:
    """The header and the tensors by name. Raises TrainingStateInvalid, naming the file and the reason."""
    try:
        with safe_open(path, framework="pt") as bundle:
            header = _header((bundle.metadata() or {})[METADATA_KEY])
            tensors = {name: bundle.get_tensor(name) for name in bundle.keys()} if with_tensors else {}  # noqa: SIM118
    except FileNotFoundError as error:
        raise TrainingStateInvalid(f"{path}: no such file: there is nothing to resume") from error
    except KeyError as error:
        raise TrainingStateInvalid(f"{path}: not a checkpoint of a training") from error
    except (OSError, SafetensorError, ValueError, TypeError, RecursionError) as error:
        raise TrainingStateInvalid(f"{path}: not a checkpoint that can be read: {error}") from error
    return header, tensors


def _header(text: str) -> CheckpointHeader:
    document: Any = json.loads(text)
    if not isinstance(document, dict):
        raise ValueError("its metadata is not a JSON object")
    require_version(document.pop("format_version", None), FORMAT_VERSION)
    try:
        header = CheckpointHeader(**{**document, "config": TrainingConfig.from_dict(document["config"])})
    except InvalidArgument as error:
        raise ValueError(error.detail) from error
    if header.config.max_gaussians is None:
        raise ValueError("its max_gaussians is null, expected a number")
    if type(header.step) is not int or not 1 <= header.step <= (header.config.steps or 0):
        raise ValueError(f"its step is {header.step!r}, expected 1 to {header.config.steps}")
    if not isinstance(header.elapsed_s, (int, float)) or not 0.0 <= header.elapsed_s < math.inf:
        raise ValueError(f"its elapsed_s is {header.elapsed_s!r}, expected seconds")
    if not isinstance(header.dataset_sha256, str):
        raise ValueError(f"its dataset_sha256 is {header.dataset_sha256!r}, expected text")
    return header


def check_tensors(
    path: Path, header: CheckpointHeader, tensors: Mapping[str, Tensor], frame_count: int, pose_count: int
) -> None:
    """Raises TrainingStateInvalid unless these are the tensors of such a run on so many training frames.

    `pose_count` is the number of pose corrections that the run trains.
    """
    config, means, waiting = header.config, tensors.get("parameter.means"), tensors.get("waiting")
    assert config.max_gaussians is not None
    count, waiting_count = (len(t) if t is not None and t.ndim else 0 for t in (means, waiting))
    if not 1 <= count <= config.max_gaussians:
        raise TrainingStateInvalid(f"{path}: it holds {count} Gaussians, expected 1 to {config.max_gaussians}")
    expected = _expected_tensors(config, count, waiting_count, pose_count)
    if different := set(tensors) ^ set(expected):
        raise TrainingStateInvalid(f"{path}: missing or unexpected tensors: {', '.join(sorted(different))}")
    for name, (dtype, shape) in expected.items():
        tensor = tensors[name]
        if tensor.dtype != dtype or tuple(tensor.shape) != shape:
            raise TrainingStateInvalid(
                f"{path}: its tensor {name} is {tensor.dtype} {list(tensor.shape)}, expected {dtype} {list(shape)}"
            )
        if not bool(torch.isfinite(tensor).all()):
            raise TrainingStateInvalid(f"{path}: its tensor {name} is not finite")
        if name.startswith("adam.") and name.endswith(".step") and int(tensor) != header.step:
            raise TrainingStateInvalid(f"{path}: its tensor {name} is {int(tensor)}, expected {header.step}")
    places = tensors["waiting"]
    if waiting_count >= frame_count or not bool(((places >= 0) & (places < frame_count)).all()):
        raise TrainingStateInvalid(f"{path}: its tensor waiting names frames that the {frame_count} do not have")


def _expected_tensors(
    config: TrainingConfig, gaussian_count: int, waiting_count: int, pose_count: int
) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("pull.total", "pull.seen", "floor"), (gaussian_count,))
    for name, shape in expected_shapes(gaussian_count, config.sh_degree).items():
        shapes[f"parameter.{name}"] = shape
        if is_trained(name, shape, config):
            shapes |= {f"adam.{name}.{moment}": shape for moment in MOMENTS} | {f"adam.{name}.step": ()}
    generator = torch.Generator().get_state()
    poses = {f"pose.{name}": (torch.float64, (pose_count, 6)) for name in ("twists", *MOMENTS)}
    return {
        **({**poses, "pose.step": (torch.float32, ())} if pose_count else {}),
        **{name: (torch.float32, shape) for name, shape in shapes.items()},
        "waiting": (torch.int64, (waiting_count,)),
        "generator": (generator.dtype, tuple(generator.shape)),
        **{f"beam.{name}": expected for name, expected in expected_beam_tensors(config).items()},
    }


def check_same_run(path: Path, header: CheckpointHeader, config: TrainingConfig, dataset_sha256: str) -> None:
    """Raises TrainingStateInvalid where a checkpoint belongs to another dataset or another configuration."""
    if header.dataset_sha256 != dataset_sha256:
        raise TrainingStateInvalid(
            f"{path}: it belongs to another dataset, or another split of it (SHA-256 {header.dataset_sha256[:12]}…, "
            f"given {dataset_sha256[:12]}…)"
        )
    stored, settings = header.config.to_dict(), config.to_dict()
    different = [name for name in stored if stored[name] != settings[name] and name != "memory_gb"]
    if different:
        changes = ", ".join(f"{name} is {stored[name]!r} there, {settings[name]!r} here" for name in different)
        raise TrainingStateInvalid(f"{path}: it belongs to a run with other settings: {changes}", field=different[0])

"""Checkpoints of a running training: one safetensors file that a killed run continues from, bit for bit.

Tensors: `parameter.*` (the raw parameters), `adam.*` (moments and step counts), `pull.total` and `pull.seen` (the
statistics of the next refinement), `waiting` (frames of this round that were not seen yet) and `generator` (the state
of the run's random numbers). Metadata: one JSON object with the fields of `CheckpointHeader`. Nothing is pickled.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ..errors import InvalidArgument, TrainingStateInvalid
from ..files import atomic_path
from .config import TrainingConfig

FORMAT_VERSION = 1
METADATA_KEY = "ultragray-training"


@dataclass(frozen=True)
class CheckpointHeader:
    """What a checkpoint says about its run."""

    step: int  # steps done
    elapsed_s: float
    dataset_sha256: str
    config: TrainingConfig


def write_checkpoint(path: Path, header: CheckpointHeader, tensors: Mapping[str, Tensor]) -> None:
    """Replaces the file whole or not at all. Raises OSError where it cannot be written."""
    document = {"format_version": FORMAT_VERSION, **asdict(header)}
    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    data = save(stored, metadata={METADATA_KEY: json.dumps(document, sort_keys=True)})
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def read_checkpoint_header(path: Path) -> CheckpointHeader:
    """Raises TrainingStateInvalid, naming the file and the reason, where it is no checkpoint of a training."""
    return _read(path, with_tensors=False)[0]


def read_checkpoint(path: Path) -> tuple[CheckpointHeader, dict[str, Tensor]]:
    """The header and the tensors by name. Raises TrainingStateInvalid, naming the file and the reason."""
    return _read(path, with_tensors=True)


def _read(path: Path, *, with_tensors: bool) -> tuple[CheckpointHeader, dict[str, Tensor]]:
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
    document: dict[str, Any] = json.loads(text)
    version = document.pop("format_version", None)
    if version != FORMAT_VERSION:
        raise ValueError(f"its format_version is {version!r}, this release reads {FORMAT_VERSION}")
    try:
        return CheckpointHeader(**{**document, "config": TrainingConfig.from_dict(document["config"])})
    except InvalidArgument as error:
        raise ValueError(error.detail) from error


def check_same_run(path: Path, header: CheckpointHeader, config: TrainingConfig, dataset_sha256: str) -> None:
    """Raises TrainingStateInvalid where a checkpoint belongs to another dataset or another configuration."""
    if header.dataset_sha256 != dataset_sha256:
        raise TrainingStateInvalid(
            f"{path}: it belongs to another dataset, or another split of it (SHA-256 {header.dataset_sha256[:12]}…, "
            f"given {dataset_sha256[:12]}…)"
        )
    stored, given = header.config.to_dict(), config.to_dict()
    different = [name for name in stored if stored[name] != given[name] and name != "memory_gb"]
    if different:
        changes = ", ".join(f"{name} is {stored[name]!r} there, {given[name]!r} here" for name in different)
        raise TrainingStateInvalid(f"{path}: it belongs to a run with other settings: {changes}", field=different[0])

"""The errors of the project.

UltragrayError
├── InvalidArgument
│   ├── InvalidPose
│   ├── InvalidProbe
│   ├── InvalidImageSize
│   ├── UnknownOutput
│   ├── LowConfidence
│   ├── FrameTooCostly
│   └── TooManyPoses
├── SceneFileInvalid
├── CheckpointInvalid
├── DatasetInvalid
├── TrainingDiverged
├── TrainingStateInvalid
├── MemoryExceeded
├── BackendUnavailable
├── ExtraMissing
├── RenderFailed
├── those of pool, datasets and jobs: ultragray_workers.errors
└── those of the front doors: ultragray_service.errors

Each class carries a `reason` that never changes: clients match on it, and the service looks up the statuses that its
front doors answer with. It is the class's name in capitals, where the class does not say otherwise. The first
paragraph of its docstring is its line in docs/reference/errors.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import ClassVar

_WORD = re.compile(r"(?<!^)(?=[A-Z])")  # where a word of a class's name begins


class UltragrayError(Exception):
    """Unexpected; the log has it under the request id.

    Base of all errors. `str(error)` is one sentence for a person; `field` is the path of what is to blame, if one is.
    """

    reason: ClassVar[str] = "INTERNAL"
    title: ClassVar[str] = "Internal error"

    def __init_subclass__(cls) -> None:
        if "reason" not in vars(cls):
            cls.reason = _WORD.sub("_", cls.__name__).upper()

    def __init__(self, detail: str, *, field: str | None = None, retry_after_s: float | None = None) -> None:
        """`retry_after_s`: when the same request may succeed, where the one who raises it knows."""
        super().__init__(detail)
        self.detail = detail
        self.field = field
        self.retry_after_s = retry_after_s

    def __reduce__(self) -> tuple[object, ...]:  # crosses the pipe from a worker unchanged
        return _rebuild, (type(self), self.detail, self.field, self.retry_after_s)


def _rebuild(cls: type[UltragrayError], detail: str, field: str | None, retry_after_s: float | None) -> UltragrayError:
    return cls(detail, field=field, retry_after_s=retry_after_s)


def error_classes(base: type[UltragrayError] = UltragrayError) -> Iterator[type[UltragrayError]]:
    """All classes of errors that were imported, `base` first."""
    yield base
    for cls in base.__subclasses__():
        yield from error_classes(cls)


class InvalidArgument(UltragrayError, ValueError):
    """A value that cannot be used; `field` names it as the caller wrote it."""

    title = "Invalid argument"


class InvalidPose(InvalidArgument):
    """Not a rigid probe→scene transform."""

    title = "Not a rigid probe-to-scene transform"


class InvalidProbe(InvalidArgument):
    """A probe that no transducer could have, such as far ≤ near."""

    title = "Invalid probe"


class InvalidImageSize(InvalidArgument):
    """Height or width outside the limits."""

    title = "Invalid image size"


class UnknownOutput(InvalidArgument):
    """An output that does not exist, none at all, or one that the scene does not have."""

    title = "Unknown output"


class LowConfidence(InvalidArgument):
    """A pose below the `min_confidence` that was asked for."""

    title = "The confidence is too low"


class FrameTooCostly(InvalidArgument):
    """A frame whose Gaussians cover more pixels than `ULTRAGRAY_MAX_FOOTPRINT_PIXELS` allows; ask for a smaller one."""

    title = "The frame would take too long"


class TooManyPoses(InvalidArgument):
    """More poses, or pixels, than one request may have; send several."""

    title = "Too many poses"


class SceneFileInvalid(UltragrayError):
    """A scene file that is truncated, foreign or inconsistent."""

    title = "Invalid scene file"


class CheckpointInvalid(UltragrayError):
    """A checkpoint, conf.json or pose file that cannot be imported (command line, library)."""

    title = "Invalid checkpoint"


class DatasetInvalid(UltragrayError):
    """A tracked sweep that cannot be used; names the file, the frame and the reason."""

    title = "Invalid dataset"


class TrainingDiverged(UltragrayError):
    """Loss or parameters of a training are no longer finite, or no method of a comparison came to its end."""

    title = "Training diverged"


class TrainingStateInvalid(UltragrayError):
    """A training folder that cannot be resumed from."""

    title = "Training cannot be resumed"


class MemoryExceeded(UltragrayError):
    """The check of a dataset or scene file, a comparison, a training, or a frame or scene on a GPU, that does not fit
    into memory; also where the machine has none left.
    """

    title = "Memory exceeded"


class BackendUnavailable(UltragrayError):
    """A backend that cannot run here."""

    title = "Render backend unavailable"


class ExtraMissing(UltragrayError):
    """A format, a command or traces whose package is not installed; the sentence says how to install it (uploads,
    jobs, command line, library).
    """

    title = "Optional package not installed"


class RenderFailed(UltragrayError):
    """A worker could not render the frame."""

    title = "Rendering failed"

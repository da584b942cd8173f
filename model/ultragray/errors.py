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

Each class carries a `reason` that never changes, which is its name: clients match on it, and the service looks up the
statuses that its front doors answer with. The first paragraph of its docstring is its line in docs/reference/errors.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from typing import ClassVar


class UltragrayError(Exception):
    """Unexpected; the log has it under the request id.

    Base of all errors. `str(error)` is one sentence for a person; `field` is the path of what is to blame, if one is.
    """

    reason: ClassVar[str] = "INTERNAL"
    title: ClassVar[str] = "Internal error"

    def __init_subclass__(cls, *, title: str | None = None, reason: str | None = None) -> None:
        cls.reason = reason or re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).upper()
        cls.title = title or cls.title

    def __init__(self, detail: str, *, field: str | None = None, retry_after_s: float | None = None) -> None:
        """`retry_after_s`: when the same request may succeed, where the one who raises it knows."""
        super().__init__(detail)
        self.detail = detail
        self.field = field
        self.retry_after_s = retry_after_s

    def __reduce__(self) -> tuple[object, ...]:  # crosses the pipe from a worker unchanged
        return partial(type(self), field=self.field, retry_after_s=self.retry_after_s), (self.detail,)


def error_classes(base: type[UltragrayError] = UltragrayError) -> Iterator[type[UltragrayError]]:
    """All classes of errors that were imported, `base` first."""
    yield base
    for cls in base.__subclasses__():
        yield from error_classes(cls)


class InvalidArgument(UltragrayError, ValueError, title="Invalid argument"):
    """A value that cannot be used; `field` names it as the caller wrote it."""


class InvalidPose(InvalidArgument, title="Not a rigid probe-to-scene transform"):
    """Not a rigid probe→scene transform."""


class InvalidProbe(InvalidArgument, title="Invalid probe"):
    """A probe that no transducer could have, such as far ≤ near."""


class InvalidImageSize(InvalidArgument, title="Invalid image size"):
    """Height or width outside the limits."""


class UnknownOutput(InvalidArgument, title="Unknown output"):
    """An output that does not exist, none at all, or one that the scene does not have."""


class LowConfidence(InvalidArgument, title="The confidence is too low"):
    """A pose below the `min_confidence` that was asked for."""


class FrameTooCostly(InvalidArgument, title="The frame would take too long"):
    """A frame whose Gaussians cover more pixels than `ULTRAGRAY_MAX_FOOTPRINT_PIXELS` allows; ask for a smaller one."""


class TooManyPoses(InvalidArgument, title="Too many poses"):
    """More poses, or pixels, than one request may have; send several."""


class SceneFileInvalid(UltragrayError, title="Invalid scene file"):
    """A scene file that is truncated, foreign or inconsistent."""


class CheckpointInvalid(UltragrayError, title="Invalid checkpoint"):
    """A checkpoint, conf.json or pose file that cannot be imported (command line, library)."""


class DatasetInvalid(UltragrayError, title="Invalid dataset"):
    """A tracked sweep that cannot be used; names the file, the frame and the reason."""


class TrainingDiverged(UltragrayError, title="Training diverged"):
    """Loss or parameters of a training are no longer finite, or no method of a comparison came to its end."""


class TrainingStateInvalid(UltragrayError, title="Training cannot be resumed"):
    """A training folder that cannot be resumed from."""


class MemoryExceeded(UltragrayError, title="Memory exceeded"):
    """The check of a dataset or scene file, a comparison, a training, or a frame or scene on a GPU, that does not fit
    into memory; also where the machine has none left.
    """


class BackendUnavailable(UltragrayError, title="Render backend unavailable"):
    """A backend that cannot run here."""


class ExtraMissing(UltragrayError, title="Optional package not installed"):
    """A format, a command or traces whose package is not installed; the sentence says how to install it (uploads,
    jobs, command line, library).
    """


class RenderFailed(UltragrayError, title="Rendering failed"):
    """A worker could not render the frame."""

"""The inside of a helper process: one piece of work apart from the service, slow to others, of limited memory.

It reads one JSON object from stdin (`arguments` of the work, `memory_bytes`, and `what` it does, as errors say it) and
writes one to stdout: `{}`, or the `reason`, `detail` and `field` of an error. Free of torch, as the module of any work
must be until the work begins.
"""

from __future__ import annotations

import contextlib
import json
import resource
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.contract import from_dict, to_dict
from ultragray.errors import MemoryExceeded, UltragrayError
from ultragray.geometry.probe import Probe
from ultragray.geometry.scan_conversion import with_square_pixels
from ultragray.rendering.pixels import to_uint8
from ultragray_workers.claims import storage_full
from ultragray_workers.processes import end_with_parent, let_frames_go_first

NICE_LEVEL = 10


def answer_request(work: Callable[..., None]) -> None:
    """Do the work with the arguments on stdin. The process ends with its parent."""
    end_with_parent(signal.SIGKILL)
    let_frames_go_first(NICE_LEVEL)
    request = json.loads(sys.stdin.buffer.read())
    memory_bytes, what = request["memory_bytes"], request["what"]
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    answer: dict[str, str | None] = {}
    try:
        try:
            with storage_full("it"):
                work(**request["arguments"])
        except (MemoryError, RuntimeError) as error:  # RuntimeError: how torch tells it
            if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
                raise
            limit = f"{memory_bytes >> 20} MiB (ULTRAGRAY_DATASET_MEMORY_MB of the service)"
            raise MemoryExceeded(f"{what} takes more than {limit}") from None
    except UltragrayError as error:
        answer = {"reason": error.reason, "detail": error.detail, "field": error.field}
    sys.stdout.write(json.dumps(answer))


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A path to write to in place of `path`, which others read meanwhile: it gets the name once it is whole."""
    temporary = path.with_name(f"{path.name}.new")
    yield temporary
    temporary.replace(path)


# Frames in a folder, uint8 [F, H, W] by name, as their probe samples them; read one at a time, as pictures.
#
# Free of torch.


PROBE_NAME, SUFFIX = "probe.json", ".npy"
PICTURE_SIDE = 512  # pixels, the longer one


def write_stacks(folder: Path, stacks: Mapping[str, npt.NDArray[Any]], probe: Probe) -> None:
    """Writes frames of one probe, [F, H, W], uint8 or float32 in [0, 1]."""
    with replaced(folder / PROBE_NAME) as path:
        path.write_text(json.dumps(to_dict(probe)), encoding="utf-8")
    for name, frames in stacks.items():
        with replaced(folder / f"{name}{SUFFIX}") as path, path.open("wb") as file:
            header = {"descr": "|u1", "fortran_order": False, "shape": frames.shape}
            np.lib.format.write_array_header_1_0(file, header)
            for frame in frames:  # np.save does not tell that a disk is full
                file.write(np.ascontiguousarray(to_uint8(frame)).data)


def read_picture(folder: Path, name: str, index: int) -> npt.NDArray[np.uint8] | None:  # [H', W']
    try:
        stack = np.load(folder / f"{name}{SUFFIX}", mmap_mode="r")
        probe = from_dict(Probe, json.loads((folder / PROBE_NAME).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    if not 0 <= index < len(stack):
        return None
    picture = with_square_pixels(stack[index].astype(np.float32), probe, PICTURE_SIDE)
    return np.rint(picture).astype(np.uint8)

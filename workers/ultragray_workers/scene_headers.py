"""Headers of scene files: those of a bucket without their Gaussians, and those that were used last."""

from __future__ import annotations

import json
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Hashable

from ultragray.errors import SceneFileInvalid
from ultragray.scene.info import (
    CORRECTIONS_TENSOR,
    SceneHeader,
    SceneInfo,
    check_header_size,
    read_header,
    scene_file_invalid,
)
from ultragray_workers.storage.storage import Storage

_FIRST_READ_BYTES = 64 * 1024  # most headers with their poses
_LENGTH_BYTES = 8
_KEPT_BYTES = 128 * 2**20  # of headers: training poses, and what metadata becomes
_OBJECT_BYTES_PER_TEXT_BYTE = 30  # of the most wasteful metadata: empty lists in a list


def floats_per_gaussian(info: SceneInfo) -> int:
    """Of a scene's parameters."""
    return 3 + 3 + 4 + 1 + (info.sh_degree + 1) ** 2  # means, scales, quats, transmittances, SH


def fetch_header(storage: Storage, key: str, file_bytes: int, name: str) -> SceneHeader:
    """The header of the scene file that an object of so many bytes is, by two or three reads of parts of it.

    Raises NotThere, StorageUnavailable, and SceneFileInvalid, which calls the file `name`.
    """
    start = storage.read(key, length=_FIRST_READ_BYTES)
    try:
        check_header_size(start)
        header_bytes = _LENGTH_BYTES + int.from_bytes(start[:_LENGTH_BYTES], "little")
        if header_bytes > len(start):
            start += storage.read(key, start=len(start), length=header_bytes - len(start))
        tensors = json.loads(start[_LENGTH_BYTES:header_bytes])
        parts = [tensors[one]["data_offsets"] for one in ("training_poses", CORRECTIONS_TENSOR) if one in tensors]
        ranges = [(header_bytes + int(first), header_bytes + int(stop)) for first, stop in parts]
    except (ValueError, KeyError, TypeError) as error:
        raise scene_file_invalid(name, error) from error
    with tempfile.NamedTemporaryFile(prefix="ultragray-header-") as sparse:  # the Gaussians are a hole in it
        sparse.write(start[:header_bytes])
        for first, stop in ranges:
            if first < stop <= file_bytes:
                sparse.seek(first)
                sparse.write(storage.read(key, start=first, length=stop - first))
        sparse.truncate(file_bytes)
        sparse.flush()
        try:
            return read_header(sparse.name)
        except SceneFileInvalid as error:
            raise SceneFileInvalid(error.detail.replace(sparse.name, name)) from None


class KeptHeaders:
    """The headers that were used last, within a budget. Its methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, tuple[Hashable, SceneHeader]] = OrderedDict()  # least recently used first
        self._bytes = 0

    def get(self, name: str, version: Hashable) -> SceneHeader | None:
        """The header of a scene if it is of this version; one of another version is dropped."""
        with self._lock:
            kept = self._kept.get(name)
            if kept is None or kept[0] != version:
                self._drop(name)
                return None
            self._kept.move_to_end(name)
            return kept[1]

    def keep(self, name: str, version: Hashable, header: SceneHeader) -> None:
        with self._lock:
            self._drop(name)
            self._kept[name] = version, header
            self._bytes += _described_bytes(header)
            while self._bytes > _KEPT_BYTES:
                self._drop(next(iter(self._kept)))

    def drop(self, name: str) -> None:
        with self._lock:
            self._drop(name)

    def _drop(self, name: str) -> None:
        if (kept := self._kept.pop(name, None)) is not None:
            self._bytes -= _described_bytes(kept[1])


def _described_bytes(header: SceneHeader) -> int:
    """Of a scene file without its Gaussians, as what is read from it: text becomes objects."""
    bytes_per_gaussian = 4 * floats_per_gaussian(header.info) + bool(header.info.label_names)
    gaussians_bytes = bytes_per_gaussian * header.info.gaussian_count
    text_bytes = header.file_bytes - gaussians_bytes - header.training_poses.nbytes
    return header.training_poses.nbytes + _OBJECT_BYTES_PER_TEXT_BYTE * max(text_bytes, 0)

"""The archives of render jobs, written as frames come."""

from __future__ import annotations

import io
import json
import tarfile
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ultragray.probe import FloatArray

from ..encoding import FrameArray, encode_image, write_npz
from ..types import Encoding


@dataclass(frozen=True)
class ArchiveHeader:
    """What the frames of an archive have in common."""

    outputs: tuple[str, ...]
    poses: FloatArray  # [C, 4, 4] mm
    height: int
    width: int
    scene: str
    scene_sha256: str
    renderer: str


class Archive(ABC):
    """Takes the frames in order; nothing but `close` makes the file whole."""

    @abstractmethod
    def add(self, frames: Mapping[str, FrameArray]) -> None:
        """The next frames, each output [B, H, W]. Raises OSError."""

    @abstractmethod
    def close(self) -> None:
        """After the last frame. Raises OSError."""


class NpzArchive(Archive):
    """One .npz: each output float32 [C, H, W], and the keys of rendered .npz files. Frames wait in .npy files."""

    def __init__(self, path: Path, header: ArchiveHeader) -> None:
        self._path, self._header, self._done = path, header, 0
        shape = (len(header.poses), header.height, header.width)
        self._files = {name: path.with_name(f".{name}.npy") for name in header.outputs}
        self._arrays = {
            name: np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=shape)
            for name, file in self._files.items()
        }

    def add(self, frames: Mapping[str, FrameArray]) -> None:
        count = 0
        for name, array in self._arrays.items():
            count = len(frames[name])
            array[self._done : self._done + count] = frames[name]
        self._done += count

    def close(self) -> None:
        header = self._header
        with self._path.open("wb") as file:
            write_npz(
                file,
                self._arrays,
                header.poses,
                scene=header.scene,
                scene_sha256=header.scene_sha256,
                renderer=header.renderer,
            )
        self._arrays.clear()
        for waiting in self._files.values():
            waiting.unlink()


class TarArchive(Archive):
    """WebDataset: for each frame NNNNNN.OUTPUT.png of each output, and NNNNNN.json with its pose."""

    def __init__(self, path: Path, header: ArchiveHeader) -> None:
        self._header, self._done = header, 0
        self._tar = tarfile.open(path, "w")  # noqa: SIM115 (closed in close)

    def add(self, frames: Mapping[str, FrameArray]) -> None:
        header = self._header
        for place in range(len(frames[header.outputs[0]])):
            number = self._done
            for name in header.outputs:
                self._write(f"{number:06d}.{name}.png", encode_image(frames[name][place], Encoding.PNG).tobytes())
            document = {
                "pose": header.poses[number].tolist(),
                "scene": header.scene,
                "scene_sha256": header.scene_sha256,
                "renderer": header.renderer,
            }
            self._write(f"{number:06d}.json", json.dumps(document).encode())
            self._done += 1

    def _write(self, name: str, data: bytes) -> None:
        member = tarfile.TarInfo(name)
        member.size = len(data)
        self._tar.addfile(member, io.BytesIO(data))

    def close(self) -> None:
        self._tar.close()


ARCHIVES: dict[str, type[NpzArchive] | type[TarArchive]] = {"npz": NpzArchive, "tar": TarArchive}

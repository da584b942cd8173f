"""Archives that numpy, any reader of tar and the eye need nothing else for: .npz, WebDataset, a folder of PNGs."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from ultragray.exchange.exports.exporter import Exporter, ExportHeader
from ultragray.exchange.exports.formats import Writing
from ultragray.files import StreamedFile, atomic_path, npy_bytes
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.pixels import PixelArray, png_file
from ultragray.scene.confidence import Extrapolation


class NpzExporter(Exporter):
    """A writer of the first output into the archive as it comes; the others wait in files without a name beside it."""

    def _open(self) -> None:
        header = self._header
        self._file = self._stack.enter_context(StreamedFile(self._path))
        self._archive = self._stack.enter_context(zipfile.ZipFile(self._file, "w"))  # type: ignore[call-overload]
        first, *others = header.settings.outputs
        self._waiting: dict[str, IO[bytes]] = {
            name: self._stack.enter_context(tempfile.TemporaryFile(dir=self._path.parent))  # noqa: SIM115
            for name in others
        }
        self._first = self._stack.enter_context(self._member(first))
        self._files: dict[str, IO[bytes]] = {first: self._first, **self._waiting}
        for name, file in self._files.items():
            described = {"descr": header.pixel_type(name).str, "fortran_order": False, "shape": header.shape}
            np.lib.format.write_array_header_1_0(file, described)

    def _member(self, name: str) -> IO[bytes]:
        member: IO[bytes] = self._archive.open(f"{name}.npy", "w", force_zip64=True)
        return member

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for name, file in self._files.items():
            file.write(frames[name].data)

    def _finish(self) -> None:
        self._first.close()
        for name, file in self._waiting.items():
            file.seek(0)
            with self._member(name) as member:
                shutil.copyfileobj(file, member, 1 << 20)
        header = self._header
        origin = {name: one if isinstance(one, str) else json.dumps(one) for name, one in header.origin().items()}
        described = {"poses": np.asarray(header.poses, np.float64), **self._figures(), **origin}
        for name, value in described.items():
            with self._member(name) as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
        self._archive.close()
        self.sha256 = self._file.sha256


class TarExporter(Exporter):
    """A writer of 000012.OUTPUT.png (float32: .npy) for each output and 000012.json (pose, figures, origin)."""

    def _open(self) -> None:
        self._file = self._stack.enter_context(StreamedFile(self._path))
        self._tar = self._stack.enter_context(tarfile.TarFile(mode="w", fileobj=self._file))  # type: ignore[arg-type]

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for place in range(count):
            number = self._done + place
            for name in self._header.settings.outputs:
                frame = frames[name][place]
                is_grey = frame.dtype == np.uint8
                suffix, data = ("png", png_file(frame)) if is_grey else ("npy", npy_bytes(frame))
                self._member(f"{number:06d}.{name}.{suffix}", data)
            figures = self._extrapolations[number].figures()
            document = {"pose": self._header.poses[number].tolist(), **figures, **self._header.origin()}
            self._member(f"{number:06d}.json", json.dumps(document).encode())

    def _finish(self) -> None:
        self._tar.close()
        self.sha256 = self._file.sha256

    def _member(self, name: str, data: bytes) -> None:
        member = tarfile.TarInfo(name)
        member.size = len(data)
        self._tar.addfile(member, io.BytesIO(data))


FRAMES_FILE = "frames.json"


@contextmanager
def export_pngs(folder: Path, header: ExportHeader) -> Iterator[Writing]:
    """The writing of frame_00012_bmode.png and so on."""
    documents: list[dict[str, Any]] = []

    def add(frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        folder.mkdir(parents=True, exist_ok=True)  # only now: a mistake that the rendering finds leaves no folder
        for place, extrapolation in enumerate(extrapolations):
            number = len(documents)
            for name in header.settings.outputs:
                data = png_file(OUTPUTS[name].shares(frames[name][place]))
                (folder / f"frame_{number:05d}_{name}.png").write_bytes(data)
            documents.append({"frame": number, "pose": header.poses[number].tolist(), **extrapolation.figures()})

    yield Writing(add)
    with atomic_path(folder / FRAMES_FILE) as temporary:
        temporary.write_text(json.dumps(documents), encoding="utf-8")

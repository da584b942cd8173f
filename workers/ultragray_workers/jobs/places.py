"""The places of the files of jobs: an artifact folder, or a storage that several hosts share. Free of torch."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from ultragray_workers.claims import out_of_sight
from ultragray_workers.jobs.files import CHECKPOINT_NAME, Artifact, JobFiles, Log
from ultragray_workers.jobs.folder import JobFolder, Progress
from ultragray_workers.jobs.removal import locked
from ultragray_workers.jobs.requirements import keep_in_folder
from ultragray_workers.jobs.shared.files import SharedFiles
from ultragray_workers.scenes import SUFFIX
from ultragray_workers.storage.location import Location
from ultragray_workers.storage.opening import PATIENCE_S, open_storage
from ultragray_workers.storage.storage import Storage


class FolderFiles:
    """The folders of the jobs in an artifact folder."""

    def __init__(self, artifact_folder: Path) -> None:
        self._artifact_folder = artifact_folder

    def progress(self, job_id: str) -> Progress:
        """As `JobFiles`."""
        return self._folder(job_id).progress()

    def log(self, job_id: str) -> Log:
        """As `JobFiles`."""
        return self._folder(job_id).log

    def artifacts(self, job_id: str) -> dict[str, Artifact]:
        """As `JobFiles`."""
        found: dict[str, Artifact] = {}
        for folder in self._places(job_id):
            with contextlib.suppress(FileNotFoundError):
                found.update((path.name, path) for path in folder.iterdir() if path.is_file())
        return found

    def artifact(self, job_id: str, name: str) -> Artifact | None:
        """As `JobFiles`."""
        return next((path for folder in self._places(job_id) if (path := folder / name).is_file()), None)

    def text_of_run(self, job_id: str, name: str) -> str | None:
        """As `JobFiles`."""
        folder = self._folder(job_id)
        for place in (folder.artifacts, folder.run):
            with contextlib.suppress(FileNotFoundError):
                return (place / name).read_text(encoding="utf-8")
        return None

    @contextlib.contextmanager
    def checkpoint(self, job_id: str) -> Iterator[tuple[Path, str] | None]:
        """As `JobFiles`."""
        path = self._folder(job_id).run / CHECKPOINT_NAME
        try:
            version = str(path.stat().st_mtime_ns)
        except FileNotFoundError:
            yield None
        else:
            yield path, version

    @contextlib.contextmanager
    def kept_scene(self, job_id: str, scene: str) -> Iterator[Path | None]:
        """As `JobFiles`."""
        kept = self._folder(job_id).path / f"{scene}{SUFFIX}"
        yield kept if kept.is_file() else None

    def keep_scene(self, path: Path, scene: str, job_id: str) -> None:
        """As `JobFiles`."""
        keep_in_folder(path, scene, self._folder(job_id))

    @contextlib.contextmanager
    def removed(self, job_id: str) -> Iterator[None]:
        """As `JobFiles`."""
        folder = self._folder(job_id)
        with contextlib.ExitStack() as stack:
            if folder.path.is_dir():
                stack.enter_context(locked(folder))
            stack.enter_context(out_of_sight(folder.path))
            yield

    def _places(self, job_id: str) -> tuple[Path, ...]:
        folder = self._folder(job_id)
        return folder.artifacts, folder.batch

    def _folder(self, job_id: str) -> JobFolder:
        return JobFolder(self._artifact_folder, job_id)


def shared_storage(location: Location, *, patience_s: float = PATIENCE_S) -> Storage | None:
    """The storage that several hosts share; None where the location is a folder, whose files are used in place.

    `patience_s`: as `open_storage`, which also says what is raised.
    """
    return None if isinstance(location, Path) else open_storage(location, patience_s=patience_s)


def files_of_jobs(artifact_folder: Path, shared: Storage | None) -> JobFiles:
    """The files of the jobs of a storage that hosts share; None: of the artifact folder."""
    return FolderFiles(artifact_folder) if shared is None else SharedFiles(shared, artifact_folder)

"""The folder of a job after its process was killed."""

import os
from multiprocessing import get_context

from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.progress import Progress


def die_amid_the_work(path):
    """Writes as a job does, and ends as by SIGKILL: nothing that would follow is run."""
    folder = JobFolder(path, "one")
    folder.write_progress(Progress(step=3))
    (folder.path / ".progress.json.x.tmp").touch()
    with folder.new_artifacts() as artifacts, folder.scratch() as scratch:
        (artifacts / "half.png").touch()
        (scratch / "kept-for-a-moment.npz").touch()
        os._exit(9)


def test_nothing_half_done_of_a_killed_process_is_left(tmp_path):
    folder = JobFolder(tmp_path, "one")
    folder.path.mkdir(parents=True)
    process = get_context("fork").Process(target=die_amid_the_work, args=(tmp_path,))
    process.start()
    process.join()
    assert process.exitcode == 9
    left = sorted(path.name for path in folder.path.iterdir())
    assert len(left) == 4, left  # the test is about something
    folder.remove_leftovers()
    assert [path.name for path in folder.path.iterdir()] == ["progress.json"]
    assert folder.progress() == Progress(step=3)


def test_a_scratch_folder_begins_empty_and_goes(tmp_path):
    folder = JobFolder(tmp_path, "one")
    folder.path.mkdir(parents=True)
    with folder.scratch() as scratch:
        (scratch / "file").touch()
    scratch.mkdir()
    (scratch / "left").touch()  # by a process that was killed
    with folder.scratch() as again:
        assert again == scratch
        assert list(again.iterdir()) == []
    assert list(folder.path.iterdir()) == []

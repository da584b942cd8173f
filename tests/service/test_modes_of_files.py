"""Modes of the files that a service makes: for its own user alone."""

import stat


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_others_cannot_read_what_a_service_makes(start_service, tmp_path):
    start_service(artifact_folder=tmp_path / "new")
    assert mode(tmp_path / "new") == 0o700
    assert mode(tmp_path / "new" / "jobs.sqlite") == 0o600


def test_what_is_there_keeps_its_mode(start_service, tmp_path):
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o2770)
    (folder / "jobs.sqlite").touch()
    (folder / "jobs.sqlite").chmod(0o660)
    start_service(artifact_folder=folder)
    assert (mode(folder), mode(folder / "jobs.sqlite")) == (0o2770, 0o660)

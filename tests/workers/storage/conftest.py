"""A storage of each kind."""

import pytest

from ultragray_workers.storage.location import open_storage


@pytest.fixture
def nothing_left_behind():
    """Instead of the one for pools: there are none here, and obstore keeps its connections."""


@pytest.fixture(params=["folder", pytest.param("bucket", marks=pytest.mark.slow)])
def storage(request, tmp_path):
    """An empty storage: a folder, or a bucket of a real S3 server."""
    if request.param == "folder":
        return open_storage(tmp_path / "storage")
    return open_storage(request.getfixturevalue("new_bucket")(), patience_s=5)


@pytest.fixture
def bucket(new_bucket):
    """An empty bucket, whose requests are repeated for 2 s."""
    return open_storage(new_bucket(), patience_s=2)

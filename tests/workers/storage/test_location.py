"""Places of storages: what is taken, and the one sentence for what is not."""

from pathlib import Path

import pytest

from ultragray.errors import InvalidArgument
from ultragray_workers.storage.location import StorageUrl, parse_location


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("data", Path("data")),
        (Path("/srv/data"), Path("/srv/data")),
        ("file:///srv/a%20b", Path("/srv/a b")),
        ("s3://scenes", StorageUrl("s3", "scenes")),
        ("S3://scenes/of/us/", StorageUrl("s3", "scenes", "of/us")),
        ("gs://scenes/a", StorageUrl("gs", "scenes", "a")),
        ("az://container/a", StorageUrl("az", "container", "a")),
    ],
)
def test_paths_and_urls(given, found):
    assert parse_location(given, "data_folder") == found


def test_a_url_is_written_as_it_is_read():
    assert str(StorageUrl("s3", "scenes", "of/us")) == "s3://scenes/of/us"
    assert str(StorageUrl("s3", "scenes")) == "s3://scenes"
    assert str(StorageUrl("s3", "scenes").below("artifacts")) == "s3://scenes/artifacts"
    assert str(StorageUrl("s3", "scenes", "of").below("artifacts")) == "s3://scenes/of/artifacts"


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ("ftp://host/a", "data_folder must be a path, file:///FOLDER, s3://.*, got a URL with the scheme 'ftp'"),
        ("s3://", "must name a bucket, as s3://BUCKET/PREFIX"),
        ("s3:///prefix", "must name a bucket"),
        ("s3://key:secret@bucket", "must hold no credentials.*AWS_ACCESS_KEY_ID"),
        ("s3://bucket/a?versionId=3", "must have neither"),
        ("s3://bucket/../other", "must have a prefix of"),
        ("s3://bucket/a b", "must have a prefix of"),
        ("file://host/folder", "of this machine"),
        ("s3://[", "must be a path"),
    ],
)
def test_others_are_refused(given, sentence):
    with pytest.raises(InvalidArgument, match=sentence) as refused:
        parse_location(given, "data_folder")
    assert refused.value.field == "data_folder"
    assert "secret" not in refused.value.detail

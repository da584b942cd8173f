"""A bucket that fails: requests are repeated, and what cannot be told is a StorageUnavailable without secrets."""

import os
import sys

import pytest

from ultragray.errors import ExtraMissing
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.storage import remote
from ultragray_workers.storage.location import open_storage
from ultragray_workers.storage.storage import NotThere

from ...object_storage import Fault

LARGE = 17 * 2**20


@pytest.mark.parametrize("status", [500, 503, 429])
def test_refusals_of_a_moment_are_repeated(bucket, object_proxy, status):
    for _ in range(2):
        object_proxy.faults.append(Fault("answer", status=status))
    assert bucket.write("a", b"one", if_absent=True)
    object_proxy.faults.append(Fault("answer", status=status))
    assert bucket.read("a") == b"one"
    object_proxy.faults.append(Fault("answer", status=status))
    assert [entry.key for entry in bucket.entries()] == ["a"]
    assert not object_proxy.faults


def test_a_write_whose_answer_was_lost_counts_as_written(bucket, object_proxy):
    object_proxy.faults.append(Fault("lost_answer", "PUT"))
    assert bucket.write("a", b"one", if_absent=True)
    assert bucket.read("a") == b"one"


def test_a_torn_upload_is_repeated_and_never_half_there(new_bucket, object_proxy, tmp_path):
    content, bucket = os.urandom(LARGE), open_storage(new_bucket(), patience_s=60)
    (tmp_path / "large").write_bytes(content)
    object_proxy.faults += [
        Fault("cut_request", "PUT", bytes=2**20),
        Fault("answer", "PUT"),
        Fault("lost_answer", "PUT"),
    ]
    assert bucket.upload(tmp_path / "large", "large")
    assert not object_proxy.faults
    assert bucket.read("large") == content


def test_an_upload_that_fails_leaves_no_object(bucket, object_proxy, tmp_path):
    (tmp_path / "large").write_bytes(os.urandom(LARGE))
    object_proxy.faults += [Fault("answer", "PUT", status=403) for _ in range(9)]
    with pytest.raises(StorageUnavailable, match="answers 403"):
        bucket.upload(tmp_path / "large", "large")
    object_proxy.faults.clear()
    assert bucket.entry("large") is None


def test_a_torn_download_goes_on_where_it_was(bucket, object_proxy, tmp_path):
    content = os.urandom(LARGE)
    (tmp_path / "large").write_bytes(content)
    bucket.upload(tmp_path / "large", "large")
    object_proxy.requests.clear()
    object_proxy.faults += [Fault("cut_answer", "GET", bytes=9 * 2**20), Fault("cut_answer", "GET", bytes=2**20)]
    bucket.download("large", tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == content
    assert len(object_proxy.requests) == 3


def test_a_download_torn_after_all_patience_goes_on_as_long_as_bytes_come(new_bucket, object_proxy, tmp_path):
    content = os.urandom(LARGE)
    (tmp_path / "large").write_bytes(content)
    bucket = open_storage(new_bucket(), patience_s=0)  # a large object takes longer than any
    bucket.upload(tmp_path / "large", "large")
    object_proxy.faults += [Fault("cut_answer", "GET", bytes=9 * 2**20), Fault("cut_answer", "GET", bytes=2**20)]
    bucket.download("large", tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == content
    object_proxy.faults += [Fault("cut_answer", "GET", bytes=2**20), Fault("cut_answer", "GET", bytes=1)]
    with pytest.raises(StorageUnavailable):
        bucket.download("large", tmp_path / "torn")
    assert not (tmp_path / "torn").exists()


def test_a_server_that_is_silent_is_asked_again(new_bucket, object_proxy, monkeypatch):
    monkeypatch.setattr(remote, "_SILENCE_TIMEOUT_S", 1)
    storage = open_storage(new_bucket(), patience_s=60)
    storage.write("a", b"one")
    object_proxy.faults.append(Fault("silence", "GET"))
    object_proxy.requests.clear()
    assert storage.read("a") == b"one"
    assert len(object_proxy.requests) == 2


def test_a_server_that_is_away_is_a_retryable_error(new_bucket, object_proxy, tmp_path):
    bucket = open_storage(new_bucket(), patience_s=0.3)
    bucket.write("a", b"one")
    object_proxy.away = True
    (tmp_path / "file").write_bytes(b"x")
    for ask in (
        lambda: bucket.read("a"),
        lambda: bucket.entry("a"),
        lambda: bucket.write("b", b"two"),
        lambda: list(bucket.entries()),
        lambda: bucket.download("a", tmp_path / "copy"),
        lambda: bucket.upload(tmp_path / "file", "b"),
        lambda: bucket.delete("a"),
    ):
        with pytest.raises(StorageUnavailable) as told:
            ask()
        assert told.value.detail == f"{bucket.location} cannot be used: it does not answer"
    object_proxy.away = False
    assert bucket.read("a") == b"one"
    assert bucket.entry("b") is None


def test_a_bucket_that_is_not_there_is_no_missing_object(new_bucket):
    storage = open_storage("s3://no-such-bucket/a", patience_s=1)
    for ask in (lambda: storage.read("a"), lambda: list(storage.entries())):
        with pytest.raises(StorageUnavailable, match="s3://no-such-bucket/a cannot be used: there is no such bucket"):
            ask()


def test_an_object_that_is_replaced_during_a_download_is_not_mixed(bucket, object_proxy, tmp_path, monkeypatch):
    (tmp_path / "one").write_bytes(os.urandom(LARGE))
    bucket.upload(tmp_path / "one", "a")
    entry = bucket.entry("a")
    told = remote._entry

    def replace(found):  # once the download has begun
        bucket.write("a", b"other")
        return told(found)

    monkeypatch.setattr(remote, "_entry", replace)
    object_proxy.faults.append(Fault("cut_answer", "GET", bytes=9 * 2**20))
    with pytest.raises((StorageUnavailable, NotThere)):
        bucket.download("a", tmp_path / "copy", version=entry.version)
    assert not (tmp_path / "copy").exists()


def test_without_obstore_a_url_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(ExtraMissing, match=r"object storage \(s3://scenes\) needs obstore.*\[storage\]"):
        open_storage("s3://scenes")

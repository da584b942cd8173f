"""The cache of fetched objects: bounded, shared, never half, and never without what is in use."""

import hashlib
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from ultragray_workers.errors import StorageFull, StorageUnavailable
from ultragray_workers.storage import cache as cache_module
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Damaged, NotThere

from ...object_storage import Fault
from ...waiting import wait_until

SIZE = 1000


class SlowStorage(LocalStorage):
    """A folder of whose downloads each waits until the test lets it go."""

    def __init__(self, folder):
        super().__init__(folder)
        self.asked: list[str] = []
        self.go = threading.Event()

    def download(self, key, path, *, version=None):
        self.asked.append(key)
        if key.startswith("slow"):
            assert self.go.wait(300)
        return super().download(key, path, version=version)


@pytest.fixture
def cache(tmp_path):
    """Of room for three objects."""
    return Cache(tmp_path / "cache", 3 * SIZE, keep_s=0.0)


@pytest.fixture
def source(tmp_path):
    storage = SlowStorage(tmp_path / "source")
    for key in ("a", "b", "c", "d", "slow"):
        storage.write(key, key.encode() * (SIZE // len(key)))
    return storage


def fetch(cache, storage, key):
    entry = storage.entry(key)
    with cache.pin(storage, key, entry.version) as path:
        return path.read_bytes()


def test_an_object_is_fetched_once(cache, source):
    assert fetch(cache, source, "a") == fetch(cache, source, "a") == b"a" * SIZE
    assert source.asked == ["a"]
    counts = cache.counts
    assert (counts.hits, counts.misses, counts.fetched_bytes) == (1, 1, SIZE)
    again = Cache(cache.folder, cache.max_bytes)  # as after a restart, or of another process
    assert fetch(again, source, "a") == b"a" * SIZE
    assert source.asked == ["a"]


def test_many_that_ask_at_once_wait_for_one_fetch_and_others_do_not(cache, source):
    with ThreadPoolExecutor(8) as threads:
        asked = [threads.submit(fetch, cache, source, "slow") for _ in range(6)]
        wait_until(lambda: source.asked == ["slow"])
        assert fetch(cache, source, "a") == b"a" * SIZE
        assert not any(one.done() for one in asked)
        source.go.set()
        assert {one.result() for one in asked} == {b"slow" * (SIZE // 4)}
    assert source.asked == ["slow", "a"]


def test_the_least_recently_used_goes_and_the_bound_holds(cache, source):
    for key in ("a", "b", "c", "a", "d"):
        fetch(cache, source, key)
        time.sleep(0.01)
        assert cache.held_bytes() <= cache.max_bytes
    for key in ("a", "c", "d"):
        fetch(cache, source, key)
    assert source.asked == ["a", "b", "c", "d"]


def test_what_is_in_use_stays(cache, source, monkeypatch):
    monkeypatch.setattr(cache_module, "_WAIT_FOR_ROOM_S", 0.3)
    pins = []
    for key in ("a", "b", "c"):
        entry = source.entry(key)
        pins.append(cache.pin(source, key, entry.version))
    with pytest.raises(StorageFull, match=r"in use.*max_cache_bytes"):
        fetch(cache, source, "d")
    assert all(pin.path.stat().st_size == SIZE for pin in pins)
    pins[1].let_go()
    assert fetch(cache, source, "d") == b"d" * SIZE
    assert [pin.path.exists() for pin in pins] == [True, False, True]
    for pin in pins:
        pin.let_go()


def test_an_object_larger_than_the_cache_names_the_setting(source, tmp_path):
    with pytest.raises(StorageFull, match="1000 bytes does not fit the cache of 999: raise max_cache_bytes"):
        fetch(Cache(tmp_path / "small", SIZE - 1), source, "a")


def test_content_is_kept_by_its_hash_and_checked(cache, source):
    sha256 = hashlib.sha256(b"a" * SIZE).hexdigest()
    with cache.pin(source, "a", "any", sha256) as path:
        assert path.name == sha256
    source.delete("a")
    with cache.pin(source, "elsewhere", "any", sha256) as path:
        assert path.read_bytes() == b"a" * SIZE
    with pytest.raises(Damaged, match=r"b in .* is damaged: its SHA-256 is"):
        cache.pin(source, "b", "any", "0" * 64)
    assert [path.name for path in (cache.folder / "files").iterdir()] == [sha256]


def test_a_version_that_has_gone_is_not_there(cache, source):
    for key, version in (("a", "old"), ("absent", "any")):
        with pytest.raises(NotThere):
            cache.pin(source, key, version)
    assert cache.held_bytes() == 0


DIES = """
import os, sys
from pathlib import Path
from ultragray.files import atomic_path
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.local import LocalStorage

class Deadly(LocalStorage):
    def download(self, key, path, *, version=None):
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half")
            os._exit(7)

storage = Deadly(Path(sys.argv[2]))
Cache(Path(sys.argv[1]), 3000, 0.0).pin(storage, "a", storage.entry("a").version)
"""


def test_a_process_that_dies_while_it_fetches_leaves_nothing_that_stays(cache, source):
    assert subprocess.run([sys.executable, "-c", DIES, cache.folder, source.folder], timeout=300).returncode == 7
    assert cache.held_bytes() == SIZE  # its space
    for key in ("b", "c", "d", "a"):
        assert fetch(cache, source, key) == key.encode() * SIZE
        assert cache.held_bytes() <= cache.max_bytes
    assert not [path for path in (cache.folder / "files").iterdir() if path.name.startswith(".")]
    assert not list((cache.folder / "fetching").iterdir())


FETCHES = """
import sys
from pathlib import Path
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.local import LocalStorage

cache, storage = Cache(Path(sys.argv[1]), 3000, 0.0), LocalStorage(Path(sys.argv[2]))
for number in range(100):
    key = "abcd"[(int(sys.argv[3]) + number) % 4]
    with cache.pin(storage, key, storage.entry(key).version) as path:
        assert path.read_bytes() == key.encode() * 1000
"""


def test_several_processes_share_the_bound(cache, source):
    processes = [
        subprocess.Popen([sys.executable, "-c", FETCHES, cache.folder, source.folder, str(first)]) for first in range(3)
    ]
    most, is_over = 0, False
    while not is_over:
        is_over = all(process.poll() is not None for process in processes)
        most = max(most, cache.held_bytes())
        time.sleep(0.001)
    assert [process.returncode for process in processes] == [0, 0, 0]
    assert 0 < most <= cache.max_bytes


@pytest.fixture
def bucket_of_one(bucket):
    bucket.write("a", b"a" * SIZE)
    return bucket


@pytest.mark.slow
def test_what_is_cached_is_there_without_the_bucket(cache, bucket_of_one, object_proxy):
    entry = bucket_of_one.entry("a")
    object_proxy.faults.append(Fault("cut_answer", "GET", bytes=300))
    with cache.pin(bucket_of_one, "a", entry.version) as path:
        assert path.read_bytes() == b"a" * SIZE
    object_proxy.away = True
    with cache.pin(bucket_of_one, "a", entry.version) as path:
        assert path.read_bytes() == b"a" * SIZE
    with pytest.raises(StorageUnavailable):
        cache.pin(bucket_of_one, "b", "any")

"""Clients of all kinds at all doors for a long time, while processes are killed and scenes change under them.

Nothing fails but what is made to fail, every frame is the right one, and no process takes more memory or descriptors at
the end than after it has warmed up.
"""

import contextlib
import json
import os
import random
import signal
import threading
import time
from collections import Counter

import httpx
import pytest

from ultragray.datasets import Dataset
from ultragray.datasets.released import write_released
from ultragray.files import file_sha256
from ultragray_studies.bench.report import measured

from ..model.learn.conftest import make_tiny_dataset
from ..processes import Growth, by_role, family
from ..service.conftest import service_starter
from ..service.igtl.conftest import address_of
from ..surroundings import ROOT
from ..waiting import wait_until
from .place import STEADY, Place, frames_of, make_scenes
from .visitors import VISITORS

pytestmark = pytest.mark.long

SECONDS = float(os.environ.get("ULTRAGRAY_SOAK_SECONDS", "30"))
RECORD = os.environ.get("ULTRAGRAY_SOAK_RECORD")
LONG_S = 900.0  # a shorter run is mostly warm-up
MOST_GROWTH, MOST_GROWTH_OF_A_SHORT_RUN = 0.02, 0.25
MOST_NEW_DESCRIPTORS = 4  # connections and frames under way
SIXTHS = 6  # the first is warm-up; the second is compared with the last
SAMPLE_EVERY_S = 1.0
RENDER_KILL_EVERY_S, JOB_KILL_EVERY_S = 10.0, 120.0
END_WITHIN_S = 300.0
RENDERER, JOB_WORKER = "ug-worker", "ultragray_service.cli.worker"
LASTING = (RENDERER, JOB_WORKER, "ug-template", "ultragray_service")  # roles; other processes come and go


class Soak:
    """The threads of one run: visitors, the killer, the sampler; and what they saw."""

    def __init__(self, place):
        self._place = place
        self.visits = Counter()
        self.errors = []
        self.kills = Counter()
        self.samples = []

    def run(self, seconds):
        threads = [threading.Thread(target=self._visit, args=item, name=item[0]) for item in VISITORS.items()]
        threads += [threading.Thread(target=target) for target in (self._kill, self._sample)]
        for thread in threads:
            thread.start()
        self._place.over.wait(seconds)
        self._place.over.set()
        for thread in threads:
            thread.join(END_WITHIN_S)
            assert not thread.is_alive(), f"{thread.name} does not end"

    def _visit(self, name, visit):
        while not self._place.over.is_set():
            try:
                visit(self._place)
                self.visits[name] += 1
            except Exception as error:
                self.errors.append(f"{name}: {type(error).__name__}: {error}"[:1000])
                if len(self.errors) > 50:
                    self._place.over.set()

    def _kill(self):
        """Render processes, and now and then the worker for jobs."""
        next_job_kill = time.monotonic() + JOB_KILL_EVERY_S
        while not self._place.over.wait(RENDER_KILL_EVERY_S):
            role = RENDERER
            if time.monotonic() > next_job_kill:
                role, next_job_kill = JOB_WORKER, time.monotonic() + JOB_KILL_EVERY_S
            found = [pid for pid, taken in family(self._place.service.process.pid).items() if taken.role == role]
            if found:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(random.choice(found), signal.SIGKILL)
                    self.kills[role] += 1

    def _sample(self):
        while not self._place.over.wait(SAMPLE_EVERY_S):
            self.samples.append(family(self._place.service.process.pid))

    def growth(self):
        """By role and by what is taken."""
        series = by_role(self.samples)
        return {
            role: {what: Growth.of([one[what] for one in series[role]], parts=SIXTHS) for what in series[role][0]}
            for role in LASTING
        }


@pytest.fixture
def place(tmp_path, tmp_path_factory):
    data, versions = tmp_path / "data", tmp_path / "versions"
    data.mkdir()
    versions.mkdir()
    made = make_scenes(data, versions)
    tiny = make_tiny_dataset()
    write_released(Dataset("tiny", tiny.train, tiny.val), tmp_path / "tiny")
    steady = data / f"{STEADY}.ugr"
    starter = service_starter(tmp_path_factory, data)
    service = next(starter)(
        cold=True, data_folder=data, artifact_folder=tmp_path / "artifacts", igtl_port=0, embedded_worker=True
    )
    wait_until(lambda: httpx.get(f"{service.http}/v1/workers").json()["workers"])  # started whole: it is measured
    yield Place(
        service,
        address_of(service),
        tmp_path / "tiny",
        made,
        file_sha256(steady),
        {file_sha256(path): frames_of(path) for path in (steady, *made)},
    )
    starter.close()


def test_all_kinds_of_clients_for_a_long_time(place):
    soak = Soak(place)
    soak.run(SECONDS)
    growth = soak.growth()
    if RECORD:
        (ROOT / RECORD).write_text(json.dumps(record_of(soak, growth), indent=1) + "\n")
    assert not soak.errors, soak.errors[:10]
    assert all(soak.visits[name] for name in VISITORS), soak.visits
    assert_log_is_clean(place.service)
    for role, of in growth.items():
        most = MOST_GROWTH if SECONDS >= LONG_S else MOST_GROWTH_OF_A_SHORT_RUN
        assert of["resident_bytes"].share <= most, (role, of["resident_bytes"])
        assert of["descriptors"].absolute <= max(MOST_NEW_DESCRIPTORS, most * of["descriptors"].earlier), (role, of)


def assert_log_is_clean(service):
    said = service.log_path.read_text()
    assert "Traceback" not in said, said[max(0, said.index("Traceback") - 1000) :][:4000]


def record_of(soak, growth):
    """What the file of the run says."""
    return {
        "measured": measured(os.cpu_count() or 1),
        "seconds": round(SECONDS),
        "visits": dict(sorted(soak.visits.items())),
        "kills": dict(soak.kills),
        "errors": soak.errors,
        "growth": {
            role: {
                what: {"earlier": one.earlier, "last": one.last, "share": round(one.share, 4)}
                for what, one in of.items()
            }
            for role, of in sorted(growth.items())
        },
    }

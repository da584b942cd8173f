"""The service that is fuzzed: what it may answer, what it may log, what it may take."""

import threading

import grpc
import numpy as np

from ultragray_client import Client, RenderSettings

from ..processes import Growth, family
from ..waiting import at_this_load, wait_until

CONTROL_SCENE = "control"  # which no input names
SAMPLE_EVERY_S = 0.5
SETTLE_S = 20.0
MOST_GROWTH_BYTES = 48 * 2**20  # of a process, between the second fifth of a run and its last
MOST_NEW_DESCRIPTORS = 8
EXPECTED_5XX = {501, 503, 504, 507}  # documented: what this machine lacks, what comes too late, what has no room
UNEXPECTED_REASONS = {"INTERNAL", "RENDER_FAILED"}
EXPECTED_CODES = {  # gRPC's of a service that is well; INTERNAL, UNKNOWN, UNAVAILABLE are none
    *(grpc.StatusCode.OK, grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND, grpc.StatusCode.ALREADY_EXISTS),
    *(grpc.StatusCode.FAILED_PRECONDITION, grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.DEADLINE_EXCEEDED),
    *(grpc.StatusCode.UNIMPLEMENTED, grpc.StatusCode.OUT_OF_RANGE, grpc.StatusCode.PERMISSION_DENIED),
}


class FuzzedService:
    """A service of a folder, started again where an input ended it, so that the next one finds it alive."""

    def __init__(self, start, data_folder, artifact_folder):
        self._start = lambda: start(
            cold=True,
            data_folder=data_folder,
            artifact_folder=artifact_folder,
            igtl_port=0,
            igtl_scene="demo",
            max_image_side=128,
            max_request_pixels=2**20,
            max_dataset_bytes=2**24,
            job_queue_limit=20,
            default_timeout_s=10,
        )
        self.running = self._start()
        self._whole_logs = []
        self._samples = []
        self._over = threading.Event()
        self._sampler = threading.Thread(target=self._sample, daemon=True)
        self._frame = self._render()
        self._sampler.start()

    @property
    def address(self):
        """Of HTTP."""
        host, _, port = self.running.http.removeprefix("http://").rpartition(":")
        return host, int(port)

    def igtl(self):
        host, _, port = next(str(record["igtl"]) for record in self.running.log() if "igtl" in record).rpartition(":")
        return host, int(port)

    def require_alive(self):
        """Starts it again and raises AssertionError where an input has ended it."""
        if self.running.process.poll() is None:
            return
        status, said = self.running.process.returncode, self.running.log_path.read_text()
        self.running = self._start()
        self._samples.clear()
        raise AssertionError(f"the service has ended with status {status}: {said[-4000:]}")

    def check(self):
        """Asserts that it is as well as at the beginning."""
        self.require_alive()
        assert np.array_equal(self._render(), self._frame), "the frame at the end is not the one of the beginning"
        said = self.running.log_path.read_text()
        assert "Traceback" not in said, said[max(0, said.index("Traceback") - 2000) :][:6000]
        errors = [record for record in self.running.log() if record["level"] == "error"]
        assert not errors, errors[:3]
        wait_until(self._has_settled, within_s=at_this_load(SETTLE_S), every_s=SAMPLE_EVERY_S)
        self._check_memory()

    def end(self):
        self._over.set()
        self._sampler.join()

    def _sample(self):
        self._samples.append(family(self.running.process.pid))  # a short test needs one, too
        while not self._over.wait(SAMPLE_EVERY_S):
            self._samples.append(family(self.running.process.pid))

    def _has_settled(self):
        """Whether no more descriptors are open than at the beginning."""
        first, last = self._samples[0], self._samples[-1]
        return all(
            taken.descriptors <= first[pid].descriptors + MOST_NEW_DESCRIPTORS
            for pid, taken in last.items()
            if pid in first
        )

    def _check_memory(self):
        samples = list(self._samples)
        for pid in samples[0].keys() & samples[-1].keys():  # not the helpers of uploads, which come and go
            growth = Growth.of([sample[pid].resident_bytes for sample in samples if pid in sample], parts=5)
            name, grown_mib = samples[-1][pid].role, growth.absolute / 2**20
            assert growth.absolute < MOST_GROWTH_BYTES, f"{name} has grown by {grown_mib:.0f} MiB"

    def _render(self):
        with Client(self.running.grpc) as client:
            pose = np.eye(4)
            frame = client.render(CONTROL_SCENE, pose, RenderSettings(height=64, width=48))["bmode"]
            return np.array(frame)

"""A real service in a process of its own, on free ports."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import grpc
import httpx
import numpy as np
import pytest
import torch
from websockets.sync.client import connect

from ultragray import GaussianScene, LinearProbe, SceneInfo
from ultragray_client import Client
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc, scenes_pb2_grpc

from ..waiting import Deadline, wait_until
from ..warm import SHORT_WAITS, SOURCE_FOLDERS, WARM, WarmProcess, fork, pool_processes

ROOT = Path(__file__).resolve().parents[2]
START_TIMEOUT_S = 300.0
STOP_TIMEOUT_S = 300.0

connect.__kwdefaults__.update(open_timeout=STOP_TIMEOUT_S, ping_timeout=STOP_TIMEOUT_S)  # others may keep it busy

HEIGHT, WIDTH = 64, 48  # of the training images of the test scene
_numbers = itertools.count()  # of services


class RunningService:
    """The service in a process of its own, and the addresses it told in its log; ended with the `with` block."""

    process: WarmProcess | subprocess.Popen[bytes]

    def __init__(self, data_folder, log_path, environment, *, cold=False):
        """`cold` starts `python -m ultragray_service`; else it is forked from a process with the imports done."""
        self.data_folder = data_folder
        self.key = environment.get("ULTRAGRAY_API_KEYS", "").partition(",")[0] or None
        self._run = f"{os.environ['PYTEST_RUN']}-{next(_numbers)}"
        self.log_path = log_path
        settings = {
            "ULTRAGRAY_DATA_FOLDER": str(data_folder),
            "ULTRAGRAY_HTTP_PORT": "0",
            "ULTRAGRAY_GRPC_PORT": "0",
            "ULTRAGRAY_THREADS_PER_PROCESS": "1",
            "ULTRAGRAY_EMBEDDED_WORKER": "false",
            "ULTRAGRAY_JOB_NICE": "0",  # no frames wait for the processors
            "ULTRAGRAY_DEFAULT_TIMEOUT_S": "600",  # others may keep the machine busy
            "ULTRAGRAY_MAX_QUEUE_MS": "600000",
            "ULTRAGRAY_WORKER_GRACE_S": "600",
            "PYTEST_RUN": self._run,
            "PYTEST_WAITS": json.dumps(SHORT_WAITS),
            "PYTHONPATH": os.pathsep.join(str(ROOT / folder) for folder in SOURCE_FOLDERS),
        }
        whole = {**os.environ, **settings, **environment}
        folder = log_path.parent
        with log_path.open("wb") as log, Path(os.devnull).open("rb") as nothing:
            if cold:
                command = [sys.executable, "-m", "ultragray_service"]
                self.process = subprocess.Popen(command, env=whole, stdin=nothing, stderr=log, cwd=folder)
            else:
                path, files = str(WARM.path()), (nothing.fileno(), log.fileno(), log.fileno())
                self.process = fork(path, "service", [path], environment=whole, folder=folder, files=files)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.terminate()

    def log(self):
        whole = self.log_path.read_text().rpartition("\n")[0]  # the last line may be half written
        return [json.loads(line) for line in whole.split("\n") if line.startswith("{")]

    def logged(self, *words):
        """Whether one line of the log has all these words."""
        return any(all(word in record["message"] for word in words) for record in self.log())

    def wait_until_serving(self):
        end = Deadline(START_TIMEOUT_S)
        while not end.passed:
            for record in self.log():
                if "grpc" in record:
                    self.http, self.grpc = record["http"], record["grpc"]
                    return
            assert self.process.poll() is None, self.log_path.read_text()
            time.sleep(0.05)
        raise AssertionError(f"not serving after {START_TIMEOUT_S} s: {self.log_path.read_text()}")

    def terminate(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise

    def metric(self, *names):
        """The sum of all lines of /metrics, at one moment, that begin with one of the names."""
        lines = httpx.get(f"{self.http}/metrics", timeout=300).text.splitlines()
        return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith(names))

    def poses_from(self, port):
        """How many have come over the stream of a client at a port of this machine."""
        streams = httpx.get(f"{self.http}/v1/streams", timeout=300).json()["streams"]
        return next((one["poses"] for one in streams if one["client"].endswith(f":{port}")), 0)

    def wait_until_idle(self):
        """Returns once nothing is left of what the tests before asked for."""
        wait_until(lambda: self.metric("ultragray_waiting_frames ", "ultragray_busy_processes ") == 0)

    def stream_url(self, scene="demo"):
        """The WebSocket of a scene."""
        return f"{self.http.replace('http', 'ws', 1)}/v1/scenes/{scene}/stream"

    @contextmanager
    def without_rendering(self):
        """Whatever is asked for waits until this context ends: the processes that render are stopped."""
        workers = [pid for pid, name in pool_processes(self._run).items() if name == "ug-worker"]
        assert workers
        for pid in workers:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for pid in workers:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)

    def resident_bytes(self):
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")

    def channel(self):
        return grpc.insecure_channel(self.grpc, options=[("grpc.max_receive_message_length", -1)])


def split(message):
    """What a WebSocket's frame tells about itself, and its pixels."""
    assert isinstance(message, bytes), message
    end = 4 + int.from_bytes(message[:4], "little")
    return json.loads(message[4:end]), message[end:]


def make_scene(gaussians=400, *, probe=None, seed=0):
    """A cloud about the image plane, centred 20 mm deep, with five training poses 1 mm apart along y."""
    rng = np.random.default_rng(seed)

    def tensor(values):
        return torch.tensor(values, dtype=torch.float32)

    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 1, 3] = np.arange(5.0)
    return GaussianScene.from_splats(
        {
            "means": tensor(rng.uniform(-2, 2, (gaussians, 3)) * [1, 0.1, 1]),
            "scales": tensor(rng.normal(-2.0, 0.3, (gaussians, 3))),
            "quats": tensor(rng.normal(size=(gaussians, 4))),
            "transmittances": tensor(rng.normal(4, 1, gaussians)),
            "sh0": tensor(rng.normal(1.0, 1.0, (gaussians, 1, 1))),
        },
        info=SceneInfo(
            centre_mm=(0, 0, 20),
            probe=probe,
            image_height=HEIGHT,
            image_width=WIDTH,
            metrics={"psnr": 20.5},
            dataset_name="synthetic",
        ),
        training_poses=poses,
    )


DEMO_PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)


@pytest.fixture(scope="session")
def demo_scene():
    return make_scene(probe=DEMO_PROBE)


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory, demo_scene):
    """Two scenes that render, one that needs a probe to be named, and three files that are no scenes."""
    folder = tmp_path_factory.mktemp("data")
    demo_scene.save(folder / "demo.ugr")
    make_scene(seed=1, probe=DEMO_PROBE).save(folder / "second.ugr")
    make_scene(20).save(folder / "probeless.ugr")
    whole = (folder / "demo.ugr").read_bytes()
    (folder / "truncated.ugr").write_bytes(whole[: len(whole) // 2])
    (folder / "foreign.ugr").write_bytes(b"\x89PNG not a scene")
    (folder / "empty.ugr").write_bytes(b"")
    return folder


def service_starter(tmp_path_factory, data_folder, common_waits=SHORT_WAITS):
    """Starts services with settings as keywords: `start_service(max_image_side=128)`; all are stopped at the end."""
    with ExitStack() as started:

        def start(*, wait=True, cold=False, waits=None, **settings):
            environment = {f"ULTRAGRAY_{name.upper()}": str(value) for name, value in settings.items()}
            environment["PYTEST_WAITS"] = json.dumps({**common_waits, **(waits or {})})
            log_path = tmp_path_factory.mktemp("service") / "log"
            service = started.enter_context(RunningService(data_folder, log_path, environment, cold=cold))
            if wait:
                service.wait_until_serving()
            return service

        yield start


@pytest.fixture(scope="module")
def start_service(tmp_path_factory, data_folder):
    """Starts services that live until the module ends."""
    yield from service_starter(tmp_path_factory, data_folder)


@pytest.fixture(scope="session")
def start_shared_service(tmp_path_factory, data_folder):
    """Starts services that live until all tests have ended: for those that tests only read from."""
    yield from service_starter(tmp_path_factory, data_folder, common_waits={})


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory):
    """An empty artifact folder of the module."""
    return tmp_path_factory.mktemp("artifacts")


@pytest.fixture(scope="session")
def service(start_shared_service):
    """The service that most tests share."""
    return start_shared_service(
        max_image_side=600, max_poses_per_request=40, queue_limit_frames=64, max_request_pixels=4_000_000
    )


# Those who ask the service of a module: the one that most tests share, or its own of the name.


@pytest.fixture(scope="module")
def http(service):
    headers = {} if service.key is None else {"X-API-Key": service.key}
    with httpx.Client(base_url=service.http, headers=headers, timeout=300) as client:
        yield client


@pytest.fixture(scope="module")
def client(service):
    with Client(service.grpc, api_key=service.key, timeout_s=300.0) as client:
        yield client


@pytest.fixture(scope="module")
def channel(service):
    with service.channel() as channel:
        yield channel


@pytest.fixture(scope="module")
def renders(channel):
    return rendering_pb2_grpc.RenderServiceStub(channel)


@pytest.fixture(scope="module")
def scenes(channel):
    return scenes_pb2_grpc.SceneServiceStub(channel)


@pytest.fixture
def pose_body():
    """The identity 1 mm off centre, as HTTP takes it."""
    return {"position_mm": {"x": 1.0, "y": 0.0, "z": 0.0}, "quaternion": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}


@pytest.fixture
def pose_matrix():
    """The same pose, [4, 4] mm."""
    matrix = np.eye(4)
    matrix[0, 3] = 1.0
    return matrix


@pytest.fixture
def pose_message():
    """The same pose, as gRPC takes it."""
    return geometry_pb2.Pose(
        placement=geometry_pb2.Placement(
            position_mm=geometry_pb2.Position(x=1.0), quaternion=geometry_pb2.Quaternion(w=1.0)
        )
    )


@pytest.fixture
def settings_message():
    return rendering_pb2.RenderSettings(scene="demo")


@pytest.fixture
def scene_file(tmp_path, random_scene, random_poses):
    """Sixty Gaussians and five training poses."""
    info = {
        "centre_mm": (1.0, 2.0, 3.0),
        "probe": LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0),
        "image_height": 24,
        "image_width": 20,
    }
    made = random_scene(60, info=info)
    path = tmp_path / "scene.ugr"
    GaussianScene.from_splats(made.splats, info=made.info, training_poses=random_poses(5)).save(path)
    return path


@pytest.fixture
def pose_file(tmp_path, random_poses):
    path = tmp_path / "poses.npy"
    np.save(path, random_poses(7, seed=3))
    return path

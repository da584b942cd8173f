"""Every method of gRPC: messages made from the descriptors, messages nearly right, and bytes that are no messages."""

import pkgutil
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import grpc
import pytest
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from hypothesis import strategies as st

from ultragray_proto import v1
from ultragray_proto.v1 import datasets_pb2, geometry_pb2, jobs_pb2, rendering_pb2, scenes_pb2, workers_pb2

from .fuzzed import EXPECTED_CODES, UNEXPECTED_REASONS
from .grpc_messages import messages, near
from .mutations import mutated_bytes

pytestmark = pytest.mark.long

TIMEOUT_S = 20.0
MOST_MESSAGES = 6  # of a client that streams
ENDLESS = {"WatchJob"}  # of a job that waits; not asked for long
ENDLESS_TIMEOUT_S = 0.2
POSE = geometry_pb2.Pose(
    placement=geometry_pb2.Placement(
        position_mm=geometry_pb2.Position(x=1.0), quaternion=geometry_pb2.Quaternion(w=1.0)
    )
)
MATRIX = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]))
SETTINGS = rendering_pb2.RenderSettings(
    scene="demo",
    height=16,
    width=12,
    outputs=[rendering_pb2.OUTPUT_BMODE],
    probe=geometry_pb2.Probe(linear=geometry_pb2.LinearProbe(width_mm=40, far_mm=40)),
    display=rendering_pb2.Display(gain_db=3, dynamic_range_db=50, tgc_db=[0, 3], depth_mm=30, pixel_mm=1),
)
SHARED = rendering_pb2.SharedMemory(name=f"ultragray-{'f' * 32}", token=bytes(range(32)), slots=2, slot_bytes=4096)
SHARED_FILE = Path("/dev/shm", SHARED.name)
VALID = (
    rendering_pb2.RenderRequest(settings=SETTINGS, pose=POSE),
    rendering_pb2.RenderBatchRequest(settings=SETTINGS, poses=[POSE, MATRIX]),
    rendering_pb2.RenderStreamRequest(sequence=1, settings=SETTINGS, pose=POSE, timeout_ms=5000, client_time_ns=7),
    rendering_pb2.RenderStreamRequest(sequence=2, settings=SETTINGS, pose=POSE, shared_memory=SHARED),
    scenes_pb2.GetSceneRequest(scene="demo"),
    scenes_pb2.LoadSceneRequest(scene="demo"),
    scenes_pb2.ListScenesRequest(page_size=2),
    jobs_pb2.ListJobsRequest(page_size=3, kind=jobs_pb2.JOB_KIND_RENDER),
    jobs_pb2.SubmitJobRequest(
        render=jobs_pb2.RenderJob(
            scene="demo", sampler=jobs_pb2.PoseSampler(kind="around", count=2), height=16, width=12
        ),
        request_id="fuzzed",
        priority=3,
    ),
    jobs_pb2.SubmitJobRequest(train=jobs_pb2.TrainJob(dataset="absent", scene="new", preset="fast")),
    jobs_pb2.SubmitJobRequest(compare=jobs_pb2.CompareJob(dataset="absent", methods=["median"], times=2.0, seed=1)),
    jobs_pb2.SubmitJobRequest(evaluate=jobs_pb2.EvaluateJob(dataset="absent", scene="demo")),
    workers_pb2.PauseWorkerRequest(worker="absent-0"),
    datasets_pb2.UploadDatasetRequest(header=datasets_pb2.UploadHeader(dataset="new", archive=True)),
)


@dataclass(frozen=True)
class Method:
    """A method of a service, called with messages as bytes."""

    path: str
    takes: type[Message]
    client_streams: bool
    server_streams: bool

    def call(self, channel, requests):
        """The answers. Raises grpc.RpcError."""
        name = self.path.rpartition("/")[2]
        timeout_s = ENDLESS_TIMEOUT_S if name in ENDLESS else TIMEOUT_S
        request = iter(requests) if self.client_streams else requests[0]
        kind = f"{'stream' if self.client_streams else 'unary'}_{'stream' if self.server_streams else 'unary'}"
        answer = getattr(channel, kind)(self.path)(request, timeout=timeout_s)
        return list(answer) if self.server_streams else [answer]


def all_methods():
    modules = [name for _, name, _ in pkgutil.iter_modules(v1.__path__) if name.endswith("_pb2")]
    services = (
        service
        for module in modules
        for service in import_module(f"{v1.__name__}.{module}").DESCRIPTOR.services_by_name.values()
    )
    return [
        Method(
            f"/{service.full_name}/{method.name}",
            GetMessageClass(method.input_type),
            method.client_streaming,
            method.server_streaming,
        )
        for service in services
        for method in service.methods
    ]


METHODS = all_methods()
RENDERING = [method for method in METHODS if "RenderService" in method.path]


@pytest.fixture(autouse=True)
def no_file_stays():
    yield
    SHARED_FILE.unlink(missing_ok=True)


def offer_shared_file():
    """Makes the file that SHARED tells of, which a service that takes it removes."""
    if not SHARED_FILE.exists():
        SHARED_FILE.touch(0o600)
        SHARED_FILE.write_bytes(
            (SHARED.token + b"\1" * SHARED.slots).ljust(4096 + SHARED.slots * SHARED.slot_bytes, b"\0")
        )


@pytest.fixture
def channel(well):
    options = [("grpc.max_receive_message_length", -1), ("grpc.initial_reconnect_backoff_ms", 100)]
    with grpc.insecure_channel(well.running.grpc, options=options) as opened:
        yield opened


def calls(of):
    """A method, and the messages it is called with, whose strategy `of` gives by the method."""
    methods = st.sampled_from([*METHODS, *RENDERING * 4])

    def with_messages(method):
        one = of(method)
        several = st.lists(one, min_size=1, max_size=MOST_MESSAGES if method.client_streams else 1)
        return st.tuples(st.just(method), several)

    return methods.flatmap(with_messages)


def asked(well, channel, method, requests):
    well.require_alive()
    if method.path.endswith("RenderStream"):
        offer_shared_file()
    answers = []
    told = "OK"
    try:
        answers = method.call(channel, requests)
        code = grpc.StatusCode.OK
    except grpc.RpcError as error:
        code, told = error.code(), error.details()
    assert code in EXPECTED_CODES, f"{method.path}: {code}: {told}"
    if method.path.endswith("RenderStream"):
        reasons = {rendering_pb2.Frame.FromString(answer).error.reason for answer in answers}
        assert not reasons & UNEXPECTED_REASONS, reasons


def test_messages_of_the_descriptors(door, well, channel):
    def of(method):
        known = [near(message) for message in VALID if isinstance(message, method.takes)]
        return st.one_of(*known, *known, messages(method.takes.DESCRIPTOR)).map(lambda made: made.SerializeToString())

    door("grpc messages").enter(calls(of), lambda call: asked(well, channel, *call))


def test_bytes(door, well, channel):
    def of(method):
        valid = [message.SerializeToString() for message in VALID if isinstance(message, method.takes)]
        return mutated_bytes(valid or [message.SerializeToString() for message in VALID])

    door("grpc bytes").enter(calls(of), lambda call: asked(well, channel, *call))

import threading

import grpc
import pytest

from ultragray.datasets.source import UPLOAD_OPTIONS
from ultragray_proto.v1 import datasets_pb2, datasets_pb2_grpc

from ...waiting import wait_until
from ..http.test_http_datasets import KEY, LIMIT_BYTES, poisoned_files, released_files, uploads_under_way
from .test_grpc_render import error_info

METADATA = (("x-api-key", KEY),)
Message = datasets_pb2.UploadDatasetRequest


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(
        artifact_folder=artifacts, max_dataset_bytes=LIMIT_BYTES, upload_idle_timeout_s=3600.0, api_keys=KEY
    )


@pytest.fixture(scope="module")
def datasets(channel):
    return datasets_pb2_grpc.DatasetServiceStub(channel)


@pytest.fixture
def files(tmp_path):
    return released_files(tmp_path / "tiny")


@pytest.fixture(autouse=True)
def _nothing_is_left(artifacts):
    yield
    wait_until(lambda: not uploads_under_way(artifacts))


def header(name, *, archive=False, **options):
    return Message(
        header=datasets_pb2.UploadHeader(dataset=name, archive=archive, options=datasets_pb2.DatasetOptions(**options))
    )


def parts(files, chunk_bytes=1000):
    for name, content in files.items():
        yield Message(file=name)
        for start in range(0, len(content), chunk_bytes):
            yield Message(chunk=content[start : start + chunk_bytes])


def upload(stub, *messages):
    return stub.UploadDataset(iter(messages), metadata=METADATA, timeout=300)


def refusal(call, *arguments, **keywords):
    with pytest.raises(grpc.RpcError) as caught:
        call(*arguments, **keywords)
    return caught.value.code(), error_info(caught.value)[0].reason, caught.value.details()


def test_what_is_refused(datasets, files):
    invalid = grpc.StatusCode.INVALID_ARGUMENT
    large = [Message(chunk=b"\0" * 100_000)] * 3
    for messages, reason, detail in (
        ([header("bad"), *parts(poisoned_files(files))], "DATASET_INVALID", "poses_train.npy: frame 5: its pose"),
        ([header("bad", archive=True), *large], "UPLOAD_TOO_LARGE", str(LIMIT_BYTES)),
        ([header("bad"), Message(file="../evil")], "DATASET_INVALID", "plain paths"),
        ([header("bad"), Message(chunk=b"1")], "DATASET_INVALID", "name a file before its bytes"),
        ([header("bad", archive=True), Message(file="a")], "INVALID_ARGUMENT", "must hold chunk"),
        ([header("bad"), header("bad")], "INVALID_ARGUMENT", "got header"),
        ([header("a/b")], "INVALID_ARGUMENT", "dataset must be"),
        ([Message(chunk=b"1")], "INVALID_ARGUMENT", "first message"),
        ([], "INVALID_ARGUMENT", "first message"),
    ):
        code, found, details = refusal(upload, datasets, *messages)
        assert (code, found) == (invalid, reason), details
        assert detail in details


@pytest.fixture
def begun():
    """The messages of an upload that comes to a halt until the test is over."""
    is_over = threading.Event()

    def messages():
        yield header("half")
        yield Message(file="conf.json")
        is_over.wait()

    yield messages()
    is_over.set()


def test_a_client_that_goes_away(datasets, service, artifacts, begun):
    call = datasets.UploadDataset.future(begun, metadata=METADATA)
    wait_until(lambda: uploads_under_way(artifacts))
    call.cancel()
    wait_until(lambda: not uploads_under_way(artifacts))
    wait_until(lambda: "CANCELLED" in [one.get("status") for one in service.log()])  # it did not wait for its patience


def test_the_message_has_the_options_of_an_upload():
    assert set(datasets_pb2.DatasetOptions.DESCRIPTOR.fields_by_name) == set(UPLOAD_OPTIONS)

import io
import os
import signal
import socket
import tarfile
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import httpx
import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray.files import npy_bytes
from ultragray_service.core.uploads import MAX_UPLOADS
from ultragray_workers.claims import LOCK_NAME

from ...waiting import wait_until
from ...warm import Hold

KEY = "0123456789abcdef-datasets"
OTHER_KEYS = (f"{KEY}-2", f"{KEY}-3")
LIMIT_BYTES = 200_000
ZIP = "application/zip"
WAIT_S = 300.0


def sweep(count, offset_mm, seed=0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = np.arange(count) + offset_mm
    images = np.random.default_rng([count, seed]).integers(0, 250, (count, 20, 16), dtype=np.uint8)
    return Sweep(images, poses, LinearProbe(40.0, 0.0, 50.0), np.arange(count), "sweep")


def released_files(folder, seed=0):
    """A dataset of the released layout: 8 training and 3 held-out frames of 20x16."""
    write_released(Dataset("tiny", sweep(8, 0.0, seed), sweep(3, 0.5, seed)), folder)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def poisoned_files(files):
    poses = np.load(io.BytesIO(files["poses_train.npy"]))
    poses[5, 0, 0] = np.nan
    return {**files, "poses_train.npy": npy_bytes(poses)}


def zipped(files):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(f"folder/{name}", content)
    return packed.getvalue()


def tarred(files):
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return packed.getvalue()


def uploads_under_way(folder):
    return [path.name for path in folder.glob("uploads/.*")]


class HalfUpload:
    """A PUT of which only the beginning has been sent."""

    def __init__(self, service, name, key=KEY):
        address = httpx.URL(service.http)
        assert address.port is not None
        self.socket = socket.create_connection((address.host, address.port), timeout=WAIT_S)
        head = (
            f"PUT /v1/datasets/{name} HTTP/1.1\r\nHost: test\r\nX-API-Key: {key}\r\n"
            f"Content-Type: {ZIP}\r\nContent-Length: 100000\r\n\r\n"
        )
        self.socket.sendall(head.encode() + b"PK" * 100)

    def answer(self):
        received = b""
        while b'"request_id"' not in received:
            block = self.socket.recv(65536)
            assert block, received
            received += block
        return received.decode()

    def close(self):
        self.socket.close()


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(
        artifact_folder=artifacts,
        max_dataset_bytes=LIMIT_BYTES,
        max_body_bytes=1024,
        upload_idle_timeout_s=3600.0,
        api_keys=", ".join((KEY, *OTHER_KEYS)),
    )


@pytest.fixture
def files(tmp_path):
    return released_files(tmp_path / "tiny")


@pytest.fixture(autouse=True)
def _nothing_is_left(artifacts):
    yield
    wait_until(lambda: not uploads_under_way(artifacts))


def put(http, name, content, media_type=ZIP, **options):
    return http.put(f"/v1/datasets/{name}", content=content, headers={"Content-Type": media_type}, params=options)


def assert_problem(answer, status, reason, detail=""):
    problem = answer.json()
    assert (answer.status_code, problem["reason"]) == (status, reason), problem
    assert detail in problem["detail"]


def test_the_life_of_a_dataset(http, files, tmp_path):
    first = put(http, "liver", zipped(files))
    assert first.status_code == 201, first.text
    dataset = first.json()
    assert (dataset["name"], dataset["kind"]) == ("liver", "released")
    assert (dataset["train_frames"], dataset["val_frames"]) == (8, 3)
    assert (dataset["height"], dataset["width"]) == (20, 16)
    assert dataset["probe"] == {"kind": "linear", "width_mm": 40.0, "near_mm": 0.0, "far_mm": 50.0}
    assert dataset["bytes"] == sum(map(len, files.values()))
    assert http.get("/v1/datasets/liver").json() == dataset

    again = put(http, "liver", tarred(files), "application/gzip")
    assert (again.status_code, again.json()) == (200, dataset)
    other = zipped(released_files(tmp_path / "other", seed=1))
    assert_problem(put(http, "liver", other), 409, "DATASET_EXISTS")
    assert_problem(http.post("/v1/datasets/liver:simulate"), 409, "DATASET_EXISTS")
    assert http.get("/v1/datasets/liver").json() == dataset

    sheet = http.get("/v1/datasets/liver/contact-sheet")
    assert sheet.headers["content-type"] == "image/png"
    assert sheet.content.startswith(b"\x89PNG")

    deleted = http.delete("/v1/datasets/liver")
    assert (deleted.status_code, deleted.content) == (204, b"")
    for path in ("/v1/datasets/liver", "/v1/datasets/liver/contact-sheet"):
        assert_problem(http.get(path), 404, "DATASET_NOT_FOUND", "no dataset 'liver'")
    assert_problem(http.delete("/v1/datasets/liver"), 404, "DATASET_NOT_FOUND")


def test_separate_files_and_options(http, files):
    parts = [("files", (name, content)) for name, content in files.items()]
    options = {"train_frames": "0:6", "image_size": "8x10"}
    dataset = http.put("/v1/datasets/parts", files=parts, params=options).json()
    assert (dataset["train_frames"], dataset["height"], dataset["width"]) == (6, 10, 8)
    assert dataset["options"] == options
    assert dataset["warnings"] == []
    assert_problem(http.put("/v1/datasets/p", files=parts, params={"train_frames": "0:99"}), 422, "INVALID_ARGUMENT")
    http.delete("/v1/datasets/parts")


def test_limits(http):
    def chunks():
        for _ in range(LIMIT_BYTES // 1000 + 1):
            yield b"\0" * 1000

    assert_problem(put(http, "large", b"\0" * (LIMIT_BYTES + 1)), 413, "UPLOAD_TOO_LARGE", "announced")
    assert_problem(put(http, "large", chunks()), 413, "UPLOAD_TOO_LARGE", str(LIMIT_BYTES))
    bomb = zipped({"conf.json": b"\0" * 5_000_000})
    assert len(bomb) < LIMIT_BYTES
    assert_problem(put(http, "large", bomb), 413, "UPLOAD_TOO_LARGE", str(LIMIT_BYTES))


@pytest.mark.parametrize(
    ("name", "headers", "content", "expected"),
    [
        ("a", {"Content-Type": "application/json"}, b"{}", (415, "UNSUPPORTED_MEDIA_TYPE", "Content-Type")),
        ("a", {}, b"PK", (422, "DATASET_INVALID", "neither .zip nor .tar")),
        ("a", {}, b"PK\x03\x04and no more", (422, "DATASET_INVALID", "cut short")),
        ("a", {"Content-Type": ZIP, "Content-Encoding": "gzip"}, b"PK", (415, "UNSUPPORTED_MEDIA_TYPE", "compressed")),
        (".hidden", {"Content-Type": ZIP}, b"PK", (422, "INVALID_ARGUMENT", "dataset must be")),
        (
            "a",
            {"Content-Type": "multipart/form-data; boundary=x"},
            b'--x\r\nContent-Disposition: form-data; name="crop"\r\n\r\n1\r\n--x--\r\n',
            (422, "INVALID_ARGUMENT", "'crop' is none"),
        ),
    ],
)
def test_requests_that_are_no_uploads(http, name, headers, content, expected):
    assert_problem(http.put(f"/v1/datasets/{name}", headers=headers, content=content), *expected)


def test_a_client_that_goes_away(service, artifacts):
    upload = HalfUpload(service, "gone")
    wait_until(lambda: uploads_under_way(artifacts))
    upload.close()
    wait_until(lambda: not uploads_under_way(artifacts))  # it does not wait for its patience of an hour


def test_too_many_uploads_at_once(service, artifacts):
    uploads = []

    def fill(count, key):
        uploads.extend(HalfUpload(service, f"upload-{number}", key) for number in range(count))
        wait_until(lambda: len(uploads_under_way(artifacts)) == len(uploads))

    def refusal(key):
        with closing(HalfUpload(service, "one-more", key)) as upload:
            return upload.answer()

    fill(MAX_UPLOADS // 2, KEY)
    refused = refusal(KEY)
    assert "QUEUE_FULL" in refused
    assert "of this client" in refused
    fill(MAX_UPLOADS // 2, OTHER_KEYS[0])
    refused = refusal(OTHER_KEYS[1])
    assert "QUEUE_FULL" in refused
    assert "of this client" not in refused
    for upload in uploads:
        upload.close()


def test_an_upload_that_sends_nothing_is_ended(start_service, tmp_path):
    service = start_service(artifact_folder=tmp_path, api_keys=KEY, upload_idle_timeout_s=0.2)
    with closing(HalfUpload(service, "idle")) as upload:
        assert "DEADLINE_EXCEEDED" in upload.answer()


def test_a_check_that_is_killed(http, files):
    with ThreadPoolExecutor(1) as executor:
        for number, problem in (
            (signal.SIGKILL, (507, "MEMORY_EXCEEDED", "was killed")),
            (signal.SIGBUS, (422, "DATASET_INVALID", f"signal {signal.SIGBUS:d}")),
        ):
            with Hold("take_in") as held:
                answer = executor.submit(put, http, "killed", zipped(files))
                os.kill(wait_until(lambda: held.pid), number)
                assert_problem(answer.result(), *problem)
    assert put(http, "killed", zipped(files)).status_code == 201
    http.delete("/v1/datasets/killed")


def test_a_service_that_dies_or_stops_leaves_nothing(start_service, tmp_path):
    first = start_service(artifact_folder=tmp_path, api_keys=KEY)
    upload = HalfUpload(first, "half")
    wait_until(lambda: list(tmp_path.glob(f"uploads/.*/{LOCK_NAME}")))
    first.process.kill()
    first.process.wait()
    upload.close()
    assert uploads_under_way(tmp_path)
    second = start_service(artifact_folder=tmp_path, api_keys=KEY)
    assert not uploads_under_way(tmp_path)
    upload = HalfUpload(second, "half")
    wait_until(lambda: uploads_under_way(tmp_path))
    second.process.send_signal(signal.SIGTERM)
    assert "DRAINING" in upload.answer()
    upload.close()
    assert second.terminate() == 0
    assert not uploads_under_way(tmp_path)
    assert not list(tmp_path.glob("dataset*/*"))

"""What bodies are read from and answers are made of, without a service."""

import asyncio
import threading

import httpx
import pytest
from starlette.applications import Starlette
from starlette.responses import FileResponse
from starlette.routing import Route

from ultragray.errors import InvalidArgument
from ultragray.rendering.settings import Encoding
from ultragray_service.errors import BodyTooLarge, NotAcceptable
from ultragray_service.http import bodies
from ultragray_service.http.accept import JPEG, NPZ, PNG, RAW, Choice, choose
from ultragray_service.http.bodies import FileParts
from ultragray_service.http.middleware import LimitBody
from ultragray_service.http.routes.jobs import SHOWN, artifact_response
from ultragray_workers.jobs.files import Artifact
from ultragray_workers.jobs.progress import StoredFile
from ultragray_workers.storage.local import LocalStorage


@pytest.mark.parametrize(
    ("accept", "media_type", "encoding"),
    [
        ("", PNG, Encoding.PNG),
        ("*/*", PNG, Encoding.PNG),
        ("image/*", PNG, Encoding.PNG),
        ("image/jpeg", JPEG, Encoding.JPEG),
        ("IMAGE/JPEG", JPEG, Encoding.JPEG),
        ("image/*;q=0.5, application/x-npz", NPZ, Encoding.NPZ),
        ("image/png;q=0.2, image/jpeg;q=0.9", JPEG, Encoding.JPEG),
        ("image/png;q=0, */*", JPEG, Encoding.JPEG),
        ("application/*", RAW, Encoding.UINT8),
        ("application/octet-stream", RAW, Encoding.UINT8),
        ("application/octet-stream;dtype=float32", RAW, Encoding.FLOAT32),
        ("application/octet-stream;dtype=float16", RAW, Encoding.FLOAT16),
        ('application/octet-stream; dtype="float32"; q=0.7, text/html', RAW, Encoding.FLOAT32),
        ("text/html, application/xhtml+xml, */*;q=0.8", PNG, Encoding.PNG),
        ("nonsense, ;;q=, image/jpeg;q=x, application/x-npz", NPZ, Encoding.NPZ),
    ],
)
def test_choice_for_one_image(accept, media_type, encoding):
    choice = choose(accept, frames=1, outputs=1, dtype=None)
    assert (choice.media_type, choice.encoding) == (media_type, encoding)


@pytest.mark.parametrize(("frames", "outputs"), [(2, 1), (1, 2)])
def test_several_images_fit_npz_and_raw_only(frames, outputs):
    assert choose("*/*", frames=frames, outputs=outputs, dtype=None).media_type == NPZ
    assert choose("image/png, */*;q=0.1", frames=frames, outputs=outputs, dtype=None).media_type == NPZ
    with pytest.raises(NotAcceptable, match="application/x-npz, application/octet-stream") as caught:
        choose("image/*", frames=frames, outputs=outputs, dtype=None)
    assert caught.value.field == "Accept"


@pytest.mark.parametrize("accept", ["text/html", "image/gif", "*/*;q=0", "application/octet-stream;dtype=int4"])
def test_what_cannot_be_made_is_refused(accept):
    with pytest.raises(NotAcceptable):
        choose(accept, frames=1, outputs=1, dtype=None)


def test_the_header_goes_before_the_dtype_of_the_body():
    assert choose(RAW, frames=1, outputs=1, dtype="float32").encoding is Encoding.FLOAT32
    assert choose(f"{RAW};dtype=uint8", frames=1, outputs=1, dtype="float32").encoding is Encoding.UINT8


def test_a_dtype_in_the_body_asks_for_raw_where_the_header_leaves_the_choice():
    for accept in ("", "*/*"):
        assert choose(accept, frames=1, outputs=1, dtype="float32") == Choice(RAW, Encoding.FLOAT32)
    assert choose("image/png", frames=1, outputs=1, dtype="float32").media_type == PNG


async def test_the_loop_goes_on_while_a_large_body_is_read(monkeypatch):
    begun, may_end = threading.Event(), threading.Event()

    def read(*_):
        begun.set()
        assert may_end.wait(300)
        return "read"

    monkeypatch.setattr(bodies, "_read", read)
    reading = asyncio.ensure_future(bodies.read_large(b'""', str, None))
    while not begun.is_set():
        await asyncio.sleep(0.001)
    assert not reading.done()
    may_end.set()
    assert await reading == "read"


def test_a_body_in_chunks_is_refused_at_the_chunk_that_exceeds_the_limit():
    read = []

    async def receive():
        return {"type": "http.request", "body": b"123456", "more_body": True}

    async def app(scope, receive, send):
        while len(read) < 100:
            read.append((await receive())["body"])

    async def send(message): ...

    scope = {"type": "http", "method": "POST", "path": "/v1/jobs", "headers": [(b"transfer-encoding", b"chunked")]}
    with pytest.raises(BodyTooLarge):
        asyncio.run(LimitBody(app, limit_bytes=15)(scope, receive, send))
    assert len(read) == 2


TYPE = "multipart/form-data; boundary=x"
BODY = (
    b'--x\r\nContent-Disposition: form-data; name="a"; filename="poses.npy"\r\n\r\nfirst\r\nline\r\n'
    b'--x\r\ncontent-disposition: form-data; filename="images.npy"\r\nContent-Type: a/b\r\n\r\n\r\n--x--\r\n'
)


@pytest.mark.parametrize("block_bytes", [1, 7, len(BODY)])
def test_files_come_in_order_however_the_body_is_cut(block_bytes):
    parts = FileParts(TYPE)
    files = []
    for first in range(0, len(BODY), block_bytes):
        for event in parts.feed(BODY[first : first + block_bytes]):
            if isinstance(event, str):
                files.append((event, b""))
            else:
                files[-1] = (files[-1][0], files[-1][1] + event)
    parts.finish()
    assert files == [("poses.npy", b"first\r\nline"), ("images.npy", b"")]


def test_body_that_ends_too_early():
    parts = FileParts(TYPE)
    parts.feed(BODY[:-6])
    with pytest.raises(InvalidArgument, match="truncated"):
        parts.finish()


@pytest.mark.parametrize("content_type", ["multipart/form-data", f"multipart/form-data; boundary={'x' * 300}"])
def test_boundary_that_cannot_be_used(content_type):
    with pytest.raises(InvalidArgument, match="boundary"):
        FileParts(content_type)


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (b"PK\x03\x04", "no multipart"),
        (b'--x\r\nContent-Disposition: form-data; name="crop"\r\n\r\n', "'crop' is none"),
        (b"--x\r\nContent-Type: a/b\r\n\r\n", "'' is none"),
    ],
)
def test_what_is_no_file(body, told):
    with pytest.raises(InvalidArgument, match=told):
        FileParts(TYPE).feed(body)


CONTENT = bytes(range(256)) * 10_000


@pytest.fixture
def get(tmp_path):
    """Answers the same file from a storage and from a folder."""
    storage = LocalStorage(tmp_path)
    storage.write("jobs/one/frames.npz", CONTENT)
    file = Artifact(storage, "frames.npz", StoredFile("jobs/one/frames.npz", len(CONTENT), "ab" * 32))

    async def shared(request):
        return artifact_response(file, request.headers, "application/x-npz", "attachment")

    async def local(request):
        path = tmp_path / "jobs" / "one" / "frames.npz"
        return FileResponse(path, media_type="application/x-npz", filename="frames.npz", headers=SHOWN)

    app = Starlette(routes=[Route("/shared", shared), Route("/local", local)])

    def get(path, headers=None):
        async def ask():
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
                return await client.get(path, headers=headers)

        return asyncio.run(ask())

    return get


@pytest.mark.parametrize(
    "asked",
    ["", "bytes=0-", "bytes=100-", "bytes=100-199", "bytes=-5", "bytes=2559999-", "bytes=2560000-", "bytes=5-99999999"],
)
def test_a_range_is_answered_as_of_a_file(get, asked):
    headers = {"Range": asked} if asked else {}
    shared, local = get("/shared", headers=headers), get("/local", headers=headers)
    assert shared.status_code == local.status_code
    if local.status_code != 416:
        assert shared.content == local.content
        for name in ("content-length", "content-range", "content-type", "accept-ranges", *SHOWN):
            assert shared.headers.get(name) == local.headers.get(name), name


def test_a_download_of_another_content_begins_anew(get):
    etag = get("/shared").headers["etag"]
    same = get("/shared", headers={"Range": "bytes=10-", "If-Range": etag})
    assert (same.status_code, len(same.content)) == (206, len(CONTENT) - 10)
    other = get("/shared", headers={"Range": "bytes=10-", "If-Range": '"of another"'})
    assert (other.status_code, other.content) == (200, CONTENT)


def test_a_file_that_the_client_has_is_not_sent_again(get):
    etag = get("/shared").headers["etag"]
    again = get("/shared", headers={"If-None-Match": etag})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", etag)

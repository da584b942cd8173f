from __future__ import annotations

import pytest

from ultragray.errors import InvalidArgument
from ultragray_service.http.bodies import FileParts

TYPE = "multipart/form-data; boundary=x"
BODY = (
    b'--x\r\nContent-Disposition: form-data; name="a"; filename="poses.npy"\r\n\r\nfirst\r\nline\r\n'
    b'--x\r\ncontent-disposition: form-data; filename="images.npy"\r\nContent-Type: a/b\r\n\r\n\r\n--x--\r\n'
)


@pytest.mark.parametrize("block_bytes", [1, 7, len(BODY)])
def test_files_come_in_order_however_the_body_is_cut(block_bytes: int) -> None:
    parts = FileParts(TYPE)
    files: list[tuple[str, bytes]] = []
    for first in range(0, len(BODY), block_bytes):
        for event in parts.feed(BODY[first : first + block_bytes]):
            if isinstance(event, str):
                files.append((event, b""))
            else:
                files[-1] = (files[-1][0], files[-1][1] + event)
    parts.finish()
    assert files == [("poses.npy", b"first\r\nline"), ("images.npy", b"")]


def test_body_that_ends_too_early() -> None:
    parts = FileParts(TYPE)
    parts.feed(BODY[:-6])
    with pytest.raises(InvalidArgument, match="truncated"):
        parts.finish()


@pytest.mark.parametrize("content_type", ["multipart/form-data", f"multipart/form-data; boundary={'x' * 300}"])
def test_boundary_that_cannot_be_used(content_type: str) -> None:
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
def test_what_is_no_file(body: bytes, told: str) -> None:
    with pytest.raises(InvalidArgument, match=told):
        FileParts(TYPE).feed(body)

"""A file of an object storage as an answer of HTTP: whole, or the range that was asked for."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Mapping
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.responses import Response, StreamingResponse

from ultragray_workers.jobs.shared.reading import OpenFile, SharedFile, opened

# A page that a job made is shown without scripts, in an origin of its own, and fetches nothing.
SHOWN = {
    "content-security-policy": "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "frame-ancestors 'self'",
    "x-content-type-options": "nosniff",
}
_CHUNK_BYTES = 2**20
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")


def shared_file_response(
    file: SharedFile, asked: Headers, media_type: str, beside: Mapping[str, str], disposition: str
) -> Response:
    """The answer to a GET with these headers. Of several ranges none is answered, but the whole file.

    `beside`: further headers of the answer. `disposition`: inline or attachment.
    """
    etag = f'"{file.stored.sha256}"'
    headers = {
        **beside,
        "accept-ranges": "bytes",
        "content-disposition": f"{disposition}; filename*=utf-8''{quote(file.name)}",
        "etag": etag,
    }
    start, end, status = 0, file.stored.bytes, 200
    if (
        asked.get("if-range", etag) == etag
        and (found := _RANGE.fullmatch(asked.get("range", "")))
        and any(found.groups())
    ):
        first, last = found.groups()
        start = int(first) if first else max(0, end - int(last))
        if first and last:
            end = min(end, int(last) + 1)
        if start >= end:
            return Response(status_code=416, headers={"content-range": f"bytes */{file.stored.bytes}"})
        status = 206
        headers["content-range"] = f"bytes {start}-{end - 1}/{file.stored.bytes}"
    headers["content-length"] = str(end - start)
    return StreamingResponse(_bytes(file, start, end), status_code=status, headers=headers, media_type=media_type)


async def _bytes(file: SharedFile, start: int, end: int) -> AsyncIterator[bytes]:
    with opened(file) as source:
        while start < end:
            chunk = await asyncio.to_thread(_read, source, start, min(_CHUNK_BYTES, end - start))
            start += len(chunk)
            yield chunk


def _read(source: OpenFile, start: int, length: int) -> bytes:
    if not (chunk := source.read(start, length)):
        raise OSError("the file is shorter than its record says")  # ends the connection: the client sees that
    return chunk

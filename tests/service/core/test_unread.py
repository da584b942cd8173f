"""A connection whose transport holds little: it may be written to whenever it buffers nothing."""

import asyncio
import ssl

import pytest
import trustme

from ultragray_service.core.unread import hold_little

FRAMES = 3


@pytest.mark.parametrize("is_tls", [False, True], ids=["plain", "tls"])
def test_a_client_that_says_nothing_gets_every_frame(certificates, is_tls):
    async def send(_, writer):
        hold_little(writer.transport)
        for _ in range(FRAMES):
            writer.write(b"frame")
            await writer.drain()
        writer.close()
        await writer.wait_closed()

    async def talk():
        theirs, ours = certificates if is_tls else (None, None)
        async with asyncio.timeout(300), await asyncio.start_server(send, "127.0.0.1", 0, ssl=theirs) as server:
            port = server.sockets[0].getsockname()[1]
            reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=ours)
            assert await reader.readexactly(FRAMES * len(b"frame")) == FRAMES * b"frame"
            writer.close()
            await writer.wait_closed()

    asyncio.run(talk())


@pytest.fixture
def certificates():
    """Contexts of the server and of its client."""
    authority = trustme.CA()
    theirs = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    authority.issue_cert("127.0.0.1").configure_cert(theirs)
    ours = ssl.create_default_context()
    authority.configure_trust(ours)
    return theirs, ours

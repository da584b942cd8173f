"""A connection whose transport holds little: it may be written to whenever it buffers nothing."""

import asyncio
import ssl

import pytest
import trustme
import uvloop

from ultragray_service.core.unread import Unread, hold_little

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


def test_a_client_that_has_gone_gets_no_more_messages():
    ended = []

    async def send(_, writer):
        unread = Unread(writer.transport)
        try:
            while True:
                unread.write(b"frame")
                await asyncio.sleep(0)
        except Exception as error:
            ended.append(error)

    async def talk():
        async with asyncio.timeout(300), await asyncio.start_server(send, "127.0.0.1", 0) as server:
            _, writer = await asyncio.open_connection("127.0.0.1", server.sockets[0].getsockname()[1])
            writer.transport.abort()
            while not ended:
                await asyncio.sleep(0.01)

    uvloop.run(talk())
    assert isinstance(ended[0], ConnectionResetError)


@pytest.fixture
def certificates():
    """Contexts of the server and of its client."""
    authority = trustme.CA()
    theirs = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    authority.issue_cert("127.0.0.1").configure_cert(theirs)
    ours = ssl.create_default_context()
    authority.configure_trust(ours)
    return theirs, ours

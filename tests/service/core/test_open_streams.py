"""Open streams and their watchers, without a door."""

import asyncio

import pytest

from ultragray.errors import UltragrayError
from ultragray_service.access.principals import Principal, Role, act_as
from ultragray_service.core.open_streams import MAX_NAME, OpenStream, OpenStreams, StreamAnswer
from ultragray_service.errors import StreamNotFound

ALICE, BOB = (Principal(name, Role.READER, "key") for name in ("alice", "bob"))
ADMIN = Principal("root", Role.ADMIN, "key")


def refusal(sequence, **others):
    return StreamAnswer(sequence, None, UltragrayError("not this one"), **others)


def act(principal):
    act_as(principal, address="10.0.0.7", connection="ipv4:10.0.0.7:5000")


def test_a_slow_watcher_gets_the_newest_answer_alone_and_then_the_end():
    async def main():
        stream, taken = OpenStream(), []
        with stream.watched() as watcher:
            for sequence in range(5):
                stream.note(refusal(sequence))
            stream.end()
            while (answered := await watcher.next()) is not None:
                taken.append(answered.sequence)
        return taken

    assert asyncio.run(main()) == [4]


def test_a_watcher_that_has_gone_is_told_nothing():
    async def main():
        stream = OpenStream()
        with stream.watched():
            assert stream.summary().watchers == 1
        stream.note(refusal(1))
        assert stream.summary().watchers == 0

    asyncio.run(main())


def test_a_summary_counts_what_came_and_what_was_answered():
    stream = OpenStream(name="UR5 \n" + "x" * 200)
    for sequence in range(3):
        stream.count_pose()
        stream.note(refusal(sequence, dropped=2))
    told = stream.summary()
    assert (told.poses, told.frames, told.refused, told.dropped) == (3, 0, 3, 6)
    assert (told.scene, told.pose) == (None, None)
    assert told.poses_per_s == 1.5
    assert told.name.startswith("UR5 x")
    assert len(told.name) == MAX_NAME


def test_streams_are_seen_by_their_owner_and_by_admins():
    async def main():
        streams = OpenStreams()
        act(ALICE)
        with streams.opened("grpc", "robot") as stream:
            assert [one.client for one in streams.seen()] == ["10.0.0.7:5000"]
            assert streams.get(stream.id) is stream
            act(BOB)
            assert streams.seen() == []
            with pytest.raises(StreamNotFound):
                streams.get(stream.id)
            act(ADMIN)
            assert [one.owner for one in streams.seen()] == ["alice"]
            assert streams.seen("liver") == []
        assert streams.seen() == []

    asyncio.run(main())

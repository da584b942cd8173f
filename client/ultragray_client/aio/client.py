"""The client: rendering, and the way to everything else."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable

import numpy.typing as npt

from ultragray_client.connection import DEFAULT_ADDRESS, DEFAULT_TIMEOUT_S, ApiKey, Tls
from ultragray_client.conversations import Batch
from ultragray_client.exchange import PoseExchange, StreamMode
from ultragray_client.frames import Localization, localize_message
from ultragray_client.records import AuditEntry, Me
from ultragray_proto.codec import from_message
from ultragray_proto.v1 import access_pb2, access_pb2_grpc, rendering_pb2, rendering_pb2_grpc

from ..contract import Extrapolation, Probe, RenderSettings, SliceSettings
from ..frames import Frame, Slice, frame_from_message, settings_message, slice_from_message
from ..geometry import PoseLike, pose_message, pose_messages
from ..messages import message_of
from .connection import AsyncConnection
from .datasets import AsyncDatasets
from .jobs import AsyncJobs
from .registrations import AsyncRegistrations
from .scenes import AsyncScenes
from .stream import AsyncFrameStream
from .workers import AsyncWorkers


class AsyncClient:
    """A service at `address` (HOST:PORT), encrypted where `tls` is given.

    `api_key` is a key or a token that the service knows, or a function that is called before each call and gives one
    that is valid then, at once: a token that will soon expire is best renewed elsewhere.

    Threads may share a `Client`; each process needs one of its own, made after the fork. An `AsyncClient` is made and
    used within one event loop.

    `timeout_s` is the deadline of each call that names none, all its attempts together. Calls that go on for as long
    as they take (`render_batch`, `jobs.watch`, up- and downloads) ask a service that fails without any progress again
    for so long. A call is repeated where the service was not reached, is starting or stopping, or has a full queue,
    after the delay that it tells; nothing else is.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        api_key: ApiKey | None = None,
        tls: Tls | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self._connection = AsyncConnection(address, api_key, tls, timeout_s)
        self._calls = rendering_pb2_grpc.RenderServiceStub(self._connection.channel)
        self._access = access_pb2_grpc.AccessServiceStub(self._connection.channel)
        self.scenes = AsyncScenes(self._connection)
        self.datasets = AsyncDatasets(self._connection)
        self.jobs = AsyncJobs(self._connection)
        self.workers = AsyncWorkers(self._connection)
        self.registrations = AsyncRegistrations(self._connection)

    async def render(
        self, scene: str, pose: PoseLike, settings: RenderSettings | None = None, *, timeout_s: float | None = None
    ) -> Frame:
        """One frame of `pose`, [4, 4] mm or a Placement; `settings` None: B-mode in uint8, as the scene was trained.

        Raises SceneNotFound, InvalidArgument and its kinds, QueueFull, DeadlineExceeded, Unavailable.
        """
        request = rendering_pb2.RenderRequest(settings=settings_message(scene, settings), pose=pose_message(pose))
        return frame_from_message(await self._connection.answer(self._calls.Render, request, timeout_s))

    def render_batch(
        self,
        scene: str,
        poses: Iterable[PoseLike],
        settings: RenderSettings | None = None,
        *,
        timeout_s: float | None = None,
    ) -> AsyncIterator[Frame]:
        """The frames of any number of poses ([C, 4, 4] mm, or as they come from an iterator), in order, as they are
        ready; behind the frames of interactive callers.

        Goes on from the first missing frame where the service is restarted. Without `timeout_s` it takes as long as it
        takes. Otherwise as `render`; a refused pose is named `poses[index]`, and one below `min_confidence` only after
        the frames before it.
        """
        batch = Batch(settings_message(scene, settings), poses)
        return self._connection.converse(self._calls.RenderBatch, batch, timeout_s)

    def stream(
        self,
        scene: str,
        settings: RenderSettings | None = None,
        *,
        mode: StreamMode | str = "ordered",
        timeout_s: float | None = None,
        shared_memory: bool = False,
        reconnect_s: float | None = None,
    ) -> AsyncFrameStream:
        """A stream of poses: `async with client.stream("demo", mode="latest") as stream: await stream.send(pose)`.

        `timeout_s` is the deadline of the whole stream; None: it has none. Otherwise as `render`.

        Where the connection is lost, or the service stops, the stream goes on over another connection, with the same
        sequences: it sends the poses without an answer again, a latest one the newest of them alone, and the others
        count as dropped. `reconnect_s`: for so long it tries, before `receive` raises why it cannot (0: at once; None:
        the client's `timeout_s`). `stream.reconnections` tells how often it went on.

        `shared_memory`: pixels come through memory that is shared with the service instead of the connection, which
        takes a Linux host that both run on, as the same user, and a loopback `address`; else InvalidArgument. The
        arrays of a frame are views of that memory, and stay as they are for as long as anything refers to one of
        them. While 16 frames are held, others come through the connection, as do those of more than 16 MiB.
        """
        exchange = PoseExchange(settings_message(scene, settings), mode, shared_memory=shared_memory)
        call = self._connection.pose_call(self._calls.RenderStream, exchange, timeout_s, reconnect_s)
        return AsyncFrameStream(exchange, call)

    async def render_slice(self, scene: str, plane: SliceSettings, *, timeout_s: float | None = None) -> Slice:
        """A field of a scene on any plane, without a probe. It waits and counts as a frame does.

        Raises SceneNotFound, InvalidArgument and its kinds, QueueFull, DeadlineExceeded, Unavailable.
        """
        request = rendering_pb2.RenderSliceRequest(scene=scene, slice=message_of(plane, rendering_pb2.SliceSettings))
        return slice_from_message(await self._connection.answer(self._calls.RenderSlice, request, timeout_s))

    async def assess_poses(
        self,
        scene: str,
        poses: Iterable[PoseLike],
        probe: Probe | None = None,
        *,
        registration: str | None = None,
        timeout_s: float | None = None,
    ) -> tuple[Extrapolation, ...]:
        """How far frames at these poses of a probe (None: the scene's own) would extrapolate, without rendering any.

        With a `registration` they are poses of the flange in its base.

        `supported_share` is None: only a rendered frame tells it. Raises SceneNotFound, InvalidPose, InvalidProbe,
        TooManyPoses.
        """
        request = message_of(
            {"probe": probe, "registration": registration},
            rendering_pb2.AssessPosesRequest,
            scene=scene,
            poses=list(pose_messages(poses)),
        )
        answer = await self._connection.answer(self._calls.AssessPoses, request, timeout_s)
        return tuple(from_message(one, Extrapolation) for one in answer.extrapolations)

    async def localize(
        self,
        scene: str,
        image: npt.ArrayLike | bytes,
        start: PoseLike,
        *,
        probe: Probe | None = None,
        registration: str | None = None,
        within_mm: float = 3.0,
        within_deg: float = 5.0,
        timeout_s: float | None = None,
    ) -> Localization:
        """Where in a scene a real frame was taken, looked for about `start`, which may be off by the two `within`.

        `image`: grey values [H, W], uint8 or in [0, 1], or the bytes of a PNG file; rows along depth, columns across
        scan lines, not scan-converted. `probe` took it (None: the scene's own). `is_found` of the answer says whether
        its pose can be used. With a `registration` the start is a pose of the flange in its base, and the answer has
        such a pose as well. Raises SceneNotFound, InvalidArgument and its kinds, QueueFull, DeadlineExceeded.
        """
        request = localize_message(scene, image, start, probe, registration, within_mm, within_deg)
        answer = await self._connection.answer(self._calls.Localize, request, timeout_s)
        return from_message(answer, Localization)

    async def who_am_i(self, *, timeout_s: float | None = None) -> Me:
        """The name and the role that the key stands for."""
        request = access_pb2.WhoAmIRequest()
        return from_message(await self._connection.answer(self._access.WhoAmI, request, timeout_s), Me)

    async def audit(
        self,
        *,
        since_hours: float = 24.0,
        who: str | None = None,
        what: str | None = None,
        limit: int = 1000,
        timeout_s: float | None = None,
    ) -> tuple[AuditEntry, ...]:
        """The last entries of the audit log, oldest first; `what`: an operation such as scene.delete, or scene.

        For admins alone. Raises PermissionDenied, InvalidArgument.
        """
        request = access_pb2.ListAuditEntriesRequest(since_hours=since_hours, who=who, what=what, limit=limit)
        answer = await self._connection.answer(self._access.ListAuditEntries, request, timeout_s)
        return tuple(from_message(entry, AuditEntry) for entry in answer.entries)

    async def close(self) -> None:
        """Ends all that is under way."""
        await self._connection.close()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

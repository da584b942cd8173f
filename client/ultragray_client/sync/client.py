# Generated from aio/client.py by client/generate.py; change that file.
"""The client: rendering, and the way to everything else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from types import TracebackType

from ultragray_proto.v1 import rendering_pb2

from ..batch import Batch
from ..connection import DEFAULT_ADDRESS, DEFAULT_TIMEOUT_S, Operation
from ..display import Display
from ..frames import Frame, frame_from_message, settings_message
from ..geometry import PoseLike, Probe, pose_message
from ..pose_exchange import PoseExchange, StreamMode
from .connection import Connection
from .datasets import Datasets
from .jobs import Jobs
from .scenes import Scenes
from .stream import FrameStream


class Client:
    """A service at `address` (HOST:PORT).

    Threads may share a `Client`; each process needs one of its own, made after the fork. An `AsyncClient` is made and
    used within one event loop.

    `timeout_s` is the deadline of each call that names none, all its attempts together, and of the calls that go on
    for as long as they take (`render_batch`, `jobs.watch`, up- and downloads) how long a service
    that fails without any progress is asked again. A call is repeated where the service was not reached, is starting
    or stopping, or has a full queue, after the delay that it tells; nothing else is.
    """

    def __init__(
        self, address: str = DEFAULT_ADDRESS, *, api_key: str | None = None, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> None:
        self._connection = Connection(address, api_key, timeout_s)
        self.scenes = Scenes(self._connection)
        self.datasets = Datasets(self._connection)
        self.jobs = Jobs(self._connection)

    def render(
        self,
        scene: str,
        pose: PoseLike,
        *,
        outputs: Sequence[str] = ("bmode",),
        dtype: str = "uint8",
        height: int | None = None,
        width: int | None = None,
        probe: Probe | None = None,
        display: Display | None = None,
        min_confidence: float | None = None,
        below_min_confidence: str = "refuse",
        timeout_s: float | None = None,
    ) -> Frame:
        """One frame of `pose`, [4, 4] mm or a Placement.

        `height` (depth samples), `width` (scan lines) and `probe` None: as the scene was trained. `outputs`: some of
        bmode, echo, transmittance, coverage, labels. `dtype` "uint8" or "float32". `display` None: as it is rendered.
        Where its confidence is below `min_confidence`, 0 to 1 (None: any will do), `below_min_confidence` "refuse"
        raises LowConfidence before it is rendered, "mask" makes the pixels 0 that Gaussians do not support. Raises
        SceneNotFound, InvalidArgument and its kinds, QueueFull, DeadlineExceeded, Unavailable.
        """
        settings = settings_message(
            scene,
            outputs=outputs,
            dtype=dtype,
            height=height,
            width=width,
            probe=probe,
            display=display,
            min_confidence=min_confidence,
            below_min_confidence=below_min_confidence,
        )
        request = rendering_pb2.RenderRequest(settings=settings, pose=pose_message(pose))
        operation = Operation("rendering.Render", request, lambda message: frame_from_message(message, sequence=0))
        return self._connection.answer(operation, timeout_s)

    def render_batch(
        self,
        scene: str,
        poses: Iterable[PoseLike],
        *,
        outputs: Sequence[str] = ("bmode",),
        dtype: str = "uint8",
        height: int | None = None,
        width: int | None = None,
        probe: Probe | None = None,
        display: Display | None = None,
        min_confidence: float | None = None,
        below_min_confidence: str = "refuse",
        timeout_s: float | None = None,
    ) -> Iterator[Frame]:
        """The frames of any number of poses ([C, 4, 4] mm, or as they come from an iterator), in order, as they are
        ready; behind the frames of interactive callers.

        Goes on from the first missing frame where the service is restarted. Without `timeout_s` it takes as long as it
        takes. Otherwise as `render`; a refused pose is named `poses[index]`, and one below `min_confidence` only after
        the frames before it.
        """
        settings = settings_message(
            scene,
            outputs=outputs,
            dtype=dtype,
            height=height,
            width=width,
            probe=probe,
            display=display,
            min_confidence=min_confidence,
            below_min_confidence=below_min_confidence,
        )
        return self._connection.converse(Batch(settings, poses), timeout_s)

    def stream(
        self,
        scene: str,
        *,
        mode: StreamMode | str = "ordered",
        outputs: Sequence[str] = ("bmode",),
        dtype: str = "uint8",
        height: int | None = None,
        width: int | None = None,
        probe: Probe | None = None,
        display: Display | None = None,
        min_confidence: float | None = None,
        below_min_confidence: str = "refuse",
        timeout_s: float | None = None,
    ) -> FrameStream:
        """A stream of poses: `with client.stream("demo", mode="latest") as stream: stream.send(pose)`.

        `timeout_s` is the deadline of the whole stream; None: it has none. Otherwise as `render`.
        """
        settings = settings_message(
            scene,
            outputs=outputs,
            dtype=dtype,
            height=height,
            width=width,
            probe=probe,
            display=display,
            min_confidence=min_confidence,
            below_min_confidence=below_min_confidence,
        )
        return FrameStream(self._connection, PoseExchange(settings, mode), timeout_s)

    def close(self) -> None:
        """Ends all that is under way."""
        self._connection.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

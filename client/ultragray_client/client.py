"""The clients, for threads and for asyncio: the same operations, each once, as the message that it sends and the answer
that it reads. `transport.py` carries them out.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy.typing as npt

from ultragray_client.connection import DEFAULT_ADDRESS, DEFAULT_TIMEOUT_S, ApiKey, Tls, is_local
from ultragray_client.contract import (
    Dataset,
    DatasetOptions,
    Edit,
    Extrapolation,
    PlanSettings,
    Probe,
    RecordingSettings,
    RecordingView,
    RenderSettings,
    SceneRecipe,
    SliceSettings,
    Specification,
)
from ultragray_client.conversations import Batch, LastJob, Recorder, RecordingAnswer, Upload, Watch, download_into
from ultragray_client.exchange import PoseExchange, StreamMode
from ultragray_client.frames import (
    Frame,
    Localization,
    RealFrame,
    Slice,
    ViewPlan,
    frame_from_message,
    image_fields,
    settings_message,
    slice_from_message,
)
from ultragray_client.geometry import PoseLike, matrix_message, pose_message, pose_messages
from ultragray_client.messages import message_of
from ultragray_client.records import (
    AuditEntry,
    Job,
    JobEvent,
    JobState,
    Me,
    Registration,
    Scene,
    SceneEntry,
    Worker,
    entry_from_message,
    job_from_message,
    scene_from_message,
)
from ultragray_client.transport import (
    AnyConnection,
    AsyncConnection,
    Call,
    Collection,
    Connection,
    Deletion,
    Group,
    Listing,
    LongCall,
    PoseStream,
    Sending,
    Talk,
    each,
    operation,
)
from ultragray_proto.codec import from_message
from ultragray_proto.v1 import access_pb2, jobs_pb2, registrations_pb2, scenes_pb2, workers_pb2  # noqa: F401  # whose methods are found by their names

_QUALITY = ("residual_mm", "residual_deg", "position_std_mm", "angle_std_deg")


class Scenes(Group[AnyConnection]):
    """`client.scenes`. All raise ClientError; a name that does not exist is SceneNotFound."""

    @operation
    def list(self, *, timeout_s: float | None = None) -> Listing[SceneEntry]:
        """All scenes by name."""
        return Listing("SceneService.ListScenes", "scenes", entry_from_message, timeout_s)

    @operation
    def get(self, name: str, *, timeout_s: float | None = None) -> Call[Scene]:
        """All that a scene says about itself."""
        return Call("SceneService.GetScene", scene_from_message, timeout_s, scene=name)

    @operation
    def load(self, name: str, *, timeout_s: float | None = None) -> Call[int]:
        """Loads a scene ahead of its first frame; the number of render processes that hold it."""
        return Call("SceneService.LoadScene", _loaded, timeout_s, scene=name)

    @operation
    def unload(self, name: str, *, timeout_s: float | None = None) -> Call[int]:
        """Frees a scene's memory; the number of render processes that still hold it."""
        return Call("SceneService.UnloadScene", _loaded, timeout_s, scene=name)

    @operation
    def label(
        self,
        name: str,
        *,
        into: str,
        frames: Iterable[tuple[PoseLike, bytes]] = (),
        label_map: bytes | None = None,
        label_names: Mapping[int, str] | None = None,
        within_mm: float = 4.0,
        probe: Probe | None = None,
        registration: str | None = None,
        replace: bool = False,
        private: bool = False,
        timeout_s: float | None = None,
    ) -> Call[Scene]:
        """Labels the Gaussians of a scene, as the scene `into`, by painted frames or by a label map.

        `frames`: poses of `probe` (None: the scene's own) and grey PNG files of 8 bits, rows along depth, columns
        across scan lines: the label of each pixel, 0: no label, 255: not painted. `label_map`: the bytes of a NIfTI-1
        file. Gaussians that neither reaches take the label of labelled ones `within_mm` that echo alike. `replace`:
        `into` may be a scene that is there, the key's own, with the same Gaussians. `registration` leads poses, or the
        map, into the scene. Raises SceneNotFound, SceneExists, SceneReadOnly, PermissionDenied, InvalidArgument and
        its kinds.
        """
        return Call(
            "SceneService.LabelScene",
            scene_from_message,
            timeout_s,
            request={"probe": probe},
            scene=name,
            into=into,
            frames=[scenes_pb2.PaintedFrame(pose=pose_message(pose), labels=labels) for pose, labels in frames],
            label_map=label_map,
            label_names=dict(label_names or {}),
            within_mm=within_mm,
            registration=registration,
            replace=replace,
            private=private,
        )

    @operation
    def edit(
        self, name: str, edits: Iterable[Edit], *, into: str, private: bool = False, timeout_s: float | None = None
    ) -> Call[Scene]:
        """Edits a scene, one edit after another, as the scene `into`, which tells its parents; `name` stays as it is.

        Raises SceneNotFound, SceneExists, and InvalidArgument with the path of what is wrong.
        """
        request = {"into": into, "edits": list(edits), "private": private}
        return Call("SceneService.EditScene", scene_from_message, timeout_s, request=request, scene=name)

    @operation
    def from_labels(
        self, recipe: SceneRecipe, *, into: str, private: bool = False, timeout_s: float | None = None
    ) -> Call[Scene]:
        """Makes the scene `into` of bodies of tissue, which nobody recorded; all of its labels are in `made_labels`.

        Raises SceneExists, and InvalidArgument with the path of what is wrong.
        """
        return Call("SceneService.MakeScene", scene_from_message, timeout_s, request=recipe, into=into, private=private)


class Datasets(Group[AnyConnection]):
    """`client.datasets`. All raise ClientError; a name that does not exist is DatasetNotFound."""

    @operation
    def upload(
        self,
        name: str,
        path: str | Path,
        *,
        options: DatasetOptions | None = None,
        private: bool = False,
        timeout_s: float | None = None,
    ) -> Sending[Dataset]:
        """Uploads a folder with all below it, or an archive (.zip, .tar, .tar.gz, .tgz), and waits until it is checked.

        Others do not see a `private` one. The same content and options again give the dataset that is there. Without
        `timeout_s` it takes as long as it takes. Raises DatasetInvalid with the file and the frame, DatasetExists,
        UploadTooLarge, StorageFull.
        """
        upload = Upload(name, path, options or DatasetOptions(), private)
        return Sending(
            "DatasetService.UploadDataset",
            upload.messages,
            lambda answer: from_message(answer.dataset, Dataset),
            timeout_s,
        )

    @operation
    def list(self, *, timeout_s: float | None = None) -> Listing[Dataset]:
        """All datasets by name."""
        return Listing("DatasetService.ListDatasets", "datasets", Dataset, timeout_s)

    @operation
    def get(self, name: str, *, timeout_s: float | None = None) -> Call[Dataset]:
        """One dataset."""
        return Call("DatasetService.GetDataset", Dataset, timeout_s, dataset=name)

    @operation
    def contact_sheet(self, name: str, *, timeout_s: float | None = None) -> Call[bytes]:
        """A PNG of the image planes in space and of some frames."""
        return Call("DatasetService.GetContactSheet", lambda answer: bytes(answer.png), timeout_s, dataset=name)

    @operation
    def delete(self, name: str, *, timeout_s: float | None = None) -> Call[None]:
        """Raises DatasetInUse where a job needs it."""
        return Deletion("DatasetService.DeleteDataset", timeout_s, dataset=name)


class Recordings(Group[AnyConnection]):
    """`client.recordings`: datasets that are still open. All raise ClientError; of no such name DatasetNotFound."""

    @operation
    def begin(
        self, name: str, settings: RecordingSettings, *, private: bool = False, timeout_s: float | None = None
    ) -> Call[RecordingView]:
        """Begins a recording under the name of the dataset that it becomes; of one that was begun with these settings,
        how far it is. Others do not see a `private` one. Raises DatasetExists, LimitReached.
        """
        request = {"dataset": name, "settings": settings, "private": private}
        return Call("RecordingService.BeginRecording", RecordingView, timeout_s, request=request)

    @operation
    def get(self, name: str, *, timeout_s: float | None = None) -> Call[RecordingView]:
        """How far a recording is."""
        return Call("RecordingService.GetRecording", RecordingView, timeout_s, dataset=name)

    @operation
    def record(
        self, name: str, frames: Iterable[RealFrame], *, timeout_s: float | None = None
    ) -> Talk[RecordingAnswer]:
        """Adds frames as they come from an iterator, and tells whenever more of them is stored.

        An answer also tells of a frame that cannot be recorded, such as one without echo: the others go on. Where the
        connection is lost, or the service is restarted, frames that are not known to be stored are sent again. One
        client may record at a time. Raises RecordingTaken, LimitReached, StorageFull.
        """
        return Talk("RecordingService.RecordFrames", Recorder(name, frames), timeout_s)

    @operation
    def finish(self, name: str, *, timeout_s: float | None = None) -> LongCall[Dataset]:
        """Makes a recording a dataset, checked as an upload is; returns it again where it is one already. Without
        `timeout_s` it takes as long as it takes. Raises DatasetNotFound, DatasetInvalid.
        """
        return LongCall("RecordingService.FinishRecording", Dataset, timeout_s, dataset=name)

    @operation
    def delete(self, name: str, *, timeout_s: float | None = None) -> Call[None]:
        """Raises DatasetInUse where a live job follows it."""
        return Deletion("RecordingService.DeleteRecording", timeout_s, dataset=name)


class Jobs(Group[AnyConnection]):
    """`client.jobs`. All raise ClientError; an id that does not exist is JobNotFound.

    A submission has a `request_id`, one of its own unless one is given: the same id with the same job gives the job
    that is there, with another one RequestIdConflict. A `priority` is from -1000 to 1000, higher ones go first. Others
    see neither a `private` job nor the scene that it makes.
    """

    @operation
    def submit(
        self,
        specification: Specification,
        *,
        request_id: str | None = None,
        priority: int = 0,
        private: bool = False,
        timeout_s: float | None = None,
    ) -> Call[Job]:
        """Puts a job into the queue: `TrainJob(dataset="liver", scene="liver")` makes a scene that is served,
        `RenderJob(scene="demo", sampler=FanSampler(tilt_deg=10, step_deg=2))` an archive of frames.

        Raises DatasetNotFound, SceneNotFound, RegistrationNotFound, SceneExists, JobQueueFull, ExtraMissing,
        StorageFull, LowConfidence and other kinds of InvalidArgument.
        """
        # With an id of its own a submission that is sent again gives the same job.
        request_id = uuid.uuid4().hex if request_id is None else request_id
        job = getattr(jobs_pb2.SubmitJobRequest(), specification.kind)
        poses = getattr(specification, "poses", None)
        others = {} if poses is None else {"poses": pose_messages(poses)}
        return Call(
            "JobService.SubmitJob",
            lambda answer: job_from_message(answer.job),
            timeout_s,
            **{specification.kind: message_of(specification, type(job), **others)},
            request_id=request_id,
            priority=priority,
            private=private,
        )

    @operation
    def list(
        self,
        *,
        state: JobState | str | None = None,
        kind: str | None = None,
        limit: int | None = None,
        timeout_s: float | None = None,
    ) -> Listing[Job]:
        """The newest jobs first, at most `limit`; None: all that the service keeps."""
        request = {"state": state, "kind": kind}
        return Listing("JobService.ListJobs", "jobs", job_from_message, timeout_s, limit, request)

    @operation
    def get(self, job_id: str, *, timeout_s: float | None = None) -> Call[Job]:
        """One job."""
        return Call("JobService.GetJob", job_from_message, timeout_s, job=job_id)

    @operation
    def watch(self, job_id: str, *, timeout_s: float | None = None) -> Talk[JobEvent]:
        """The job at first and whenever it changed, and new lines of its log, until it is in its final state.

        Goes on where the service was restarted in the meantime. Without `timeout_s` it takes as long as the job.
        """
        return Talk("JobService.WatchJob", Watch(job_id), timeout_s)

    @operation
    def wait(self, job_id: str, *, timeout_s: float | None = None) -> Collection[Job]:
        """The job in its final state, whichever that is."""
        return Collection("JobService.WatchJob", lambda: nullcontext(LastJob(job_id)), timeout_s)

    @operation
    def cancel(self, job_id: str, *, timeout_s: float | None = None) -> Call[Job]:
        """Stops a job within a second. Raises JobFinished for one that succeeded or failed."""
        return Call("JobService.CancelJob", job_from_message, timeout_s, job=job_id)

    @operation
    def retry(self, job_id: str, *, timeout_s: float | None = None) -> Call[Job]:
        """A new job in place of a failed or cancelled one; asked again, the same one. Raises JobNotFinished."""
        return Call("JobService.RetryJob", job_from_message, timeout_s, job=job_id)

    @operation
    def delete(self, job_id: str, *, timeout_s: float | None = None) -> Call[None]:
        """Removes a finished job and its files; a scene that it trained stays. Raises JobInUse."""
        return Deletion("JobService.DeleteJob", timeout_s, job=job_id)

    @operation
    def log(self, job_id: str, *, max_bytes: int = 65536, timeout_s: float | None = None) -> Call[str]:
        """The end of what the job's process said."""
        return Call("JobService.GetJobLog", lambda answer: str(answer.log), timeout_s, job=job_id, max_bytes=max_bytes)

    @operation
    def download(
        self, job_id: str, artifact: str, path: str | Path, *, timeout_s: float | None = None
    ) -> Collection[None]:
        """Writes an artifact to the file `path`, whole or not at all; goes on where the connection broke.

        Raises ArtifactNotFound, and OSError where the file cannot be written.
        """
        return Collection(
            "JobService.DownloadArtifact", partial(download_into, job_id, artifact, Path(path)), timeout_s
        )


class Workers(Group[AnyConnection]):
    """`client.workers`. All raise ClientError; a name that does not exist is WorkerNotFound.

    Only admins pause, drain and resume; the worker obeys within two seconds, and rests until `resume`, restarts
    included.
    """

    @operation
    def list(self, *, timeout_s: float | None = None) -> Call[tuple[Worker, ...]]:
        """The workers by name, also those that were lost within a day."""
        return Call("WorkerService.ListWorkers", each("workers", Worker), timeout_s)

    @operation
    def pause(self, name: str, *, timeout_s: float | None = None) -> Call[Worker]:
        """Lets a worker take no more jobs; it ends the one at hand."""
        return Call("WorkerService.PauseWorker", Worker, timeout_s, worker=name)

    @operation
    def drain(self, name: str, *, timeout_s: float | None = None) -> Call[Worker]:
        """As `pause`, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."""
        return Call("WorkerService.DrainWorker", Worker, timeout_s, worker=name)

    @operation
    def resume(self, name: str, *, timeout_s: float | None = None) -> Call[Worker]:
        """Lets a worker take jobs again."""
        return Call("WorkerService.ResumeWorker", Worker, timeout_s, worker=name)


class Registrations(Group[AnyConnection]):
    """`client.registrations`. All raise ClientError; a name that does not exist is RegistrationNotFound."""

    @operation
    def list(self, *, timeout_s: float | None = None) -> Listing[Registration]:
        """All registrations that the key may see, by name."""
        return Listing("RegistrationService.ListRegistrations", "registrations", Registration, timeout_s)

    @operation
    def get(self, name: str, *, timeout_s: float | None = None) -> Call[Registration]:
        """One registration."""
        return Call("RegistrationService.GetRegistration", Registration, timeout_s, registration=name)

    @operation
    def put(
        self,
        name: str,
        scene: str,
        base_to_scene: npt.ArrayLike,
        probe_to_flange: npt.ArrayLike | None = None,
        *,
        quality: Mapping[str, Any] | None = None,
        timeout_s: float | None = None,
    ) -> Call[Registration]:
        """Keeps a registration of a scene, in place of one of that name which is the key's own.

        Both links are [4, 4], mm; without `probe_to_flange` the probe's frame is the flange's. `quality` may hold
        residual_mm, residual_deg, position_std_mm and angle_std_deg, as the file of `ultragray calibrate` does.
        Raises InvalidPose, SceneNotFound, PermissionDenied, LimitReached.
        """
        links = {"base_to_scene": base_to_scene, "probe_to_flange": probe_to_flange}
        matrices = {link: matrix_message(pose, field=link) for link, pose in links.items() if pose is not None}
        known = {key: value for key, value in (quality or {}).items() if key in _QUALITY}
        content = message_of(known, registrations_pb2.Registration, scene=scene, **matrices)
        return Call("RegistrationService.PutRegistration", Registration, timeout_s, registration=name, content=content)

    @operation
    def delete(self, name: str, *, timeout_s: float | None = None) -> Call[None]:
        """Forgets a registration."""
        return Call("RegistrationService.DeleteRegistration", lambda _: None, timeout_s, registration=name)


class _Client(Group[AnyConnection]):
    """A client, but for its end."""

    _connects: Any  # AnyConnection

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        api_key: ApiKey | None = None,
        tls: Tls | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        super().__init__(self._connects(address, api_key, tls, timeout_s))
        self.scenes: Scenes[AnyConnection] = Scenes(self._connection)
        self.datasets: Datasets[AnyConnection] = Datasets(self._connection)
        self.recordings: Recordings[AnyConnection] = Recordings(self._connection)
        self.jobs: Jobs[AnyConnection] = Jobs(self._connection)
        self.workers: Workers[AnyConnection] = Workers(self._connection)
        self.registrations: Registrations[AnyConnection] = Registrations(self._connection)

    @operation
    def render(
        self, scene: str, pose: PoseLike, settings: RenderSettings | None = None, *, timeout_s: float | None = None
    ) -> Call[Frame]:
        """One frame of `pose`, [4, 4] mm or a Placement; `settings` None: B-mode in uint8, as the scene was trained.

        Raises SceneNotFound, InvalidArgument and its kinds, QueueFull, DeadlineExceeded, Unavailable.
        """
        request = {"settings": settings_message(scene, settings), "pose": pose_message(pose)}
        return Call("RenderService.Render", frame_from_message, timeout_s, **request)

    @operation
    def render_batch(
        self,
        scene: str,
        poses: Iterable[PoseLike],
        settings: RenderSettings | None = None,
        *,
        timeout_s: float | None = None,
    ) -> Talk[Frame]:
        """The frames of any number of poses ([C, 4, 4] mm, or as they come from an iterator), in order, as they are
        ready; behind the frames of interactive callers.

        Goes on from the first missing frame where the service is restarted. Without `timeout_s` it takes as long as it
        takes. Otherwise as `render`; a refused pose is named `poses[index]`, and one below `min_confidence` only after
        the frames before it.
        """
        return Talk("RenderService.RenderBatch", Batch(settings_message(scene, settings), poses), timeout_s)

    @operation
    def stream(
        self,
        scene: str,
        settings: RenderSettings | None = None,
        *,
        mode: StreamMode | str = "ordered",
        timeout_s: float | None = None,
        shared_memory: bool | None = None,
        reconnect_s: float | None = None,
        seen_after_ms: float | None = None,
    ) -> PoseStream:
        """A stream of poses: `with client.stream("demo", mode="latest") as stream: stream.send(pose)`.

        `timeout_s` is the deadline of the whole stream; None: it has none. Otherwise as `render`.

        Where the connection is lost, or the service stops, the stream goes on over another connection, with the same
        sequences: it sends the poses without an answer again, a latest one the newest of them alone, and the others
        count as dropped. `reconnect_s`: for so long it tries, before `receive` raises why it cannot (0: at once; None:
        the client's `timeout_s`). `stream.reconnections` tells how often it went on.

        `shared_memory`: pixels come through memory that is shared with the service, and messages through a socket,
        instead of the connection: the fastest way to a frame. It takes a Linux host that both run on, as the same user,
        and a loopback `address`. None: where that is so; True: else InvalidArgument; False: over the connection. The
        arrays of a frame are views of that memory, and stay as they are for as long as anything refers to one of them.
        While 16 frames are held, others come in their messages, as do those of more than 16 MiB.

        `seen_after_ms`, 0 to `MAX_AHEAD_MS`: frames are those of where the probe will be when they are seen, so long
        after they arrive here; None: of the poses as they were sent. A pose is foretold from those before it and their
        `measured_ns`, for the median latency of the last frames; `frame.pose` is where, and `frame.prediction` says
        how far ahead that is, and how wrong it is expected to be.
        """
        if shared_memory is None and not is_local(self._connection.address):
            shared_memory = False
        exchange = PoseExchange(
            settings_message(scene, settings), mode, shared_memory=shared_memory, seen_after_ms=seen_after_ms
        )
        return PoseStream("RenderService.RenderStream", exchange, timeout_s, reconnect_s)

    @operation
    def render_slice(self, scene: str, plane: SliceSettings, *, timeout_s: float | None = None) -> Call[Slice]:
        """A field of a scene on any plane, without a probe. It waits and counts as a frame does.

        Raises SceneNotFound, InvalidArgument and its kinds, QueueFull, DeadlineExceeded, Unavailable.
        """
        request = {"scene": scene, "slice": plane}
        return Call("RenderService.RenderSlice", slice_from_message, timeout_s, request=request)

    @operation
    def assess_poses(
        self,
        scene: str,
        poses: Iterable[PoseLike],
        probe: Probe | None = None,
        *,
        registration: str | None = None,
        timeout_s: float | None = None,
    ) -> Call[tuple[Extrapolation, ...]]:
        """How far frames at these poses of a probe (None: the scene's own) would extrapolate, without rendering any.

        With a `registration` they are poses of the flange in its base.

        `supported_share` is None: only a rendered frame tells it. Raises SceneNotFound, InvalidPose, InvalidProbe,
        TooManyPoses.
        """
        return Call(
            "RenderService.AssessPoses",
            each("extrapolations", Extrapolation),
            timeout_s,
            request={"probe": probe},
            scene=scene,
            poses=pose_messages(poses),
            registration=registration,
        )

    @operation
    def localize(
        self,
        scene: str,
        image: npt.ArrayLike | bytes,
        start: PoseLike | None = None,
        *,
        probe: Probe | None = None,
        registration: str | None = None,
        within_mm: float = 3.0,
        within_deg: float = 5.0,
        search: str = "near",
        timeout_s: float | None = None,
    ) -> Call[Localization]:
        """Where in a scene a real frame was taken, looked for about `start`, which may be off by the two `within`.

        `search` track: `start` is the pose of the frame before; anywhere: nothing is known, no start is needed.
        `image`: grey values [H, W], uint8 or in [0, 1], or the bytes of a PNG file; rows along depth, columns across
        scan lines, not scan-converted. `probe` took it (None: the scene's own). `is_found` of the answer says whether
        its pose can be used. With a `registration` the start is a pose of the flange in its base, and the answer has
        such a pose as well. Raises SceneNotFound, InvalidArgument and its kinds, QueueFull, DeadlineExceeded.
        """
        return Call(
            "RenderService.Localize",
            Localization,
            timeout_s,
            request={"probe": probe, "search": search},
            scene=scene,
            start=None if start is None else pose_message(start, field="start"),
            registration=registration,
            within_mm=within_mm,
            within_deg=within_deg,
            **image_fields(image),
        )

    @operation
    def plan_views(
        self,
        scene: str,
        settings: PlanSettings | None = None,
        *,
        poses: Iterable[PoseLike] = (),
        view: PoseLike | None = None,
        start: PoseLike | None = None,
        registration: str | None = None,
        timeout_s: float | None = None,
    ) -> Call[ViewPlan]:
        """Where to look next: poses in reach whose frames would teach the scene most, in an order to travel them.

        `poses` are all that is in reach (none: the skin under the training views, as `settings` say); `view` is a
        standard plane: only the points of its image count; `start` is where the probe is. With a `registration` all of
        them are poses of the flange in its base, and the planned views have such poses as well. Raises SceneNotFound,
        InvalidArgument and its kinds, QueueFull, DeadlineExceeded.
        """
        return Call(
            "RenderService.PlanViews",
            ViewPlan,
            timeout_s,
            request=settings or PlanSettings(),
            scene=scene,
            poses=pose_messages(poses),
            view=None if view is None else pose_message(view, field="view"),
            start=None if start is None else pose_message(start, field="start"),
            registration=registration,
        )

    @operation
    def who_am_i(self, *, timeout_s: float | None = None) -> Call[Me]:
        """The name and the role that the key stands for."""
        return Call("AccessService.WhoAmI", Me, timeout_s)

    @operation
    def audit(
        self,
        *,
        since_hours: float = 24.0,
        who: str | None = None,
        what: str | None = None,
        limit: int = 1000,
        timeout_s: float | None = None,
    ) -> Call[tuple[AuditEntry, ...]]:
        """The last entries of the audit log, oldest first; `what`: an operation such as scene.delete, or scene.

        For admins alone. Raises PermissionDenied, InvalidArgument.
        """
        request = {"since_hours": since_hours, "who": who, "what": what, "limit": limit}
        return Call("AccessService.ListAuditEntries", each("entries", AuditEntry), timeout_s, **request)


class Client(_Client[Connection]):
    """A service at `address`, HOST:PORT of its gRPC, encrypted where `tls` is given; or http:// or https:// before it.

    `api_key` is a key or a token that the service knows, or a function that is called before each call and gives one
    that is valid then, at once: a token that will soon expire is best renewed elsewhere.

    Threads may share a `Client`; each process needs one of its own, made after the fork. An `AsyncClient` is made and
    used within one event loop.

    `timeout_s` is the deadline of each call that names none, all its attempts together. Calls that go on for as long
    as they take (`render_batch`, `jobs.watch`, `recordings.finish`, up- and downloads) ask a service that fails without
    any progress again for so long. A call is repeated where the service was not reached, is starting or stopping, or
    has a full queue, after the delay that it tells; nothing else is.
    """

    _connects = Connection

    def close(self) -> None:
        """Ends all that is under way."""
        self._connection.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncClient(_Client[AsyncConnection]):
    """`Client` for asyncio, with the same methods, to be awaited or iterated with `async for`.

    It is made and used within one event loop: `async with AsyncClient() as client: frame = await client.render(…)`.
    """

    is_async, _connects = True, AsyncConnection

    async def close(self) -> None:
        """Ends all that is under way."""
        await self._connection.close()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


def _loaded(answer: Any) -> int:
    return int(answer.loaded_processes)

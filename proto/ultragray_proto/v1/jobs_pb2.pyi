from google.protobuf import struct_pb2 as _struct_pb2
from ultragray_proto.v1 import geometry_pb2 as _geometry_pb2
from ultragray_proto.v1 import rendering_pb2 as _rendering_pb2
from ultragray_proto.v1 import scenes_pb2 as _scenes_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class JobKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    JOB_KIND_UNSPECIFIED: _ClassVar[JobKind]
    JOB_KIND_TRAIN: _ClassVar[JobKind]
    JOB_KIND_RENDER: _ClassVar[JobKind]
    JOB_KIND_EVALUATE: _ClassVar[JobKind]
    JOB_KIND_COMPARE: _ClassVar[JobKind]
    JOB_KIND_VOXELIZE: _ClassVar[JobKind]
    JOB_KIND_LIVE: _ClassVar[JobKind]
    JOB_KIND_MOTION: _ClassVar[JobKind]

class JobState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    JOB_STATE_UNSPECIFIED: _ClassVar[JobState]
    JOB_STATE_QUEUED: _ClassVar[JobState]
    JOB_STATE_RUNNING: _ClassVar[JobState]
    JOB_STATE_SUCCEEDED: _ClassVar[JobState]
    JOB_STATE_FAILED: _ClassVar[JobState]
    JOB_STATE_CANCELLED: _ClassVar[JobState]
JOB_KIND_UNSPECIFIED: JobKind
JOB_KIND_TRAIN: JobKind
JOB_KIND_RENDER: JobKind
JOB_KIND_EVALUATE: JobKind
JOB_KIND_COMPARE: JobKind
JOB_KIND_VOXELIZE: JobKind
JOB_KIND_LIVE: JobKind
JOB_KIND_MOTION: JobKind
JOB_STATE_UNSPECIFIED: JobState
JOB_STATE_QUEUED: JobState
JOB_STATE_RUNNING: JobState
JOB_STATE_SUCCEEDED: JobState
JOB_STATE_FAILED: JobState
JOB_STATE_CANCELLED: JobState

class CompareJob(_message.Message):
    __slots__ = ("dataset", "methods", "budget", "times", "seed", "max_run_s", "device", "min_memory_gb", "worker_labels")
    class WorkerLabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    DATASET_FIELD_NUMBER: _ClassVar[int]
    METHODS_FIELD_NUMBER: _ClassVar[int]
    BUDGET_FIELD_NUMBER: _ClassVar[int]
    TIMES_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    MAX_RUN_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MIN_MEMORY_GB_FIELD_NUMBER: _ClassVar[int]
    WORKER_LABELS_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    methods: _containers.RepeatedScalarFieldContainer[str]
    budget: str
    times: float
    seed: int
    max_run_s: float
    device: str
    min_memory_gb: int
    worker_labels: _containers.ScalarMap[str, str]
    def __init__(self, dataset: _Optional[str] = ..., methods: _Optional[_Iterable[str]] = ..., budget: _Optional[str] = ..., times: _Optional[float] = ..., seed: _Optional[int] = ..., max_run_s: _Optional[float] = ..., device: _Optional[str] = ..., min_memory_gb: _Optional[int] = ..., worker_labels: _Optional[_Mapping[str, str]] = ...) -> None: ...

class EvaluateJob(_message.Message):
    __slots__ = ("dataset", "scene", "baselines", "max_run_s", "device", "min_memory_gb", "worker_labels", "register")
    class WorkerLabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    DATASET_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    BASELINES_FIELD_NUMBER: _ClassVar[int]
    MAX_RUN_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MIN_MEMORY_GB_FIELD_NUMBER: _ClassVar[int]
    WORKER_LABELS_FIELD_NUMBER: _ClassVar[int]
    REGISTER_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    scene: str
    baselines: bool
    max_run_s: float
    device: str
    min_memory_gb: int
    worker_labels: _containers.ScalarMap[str, str]
    register: bool
    def __init__(self, dataset: _Optional[str] = ..., scene: _Optional[str] = ..., baselines: _Optional[bool] = ..., max_run_s: _Optional[float] = ..., device: _Optional[str] = ..., min_memory_gb: _Optional[int] = ..., worker_labels: _Optional[_Mapping[str, str]] = ..., register: _Optional[bool] = ...) -> None: ...

class LiveJob(_message.Message):
    __slots__ = ("max_run_s", "device", "min_memory_gb", "worker_labels", "recording", "scene", "version_every_s")
    class WorkerLabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    MAX_RUN_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MIN_MEMORY_GB_FIELD_NUMBER: _ClassVar[int]
    WORKER_LABELS_FIELD_NUMBER: _ClassVar[int]
    RECORDING_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    VERSION_EVERY_S_FIELD_NUMBER: _ClassVar[int]
    max_run_s: float
    device: str
    min_memory_gb: int
    worker_labels: _containers.ScalarMap[str, str]
    recording: str
    scene: str
    version_every_s: float
    def __init__(self, max_run_s: _Optional[float] = ..., device: _Optional[str] = ..., min_memory_gb: _Optional[int] = ..., worker_labels: _Optional[_Mapping[str, str]] = ..., recording: _Optional[str] = ..., scene: _Optional[str] = ..., version_every_s: _Optional[float] = ...) -> None: ...

class MotionJob(_message.Message):
    __slots__ = ("max_run_s", "device", "min_memory_gb", "worker_labels", "name", "chest_mm", "pulse_mm", "vessel", "steps", "spacing_mm", "scene", "into", "dataset", "numbers", "field_leads", "field_axes", "field", "field_to_scene", "registration")
    class WorkerLabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    MAX_RUN_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MIN_MEMORY_GB_FIELD_NUMBER: _ClassVar[int]
    WORKER_LABELS_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    CHEST_MM_FIELD_NUMBER: _ClassVar[int]
    PULSE_MM_FIELD_NUMBER: _ClassVar[int]
    VESSEL_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    SPACING_MM_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    INTO_FIELD_NUMBER: _ClassVar[int]
    DATASET_FIELD_NUMBER: _ClassVar[int]
    NUMBERS_FIELD_NUMBER: _ClassVar[int]
    FIELD_LEADS_FIELD_NUMBER: _ClassVar[int]
    FIELD_AXES_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    FIELD_TO_SCENE_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    max_run_s: float
    device: str
    min_memory_gb: int
    worker_labels: _containers.ScalarMap[str, str]
    name: str
    chest_mm: float
    pulse_mm: float
    vessel: _scenes_pb2.Shape
    steps: int
    spacing_mm: float
    scene: str
    into: str
    dataset: str
    numbers: _containers.RepeatedScalarFieldContainer[float]
    field_leads: str
    field_axes: str
    field: FieldFile
    field_to_scene: _containers.RepeatedScalarFieldContainer[float]
    registration: str
    def __init__(self, max_run_s: _Optional[float] = ..., device: _Optional[str] = ..., min_memory_gb: _Optional[int] = ..., worker_labels: _Optional[_Mapping[str, str]] = ..., name: _Optional[str] = ..., chest_mm: _Optional[float] = ..., pulse_mm: _Optional[float] = ..., vessel: _Optional[_Union[_scenes_pb2.Shape, _Mapping]] = ..., steps: _Optional[int] = ..., spacing_mm: _Optional[float] = ..., scene: _Optional[str] = ..., into: _Optional[str] = ..., dataset: _Optional[str] = ..., numbers: _Optional[_Iterable[float]] = ..., field_leads: _Optional[str] = ..., field_axes: _Optional[str] = ..., field: _Optional[_Union[FieldFile, _Mapping]] = ..., field_to_scene: _Optional[_Iterable[float]] = ..., registration: _Optional[str] = ...) -> None: ...

class TrainJob(_message.Message):
    __slots__ = ("dataset", "scene", "preset", "settings", "device", "max_run_s", "min_memory_gb", "worker_labels", "start_scene")
    class WorkerLabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    DATASET_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    PRESET_FIELD_NUMBER: _ClassVar[int]
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MAX_RUN_S_FIELD_NUMBER: _ClassVar[int]
    MIN_MEMORY_GB_FIELD_NUMBER: _ClassVar[int]
    WORKER_LABELS_FIELD_NUMBER: _ClassVar[int]
    START_SCENE_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    scene: str
    preset: str
    settings: _struct_pb2.Struct
    device: str
    max_run_s: float
    min_memory_gb: int
    worker_labels: _containers.ScalarMap[str, str]
    start_scene: str
    def __init__(self, dataset: _Optional[str] = ..., scene: _Optional[str] = ..., preset: _Optional[str] = ..., settings: _Optional[_Union[_struct_pb2.Struct, _Mapping]] = ..., device: _Optional[str] = ..., max_run_s: _Optional[float] = ..., min_memory_gb: _Optional[int] = ..., worker_labels: _Optional[_Mapping[str, str]] = ..., start_scene: _Optional[str] = ...) -> None: ...

class VoxelizeJob(_message.Message):
    __slots__ = ("scene", "field", "spacing_mm", "box_mm", "format", "max_run_s", "device", "min_memory_gb", "worker_labels")
    class WorkerLabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    SCENE_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    SPACING_MM_FIELD_NUMBER: _ClassVar[int]
    BOX_MM_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    MAX_RUN_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MIN_MEMORY_GB_FIELD_NUMBER: _ClassVar[int]
    WORKER_LABELS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    field: str
    spacing_mm: float
    box_mm: str
    format: str
    max_run_s: float
    device: str
    min_memory_gb: int
    worker_labels: _containers.ScalarMap[str, str]
    def __init__(self, scene: _Optional[str] = ..., field: _Optional[str] = ..., spacing_mm: _Optional[float] = ..., box_mm: _Optional[str] = ..., format: _Optional[str] = ..., max_run_s: _Optional[float] = ..., device: _Optional[str] = ..., min_memory_gb: _Optional[int] = ..., worker_labels: _Optional[_Mapping[str, str]] = ...) -> None: ...

class RenderJob(_message.Message):
    __slots__ = ("pose_count", "scene", "poses", "sampler", "height", "width", "outputs", "format", "dtype", "min_confidence", "probe", "display", "below_min_confidence", "max_run_s", "slice_thickness_mm", "shard_frames", "contact", "tools", "ghost", "device", "min_memory_gb", "worker_labels", "registration", "speckle", "phase", "breathing", "indentation_mm")
    class WorkerLabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    POSE_COUNT_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    SAMPLER_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    DTYPE_FIELD_NUMBER: _ClassVar[int]
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    DISPLAY_FIELD_NUMBER: _ClassVar[int]
    BELOW_MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    MAX_RUN_S_FIELD_NUMBER: _ClassVar[int]
    SLICE_THICKNESS_MM_FIELD_NUMBER: _ClassVar[int]
    SHARD_FRAMES_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FIELD_NUMBER: _ClassVar[int]
    TOOLS_FIELD_NUMBER: _ClassVar[int]
    GHOST_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    MIN_MEMORY_GB_FIELD_NUMBER: _ClassVar[int]
    WORKER_LABELS_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    SPECKLE_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    BREATHING_FIELD_NUMBER: _ClassVar[int]
    INDENTATION_MM_FIELD_NUMBER: _ClassVar[int]
    pose_count: int
    scene: str
    poses: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Pose]
    sampler: PoseSampler
    height: int
    width: int
    outputs: _containers.RepeatedScalarFieldContainer[_rendering_pb2.Output]
    format: str
    dtype: str
    min_confidence: float
    probe: _geometry_pb2.Probe
    display: _rendering_pb2.Display
    below_min_confidence: _rendering_pb2.BelowConfidence
    max_run_s: float
    slice_thickness_mm: float
    shard_frames: int
    contact: _rendering_pb2.Contact
    tools: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Tool]
    ghost: float
    device: str
    min_memory_gb: int
    worker_labels: _containers.ScalarMap[str, str]
    registration: str
    speckle: _rendering_pb2.Speckle
    phase: _containers.RepeatedScalarFieldContainer[float]
    breathing: _scenes_pb2.Breathing
    indentation_mm: float
    def __init__(self, pose_count: _Optional[int] = ..., scene: _Optional[str] = ..., poses: _Optional[_Iterable[_Union[_geometry_pb2.Pose, _Mapping]]] = ..., sampler: _Optional[_Union[PoseSampler, _Mapping]] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., outputs: _Optional[_Iterable[_Union[_rendering_pb2.Output, str]]] = ..., format: _Optional[str] = ..., dtype: _Optional[str] = ..., min_confidence: _Optional[float] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., display: _Optional[_Union[_rendering_pb2.Display, _Mapping]] = ..., below_min_confidence: _Optional[_Union[_rendering_pb2.BelowConfidence, str]] = ..., max_run_s: _Optional[float] = ..., slice_thickness_mm: _Optional[float] = ..., shard_frames: _Optional[int] = ..., contact: _Optional[_Union[_rendering_pb2.Contact, str]] = ..., tools: _Optional[_Iterable[_Union[_geometry_pb2.Tool, _Mapping]]] = ..., ghost: _Optional[float] = ..., device: _Optional[str] = ..., min_memory_gb: _Optional[int] = ..., worker_labels: _Optional[_Mapping[str, str]] = ..., registration: _Optional[str] = ..., speckle: _Optional[_Union[_rendering_pb2.Speckle, str]] = ..., phase: _Optional[_Iterable[float]] = ..., breathing: _Optional[_Union[_scenes_pb2.Breathing, _Mapping]] = ..., indentation_mm: _Optional[float] = ...) -> None: ...

class FieldFile(_message.Message):
    __slots__ = ("data", "format")
    DATA_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    data: str
    format: str
    def __init__(self, data: _Optional[str] = ..., format: _Optional[str] = ...) -> None: ...

class PoseSampler(_message.Message):
    __slots__ = ("kind", "count", "translation_mm", "rotation_deg", "seed", "spacing_mm", "tilt_deg", "step_deg")
    KIND_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_MM_FIELD_NUMBER: _ClassVar[int]
    ROTATION_DEG_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SPACING_MM_FIELD_NUMBER: _ClassVar[int]
    TILT_DEG_FIELD_NUMBER: _ClassVar[int]
    STEP_DEG_FIELD_NUMBER: _ClassVar[int]
    kind: str
    count: int
    translation_mm: float
    rotation_deg: float
    seed: int
    spacing_mm: float
    tilt_deg: float
    step_deg: float
    def __init__(self, kind: _Optional[str] = ..., count: _Optional[int] = ..., translation_mm: _Optional[float] = ..., rotation_deg: _Optional[float] = ..., seed: _Optional[int] = ..., spacing_mm: _Optional[float] = ..., tilt_deg: _Optional[float] = ..., step_deg: _Optional[float] = ...) -> None: ...

class SubmitJobRequest(_message.Message):
    __slots__ = ("train", "render", "evaluate", "compare", "voxelize", "live", "motion", "request_id", "priority", "private")
    TRAIN_FIELD_NUMBER: _ClassVar[int]
    RENDER_FIELD_NUMBER: _ClassVar[int]
    EVALUATE_FIELD_NUMBER: _ClassVar[int]
    COMPARE_FIELD_NUMBER: _ClassVar[int]
    VOXELIZE_FIELD_NUMBER: _ClassVar[int]
    LIVE_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    train: TrainJob
    render: RenderJob
    evaluate: EvaluateJob
    compare: CompareJob
    voxelize: VoxelizeJob
    live: LiveJob
    motion: MotionJob
    request_id: str
    priority: int
    private: bool
    def __init__(self, train: _Optional[_Union[TrainJob, _Mapping]] = ..., render: _Optional[_Union[RenderJob, _Mapping]] = ..., evaluate: _Optional[_Union[EvaluateJob, _Mapping]] = ..., compare: _Optional[_Union[CompareJob, _Mapping]] = ..., voxelize: _Optional[_Union[VoxelizeJob, _Mapping]] = ..., live: _Optional[_Union[LiveJob, _Mapping]] = ..., motion: _Optional[_Union[MotionJob, _Mapping]] = ..., request_id: _Optional[str] = ..., priority: _Optional[int] = ..., private: _Optional[bool] = ...) -> None: ...

class SubmitJobResponse(_message.Message):
    __slots__ = ("job", "created")
    JOB_FIELD_NUMBER: _ClassVar[int]
    CREATED_FIELD_NUMBER: _ClassVar[int]
    job: Job
    created: bool
    def __init__(self, job: _Optional[_Union[Job, _Mapping]] = ..., created: _Optional[bool] = ...) -> None: ...

class JobEstimate(_message.Message):
    __slots__ = ("frames", "files", "height", "width", "bytes", "seconds", "poses")
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    FILES_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SECONDS_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    frames: int
    files: int
    height: int
    width: int
    bytes: int
    seconds: float
    poses: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Pose]
    def __init__(self, frames: _Optional[int] = ..., files: _Optional[int] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., bytes: _Optional[int] = ..., seconds: _Optional[float] = ..., poses: _Optional[_Iterable[_Union[_geometry_pb2.Pose, _Mapping]]] = ...) -> None: ...

class ListJobsRequest(_message.Message):
    __slots__ = ("state", "kind", "page_size", "page_token")
    STATE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    state: JobState
    kind: JobKind
    page_size: int
    page_token: str
    def __init__(self, state: _Optional[_Union[JobState, str]] = ..., kind: _Optional[_Union[JobKind, str]] = ..., page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListJobsResponse(_message.Message):
    __slots__ = ("jobs", "next_page_token")
    JOBS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    jobs: _containers.RepeatedCompositeFieldContainer[Job]
    next_page_token: str
    def __init__(self, jobs: _Optional[_Iterable[_Union[Job, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class GetJobRequest(_message.Message):
    __slots__ = ("job",)
    JOB_FIELD_NUMBER: _ClassVar[int]
    job: str
    def __init__(self, job: _Optional[str] = ...) -> None: ...

class CancelJobRequest(_message.Message):
    __slots__ = ("job",)
    JOB_FIELD_NUMBER: _ClassVar[int]
    job: str
    def __init__(self, job: _Optional[str] = ...) -> None: ...

class RetryJobRequest(_message.Message):
    __slots__ = ("job",)
    JOB_FIELD_NUMBER: _ClassVar[int]
    job: str
    def __init__(self, job: _Optional[str] = ...) -> None: ...

class DeleteJobRequest(_message.Message):
    __slots__ = ("job",)
    JOB_FIELD_NUMBER: _ClassVar[int]
    job: str
    def __init__(self, job: _Optional[str] = ...) -> None: ...

class DeleteJobResponse(_message.Message):
    __slots__ = ("job",)
    JOB_FIELD_NUMBER: _ClassVar[int]
    job: str
    def __init__(self, job: _Optional[str] = ...) -> None: ...

class GetJobLogRequest(_message.Message):
    __slots__ = ("job", "max_bytes")
    JOB_FIELD_NUMBER: _ClassVar[int]
    MAX_BYTES_FIELD_NUMBER: _ClassVar[int]
    job: str
    max_bytes: int
    def __init__(self, job: _Optional[str] = ..., max_bytes: _Optional[int] = ...) -> None: ...

class GetJobLogResponse(_message.Message):
    __slots__ = ("log",)
    LOG_FIELD_NUMBER: _ClassVar[int]
    log: str
    def __init__(self, log: _Optional[str] = ...) -> None: ...

class DownloadArtifactRequest(_message.Message):
    __slots__ = ("job", "name", "offset")
    JOB_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    job: str
    name: str
    offset: int
    def __init__(self, job: _Optional[str] = ..., name: _Optional[str] = ..., offset: _Optional[int] = ...) -> None: ...

class ArtifactChunk(_message.Message):
    __slots__ = ("data", "file_bytes")
    DATA_FIELD_NUMBER: _ClassVar[int]
    FILE_BYTES_FIELD_NUMBER: _ClassVar[int]
    data: bytes
    file_bytes: int
    def __init__(self, data: _Optional[bytes] = ..., file_bytes: _Optional[int] = ...) -> None: ...

class WatchJobRequest(_message.Message):
    __slots__ = ("job",)
    JOB_FIELD_NUMBER: _ClassVar[int]
    job: str
    def __init__(self, job: _Optional[str] = ...) -> None: ...

class JobEvent(_message.Message):
    __slots__ = ("job", "log")
    JOB_FIELD_NUMBER: _ClassVar[int]
    LOG_FIELD_NUMBER: _ClassVar[int]
    job: Job
    log: str
    def __init__(self, job: _Optional[_Union[Job, _Mapping]] = ..., log: _Optional[str] = ...) -> None: ...

class Job(_message.Message):
    __slots__ = ("kind", "train", "render", "evaluate", "compare", "voxelize", "live", "motion", "id", "state", "request_id", "priority", "created_at", "started_at", "finished_at", "error", "progress", "artifacts", "metrics", "worker", "retry_of", "attempts", "owner", "private")
    class MetricsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    KIND_FIELD_NUMBER: _ClassVar[int]
    TRAIN_FIELD_NUMBER: _ClassVar[int]
    RENDER_FIELD_NUMBER: _ClassVar[int]
    EVALUATE_FIELD_NUMBER: _ClassVar[int]
    COMPARE_FIELD_NUMBER: _ClassVar[int]
    VOXELIZE_FIELD_NUMBER: _ClassVar[int]
    LIVE_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    STARTED_AT_FIELD_NUMBER: _ClassVar[int]
    FINISHED_AT_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    ARTIFACTS_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    RETRY_OF_FIELD_NUMBER: _ClassVar[int]
    ATTEMPTS_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    kind: JobKind
    train: TrainJob
    render: RenderJob
    evaluate: EvaluateJob
    compare: CompareJob
    voxelize: VoxelizeJob
    live: LiveJob
    motion: MotionJob
    id: str
    state: JobState
    request_id: str
    priority: int
    created_at: str
    started_at: str
    finished_at: str
    error: _scenes_pb2.Error
    progress: JobProgress
    artifacts: _containers.RepeatedScalarFieldContainer[str]
    metrics: _containers.ScalarMap[str, float]
    worker: str
    retry_of: str
    attempts: int
    owner: str
    private: bool
    def __init__(self, kind: _Optional[_Union[JobKind, str]] = ..., train: _Optional[_Union[TrainJob, _Mapping]] = ..., render: _Optional[_Union[RenderJob, _Mapping]] = ..., evaluate: _Optional[_Union[EvaluateJob, _Mapping]] = ..., compare: _Optional[_Union[CompareJob, _Mapping]] = ..., voxelize: _Optional[_Union[VoxelizeJob, _Mapping]] = ..., live: _Optional[_Union[LiveJob, _Mapping]] = ..., motion: _Optional[_Union[MotionJob, _Mapping]] = ..., id: _Optional[str] = ..., state: _Optional[_Union[JobState, str]] = ..., request_id: _Optional[str] = ..., priority: _Optional[int] = ..., created_at: _Optional[str] = ..., started_at: _Optional[str] = ..., finished_at: _Optional[str] = ..., error: _Optional[_Union[_scenes_pb2.Error, _Mapping]] = ..., progress: _Optional[_Union[JobProgress, _Mapping]] = ..., artifacts: _Optional[_Iterable[str]] = ..., metrics: _Optional[_Mapping[str, float]] = ..., worker: _Optional[str] = ..., retry_of: _Optional[str] = ..., attempts: _Optional[int] = ..., owner: _Optional[str] = ..., private: _Optional[bool] = ...) -> None: ...

class JobProgress(_message.Message):
    __slots__ = ("step", "steps", "loss", "val_psnr_db", "gaussians", "frames_done", "frames", "rate_per_s", "seconds_left", "waits_for", "method", "method_number", "methods", "phase")
    STEP_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    LOSS_FIELD_NUMBER: _ClassVar[int]
    VAL_PSNR_DB_FIELD_NUMBER: _ClassVar[int]
    GAUSSIANS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_DONE_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    RATE_PER_S_FIELD_NUMBER: _ClassVar[int]
    SECONDS_LEFT_FIELD_NUMBER: _ClassVar[int]
    WAITS_FOR_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    METHOD_NUMBER_FIELD_NUMBER: _ClassVar[int]
    METHODS_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    step: int
    steps: int
    loss: float
    val_psnr_db: float
    gaussians: int
    frames_done: int
    frames: int
    rate_per_s: float
    seconds_left: float
    waits_for: str
    method: str
    method_number: int
    methods: int
    phase: str
    def __init__(self, step: _Optional[int] = ..., steps: _Optional[int] = ..., loss: _Optional[float] = ..., val_psnr_db: _Optional[float] = ..., gaussians: _Optional[int] = ..., frames_done: _Optional[int] = ..., frames: _Optional[int] = ..., rate_per_s: _Optional[float] = ..., seconds_left: _Optional[float] = ..., waits_for: _Optional[str] = ..., method: _Optional[str] = ..., method_number: _Optional[int] = ..., methods: _Optional[int] = ..., phase: _Optional[str] = ...) -> None: ...

from ultragray_proto.v1 import geometry_pb2 as _geometry_pb2
from ultragray_proto.v1 import scenes_pb2 as _scenes_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Output(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    OUTPUT_UNSPECIFIED: _ClassVar[Output]
    OUTPUT_BMODE: _ClassVar[Output]
    OUTPUT_ECHO: _ClassVar[Output]
    OUTPUT_TRANSMITTANCE: _ClassVar[Output]
    OUTPUT_COVERAGE: _ClassVar[Output]
    OUTPUT_LABELS: _ClassVar[Output]
    OUTPUT_ATTENUATION: _ClassVar[Output]
    OUTPUT_UNCERTAINTY: _ClassVar[Output]

class Encoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ENCODING_UNSPECIFIED: _ClassVar[Encoding]
    ENCODING_UINT8: _ClassVar[Encoding]
    ENCODING_FLOAT32: _ClassVar[Encoding]
    ENCODING_PNG: _ClassVar[Encoding]
    ENCODING_JPEG: _ClassVar[Encoding]
    ENCODING_FLOAT16: _ClassVar[Encoding]

class Contact(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CONTACT_UNSPECIFIED: _ClassVar[Contact]
    CONTACT_AIR: _ClassVar[Contact]
    CONTACT_PRESSURE: _ClassVar[Contact]

class Speckle(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SPECKLE_UNSPECIFIED: _ClassVar[Speckle]
    SPECKLE_OFF: _ClassVar[Speckle]
    SPECKLE_NATURAL: _ClassVar[Speckle]

class SearchKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SEARCH_KIND_UNSPECIFIED: _ClassVar[SearchKind]
    SEARCH_KIND_NEAR: _ClassVar[SearchKind]
    SEARCH_KIND_TRACK: _ClassVar[SearchKind]
    SEARCH_KIND_ANYWHERE: _ClassVar[SearchKind]

class BelowConfidence(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    BELOW_CONFIDENCE_UNSPECIFIED: _ClassVar[BelowConfidence]
    BELOW_CONFIDENCE_REFUSE: _ClassVar[BelowConfidence]
    BELOW_CONFIDENCE_MASK: _ClassVar[BelowConfidence]

class StreamMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STREAM_MODE_UNSPECIFIED: _ClassVar[StreamMode]
    STREAM_MODE_ORDERED: _ClassVar[StreamMode]
    STREAM_MODE_LATEST: _ClassVar[StreamMode]
OUTPUT_UNSPECIFIED: Output
OUTPUT_BMODE: Output
OUTPUT_ECHO: Output
OUTPUT_TRANSMITTANCE: Output
OUTPUT_COVERAGE: Output
OUTPUT_LABELS: Output
OUTPUT_ATTENUATION: Output
OUTPUT_UNCERTAINTY: Output
ENCODING_UNSPECIFIED: Encoding
ENCODING_UINT8: Encoding
ENCODING_FLOAT32: Encoding
ENCODING_PNG: Encoding
ENCODING_JPEG: Encoding
ENCODING_FLOAT16: Encoding
CONTACT_UNSPECIFIED: Contact
CONTACT_AIR: Contact
CONTACT_PRESSURE: Contact
SPECKLE_UNSPECIFIED: Speckle
SPECKLE_OFF: Speckle
SPECKLE_NATURAL: Speckle
SEARCH_KIND_UNSPECIFIED: SearchKind
SEARCH_KIND_NEAR: SearchKind
SEARCH_KIND_TRACK: SearchKind
SEARCH_KIND_ANYWHERE: SearchKind
BELOW_CONFIDENCE_UNSPECIFIED: BelowConfidence
BELOW_CONFIDENCE_REFUSE: BelowConfidence
BELOW_CONFIDENCE_MASK: BelowConfidence
STREAM_MODE_UNSPECIFIED: StreamMode
STREAM_MODE_ORDERED: StreamMode
STREAM_MODE_LATEST: StreamMode

class RenderSettings(_message.Message):
    __slots__ = ("scene", "height", "width", "outputs", "encoding", "probe", "display", "min_confidence", "below_min_confidence", "slice_thickness_mm", "contact", "tools", "ghost", "registration", "speckle", "phase", "breathing", "indentation_mm")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    DISPLAY_FIELD_NUMBER: _ClassVar[int]
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    BELOW_MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    SLICE_THICKNESS_MM_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FIELD_NUMBER: _ClassVar[int]
    TOOLS_FIELD_NUMBER: _ClassVar[int]
    GHOST_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    SPECKLE_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    BREATHING_FIELD_NUMBER: _ClassVar[int]
    INDENTATION_MM_FIELD_NUMBER: _ClassVar[int]
    scene: str
    height: int
    width: int
    outputs: _containers.RepeatedScalarFieldContainer[Output]
    encoding: Encoding
    probe: _geometry_pb2.Probe
    display: Display
    min_confidence: float
    below_min_confidence: BelowConfidence
    slice_thickness_mm: float
    contact: Contact
    tools: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Tool]
    ghost: float
    registration: str
    speckle: Speckle
    phase: _containers.RepeatedScalarFieldContainer[float]
    breathing: _scenes_pb2.Breathing
    indentation_mm: float
    def __init__(self, scene: _Optional[str] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., outputs: _Optional[_Iterable[_Union[Output, str]]] = ..., encoding: _Optional[_Union[Encoding, str]] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., display: _Optional[_Union[Display, _Mapping]] = ..., min_confidence: _Optional[float] = ..., below_min_confidence: _Optional[_Union[BelowConfidence, str]] = ..., slice_thickness_mm: _Optional[float] = ..., contact: _Optional[_Union[Contact, str]] = ..., tools: _Optional[_Iterable[_Union[_geometry_pb2.Tool, _Mapping]]] = ..., ghost: _Optional[float] = ..., registration: _Optional[str] = ..., speckle: _Optional[_Union[Speckle, str]] = ..., phase: _Optional[_Iterable[float]] = ..., breathing: _Optional[_Union[_scenes_pb2.Breathing, _Mapping]] = ..., indentation_mm: _Optional[float] = ...) -> None: ...

class Extrapolation(_message.Message):
    __slots__ = ("distance_mm", "angle_deg", "confidence", "supported_share", "contact_share", "indentation_mm", "force_n")
    DISTANCE_MM_FIELD_NUMBER: _ClassVar[int]
    ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    SUPPORTED_SHARE_FIELD_NUMBER: _ClassVar[int]
    CONTACT_SHARE_FIELD_NUMBER: _ClassVar[int]
    INDENTATION_MM_FIELD_NUMBER: _ClassVar[int]
    FORCE_N_FIELD_NUMBER: _ClassVar[int]
    distance_mm: float
    angle_deg: float
    confidence: float
    supported_share: float
    contact_share: float
    indentation_mm: float
    force_n: float
    def __init__(self, distance_mm: _Optional[float] = ..., angle_deg: _Optional[float] = ..., confidence: _Optional[float] = ..., supported_share: _Optional[float] = ..., contact_share: _Optional[float] = ..., indentation_mm: _Optional[float] = ..., force_n: _Optional[float] = ...) -> None: ...

class AssessPosesRequest(_message.Message):
    __slots__ = ("scene", "poses", "probe", "registration")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    scene: str
    poses: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Pose]
    probe: _geometry_pb2.Probe
    registration: str
    def __init__(self, scene: _Optional[str] = ..., poses: _Optional[_Iterable[_Union[_geometry_pb2.Pose, _Mapping]]] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., registration: _Optional[str] = ...) -> None: ...

class AssessPosesResponse(_message.Message):
    __slots__ = ("extrapolations",)
    EXTRAPOLATIONS_FIELD_NUMBER: _ClassVar[int]
    extrapolations: _containers.RepeatedCompositeFieldContainer[Extrapolation]
    def __init__(self, extrapolations: _Optional[_Iterable[_Union[Extrapolation, _Mapping]]] = ...) -> None: ...

class LocalizeRequest(_message.Message):
    __slots__ = ("scene", "image", "image_height", "image_width", "start", "registration", "probe", "within_mm", "within_deg", "search")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    START_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    WITHIN_MM_FIELD_NUMBER: _ClassVar[int]
    WITHIN_DEG_FIELD_NUMBER: _ClassVar[int]
    SEARCH_FIELD_NUMBER: _ClassVar[int]
    scene: str
    image: bytes
    image_height: int
    image_width: int
    start: _geometry_pb2.Pose
    registration: str
    probe: _geometry_pb2.Probe
    within_mm: float
    within_deg: float
    search: SearchKind
    def __init__(self, scene: _Optional[str] = ..., image: _Optional[bytes] = ..., image_height: _Optional[int] = ..., image_width: _Optional[int] = ..., start: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., registration: _Optional[str] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., within_mm: _Optional[float] = ..., within_deg: _Optional[float] = ..., search: _Optional[_Union[SearchKind, str]] = ...) -> None: ...

class AlongAxes(_message.Message):
    __slots__ = ("lateral", "elevation", "axial")
    LATERAL_FIELD_NUMBER: _ClassVar[int]
    ELEVATION_FIELD_NUMBER: _ClassVar[int]
    AXIAL_FIELD_NUMBER: _ClassVar[int]
    lateral: float
    elevation: float
    axial: float
    def __init__(self, lateral: _Optional[float] = ..., elevation: _Optional[float] = ..., axial: _Optional[float] = ...) -> None: ...

class LocalizeResponse(_message.Message):
    __slots__ = ("scene", "scene_sha256", "renderer", "pose", "similarity", "is_found", "position_std_mm", "angle_std_deg", "shift_mm", "turn_deg", "queue_ms", "search_ms", "flange_to_base", "registration")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SCENE_SHA256_FIELD_NUMBER: _ClassVar[int]
    RENDERER_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    SIMILARITY_FIELD_NUMBER: _ClassVar[int]
    IS_FOUND_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_MM_FIELD_NUMBER: _ClassVar[int]
    ANGLE_STD_DEG_FIELD_NUMBER: _ClassVar[int]
    SHIFT_MM_FIELD_NUMBER: _ClassVar[int]
    TURN_DEG_FIELD_NUMBER: _ClassVar[int]
    QUEUE_MS_FIELD_NUMBER: _ClassVar[int]
    SEARCH_MS_FIELD_NUMBER: _ClassVar[int]
    FLANGE_TO_BASE_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    scene: str
    scene_sha256: str
    renderer: str
    pose: _geometry_pb2.Matrix
    similarity: float
    is_found: bool
    position_std_mm: AlongAxes
    angle_std_deg: AlongAxes
    shift_mm: float
    turn_deg: float
    queue_ms: float
    search_ms: float
    flange_to_base: _geometry_pb2.Matrix
    registration: str
    def __init__(self, scene: _Optional[str] = ..., scene_sha256: _Optional[str] = ..., renderer: _Optional[str] = ..., pose: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., similarity: _Optional[float] = ..., is_found: _Optional[bool] = ..., position_std_mm: _Optional[_Union[AlongAxes, _Mapping]] = ..., angle_std_deg: _Optional[_Union[AlongAxes, _Mapping]] = ..., shift_mm: _Optional[float] = ..., turn_deg: _Optional[float] = ..., queue_ms: _Optional[float] = ..., search_ms: _Optional[float] = ..., flange_to_base: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., registration: _Optional[str] = ...) -> None: ...

class PlanViewsRequest(_message.Message):
    __slots__ = ("scene", "poses", "view", "start", "registration", "probe", "want", "within_mm", "region_mm", "label", "plane", "views", "path_mm", "box_mm", "tilt_deg", "rock_deg", "turn_deg")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    START_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    WANT_FIELD_NUMBER: _ClassVar[int]
    WITHIN_MM_FIELD_NUMBER: _ClassVar[int]
    REGION_MM_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    PLANE_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    PATH_MM_FIELD_NUMBER: _ClassVar[int]
    BOX_MM_FIELD_NUMBER: _ClassVar[int]
    TILT_DEG_FIELD_NUMBER: _ClassVar[int]
    ROCK_DEG_FIELD_NUMBER: _ClassVar[int]
    TURN_DEG_FIELD_NUMBER: _ClassVar[int]
    scene: str
    poses: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Pose]
    view: _geometry_pb2.Pose
    start: _geometry_pb2.Pose
    registration: str
    probe: _geometry_pb2.Probe
    want: str
    within_mm: float
    region_mm: str
    label: int
    plane: _containers.RepeatedScalarFieldContainer[float]
    views: int
    path_mm: float
    box_mm: str
    tilt_deg: float
    rock_deg: float
    turn_deg: float
    def __init__(self, scene: _Optional[str] = ..., poses: _Optional[_Iterable[_Union[_geometry_pb2.Pose, _Mapping]]] = ..., view: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., start: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., registration: _Optional[str] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., want: _Optional[str] = ..., within_mm: _Optional[float] = ..., region_mm: _Optional[str] = ..., label: _Optional[int] = ..., plane: _Optional[_Iterable[float]] = ..., views: _Optional[int] = ..., path_mm: _Optional[float] = ..., box_mm: _Optional[str] = ..., tilt_deg: _Optional[float] = ..., rock_deg: _Optional[float] = ..., turn_deg: _Optional[float] = ...) -> None: ...

class PlannedView(_message.Message):
    __slots__ = ("pose", "flange_to_base", "gain", "rank")
    POSE_FIELD_NUMBER: _ClassVar[int]
    FLANGE_TO_BASE_FIELD_NUMBER: _ClassVar[int]
    GAIN_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    pose: _geometry_pb2.Matrix
    flange_to_base: _geometry_pb2.Matrix
    gain: float
    rank: int
    def __init__(self, pose: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., flange_to_base: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., gain: _Optional[float] = ..., rank: _Optional[int] = ...) -> None: ...

class PlanViewsResponse(_message.Message):
    __slots__ = ("scene", "scene_sha256", "views", "before", "after", "path_mm", "registration", "queue_ms", "plan_ms")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SCENE_SHA256_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    BEFORE_FIELD_NUMBER: _ClassVar[int]
    AFTER_FIELD_NUMBER: _ClassVar[int]
    PATH_MM_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    QUEUE_MS_FIELD_NUMBER: _ClassVar[int]
    PLAN_MS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    scene_sha256: str
    views: _containers.RepeatedCompositeFieldContainer[PlannedView]
    before: float
    after: float
    path_mm: float
    registration: str
    queue_ms: float
    plan_ms: float
    def __init__(self, scene: _Optional[str] = ..., scene_sha256: _Optional[str] = ..., views: _Optional[_Iterable[_Union[PlannedView, _Mapping]]] = ..., before: _Optional[float] = ..., after: _Optional[float] = ..., path_mm: _Optional[float] = ..., registration: _Optional[str] = ..., queue_ms: _Optional[float] = ..., plan_ms: _Optional[float] = ...) -> None: ...

class Display(_message.Message):
    __slots__ = ("gain_db", "dynamic_range_db", "tgc_db", "depth_mm", "flip", "pixel_mm", "edge", "gain_db_between", "dynamic_range_db_between", "display_seed")
    GAIN_DB_FIELD_NUMBER: _ClassVar[int]
    DYNAMIC_RANGE_DB_FIELD_NUMBER: _ClassVar[int]
    TGC_DB_FIELD_NUMBER: _ClassVar[int]
    DEPTH_MM_FIELD_NUMBER: _ClassVar[int]
    FLIP_FIELD_NUMBER: _ClassVar[int]
    PIXEL_MM_FIELD_NUMBER: _ClassVar[int]
    EDGE_FIELD_NUMBER: _ClassVar[int]
    GAIN_DB_BETWEEN_FIELD_NUMBER: _ClassVar[int]
    DYNAMIC_RANGE_DB_BETWEEN_FIELD_NUMBER: _ClassVar[int]
    DISPLAY_SEED_FIELD_NUMBER: _ClassVar[int]
    gain_db: float
    dynamic_range_db: float
    tgc_db: _containers.RepeatedScalarFieldContainer[float]
    depth_mm: float
    flip: bool
    pixel_mm: float
    edge: float
    gain_db_between: _containers.RepeatedScalarFieldContainer[float]
    dynamic_range_db_between: _containers.RepeatedScalarFieldContainer[float]
    display_seed: int
    def __init__(self, gain_db: _Optional[float] = ..., dynamic_range_db: _Optional[float] = ..., tgc_db: _Optional[_Iterable[float]] = ..., depth_mm: _Optional[float] = ..., flip: _Optional[bool] = ..., pixel_mm: _Optional[float] = ..., edge: _Optional[float] = ..., gain_db_between: _Optional[_Iterable[float]] = ..., dynamic_range_db_between: _Optional[_Iterable[float]] = ..., display_seed: _Optional[int] = ...) -> None: ...

class Picture(_message.Message):
    __slots__ = ("column_unit", "first_column", "first_row_mm", "column_step", "row_step_mm")
    COLUMN_UNIT_FIELD_NUMBER: _ClassVar[int]
    FIRST_COLUMN_FIELD_NUMBER: _ClassVar[int]
    FIRST_ROW_MM_FIELD_NUMBER: _ClassVar[int]
    COLUMN_STEP_FIELD_NUMBER: _ClassVar[int]
    ROW_STEP_MM_FIELD_NUMBER: _ClassVar[int]
    column_unit: str
    first_column: float
    first_row_mm: float
    column_step: float
    row_step_mm: float
    def __init__(self, column_unit: _Optional[str] = ..., first_column: _Optional[float] = ..., first_row_mm: _Optional[float] = ..., column_step: _Optional[float] = ..., row_step_mm: _Optional[float] = ...) -> None: ...

class RenderRequest(_message.Message):
    __slots__ = ("settings", "pose", "max_queue_ms")
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    MAX_QUEUE_MS_FIELD_NUMBER: _ClassVar[int]
    settings: RenderSettings
    pose: _geometry_pb2.Pose
    max_queue_ms: float
    def __init__(self, settings: _Optional[_Union[RenderSettings, _Mapping]] = ..., pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., max_queue_ms: _Optional[float] = ...) -> None: ...

class RenderBatchRequest(_message.Message):
    __slots__ = ("settings", "poses")
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    settings: RenderSettings
    poses: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Pose]
    def __init__(self, settings: _Optional[_Union[RenderSettings, _Mapping]] = ..., poses: _Optional[_Iterable[_Union[_geometry_pb2.Pose, _Mapping]]] = ...) -> None: ...

class RenderSliceRequest(_message.Message):
    __slots__ = ("scene", "slice")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SLICE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    slice: SliceSettings
    def __init__(self, scene: _Optional[str] = ..., slice: _Optional[_Union[SliceSettings, _Mapping]] = ...) -> None: ...

class SliceSettings(_message.Message):
    __slots__ = ("field", "origin_mm", "right", "down", "size_mm", "spacing_mm")
    FIELD_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_MM_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    DOWN_FIELD_NUMBER: _ClassVar[int]
    SIZE_MM_FIELD_NUMBER: _ClassVar[int]
    SPACING_MM_FIELD_NUMBER: _ClassVar[int]
    field: str
    origin_mm: _geometry_pb2.Position
    right: Direction
    down: Direction
    size_mm: SliceSize
    spacing_mm: float
    def __init__(self, field: _Optional[str] = ..., origin_mm: _Optional[_Union[_geometry_pb2.Position, _Mapping]] = ..., right: _Optional[_Union[Direction, _Mapping]] = ..., down: _Optional[_Union[Direction, _Mapping]] = ..., size_mm: _Optional[_Union[SliceSize, _Mapping]] = ..., spacing_mm: _Optional[float] = ...) -> None: ...

class Direction(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class SliceSize(_message.Message):
    __slots__ = ("width", "height")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    width: float
    height: float
    def __init__(self, width: _Optional[float] = ..., height: _Optional[float] = ...) -> None: ...

class Slice(_message.Message):
    __slots__ = ("data", "timings", "scene", "scene_sha256", "field", "height", "width", "encoding", "pixel_to_scene")
    DATA_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SCENE_SHA256_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    PIXEL_TO_SCENE_FIELD_NUMBER: _ClassVar[int]
    data: bytes
    timings: Timings
    scene: str
    scene_sha256: str
    field: str
    height: int
    width: int
    encoding: Encoding
    pixel_to_scene: _geometry_pb2.Matrix
    def __init__(self, data: _Optional[bytes] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ..., scene: _Optional[str] = ..., scene_sha256: _Optional[str] = ..., field: _Optional[str] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., encoding: _Optional[_Union[Encoding, str]] = ..., pixel_to_scene: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ...) -> None: ...

class SharedMemory(_message.Message):
    __slots__ = ("name", "token", "slots", "slot_bytes", "has_socket")
    NAME_FIELD_NUMBER: _ClassVar[int]
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    SLOT_BYTES_FIELD_NUMBER: _ClassVar[int]
    HAS_SOCKET_FIELD_NUMBER: _ClassVar[int]
    name: str
    token: bytes
    slots: int
    slot_bytes: int
    has_socket: bool
    def __init__(self, name: _Optional[str] = ..., token: _Optional[bytes] = ..., slots: _Optional[int] = ..., slot_bytes: _Optional[int] = ..., has_socket: _Optional[bool] = ...) -> None: ...

class RenderStreamRequest(_message.Message):
    __slots__ = ("sequence", "settings", "pose", "mode", "timeout_ms", "client_time_ns", "window", "acknowledged", "shared_memory", "predict_ms", "real", "clock")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_MS_FIELD_NUMBER: _ClassVar[int]
    CLIENT_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WINDOW_FIELD_NUMBER: _ClassVar[int]
    ACKNOWLEDGED_FIELD_NUMBER: _ClassVar[int]
    SHARED_MEMORY_FIELD_NUMBER: _ClassVar[int]
    PREDICT_MS_FIELD_NUMBER: _ClassVar[int]
    REAL_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    settings: RenderSettings
    pose: _geometry_pb2.Pose
    mode: StreamMode
    timeout_ms: float
    client_time_ns: int
    window: int
    acknowledged: int
    shared_memory: SharedMemory
    predict_ms: float
    real: RealFrame
    clock: ClockStamps
    def __init__(self, sequence: _Optional[int] = ..., settings: _Optional[_Union[RenderSettings, _Mapping]] = ..., pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., mode: _Optional[_Union[StreamMode, str]] = ..., timeout_ms: _Optional[float] = ..., client_time_ns: _Optional[int] = ..., window: _Optional[int] = ..., acknowledged: _Optional[int] = ..., shared_memory: _Optional[_Union[SharedMemory, _Mapping]] = ..., predict_ms: _Optional[float] = ..., real: _Optional[_Union[RealFrame, _Mapping]] = ..., clock: _Optional[_Union[ClockStamps, _Mapping]] = ...) -> None: ...

class Frame(_message.Message):
    __slots__ = ("sequence", "data", "shared_data", "timings", "error", "dropped", "client_time_ns", "prediction", "preview", "sent_ns", "clock", "scene", "scene_sha256", "renderer", "pose", "probe", "height", "width", "outputs", "encoding", "display", "picture", "rendered_height", "rendered_width", "extrapolation", "slice_thickness_mm", "contact", "tools", "ghost", "registration", "min_confidence", "below_min_confidence", "speckle", "phase", "indentation_mm")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    SHARED_DATA_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    DROPPED_FIELD_NUMBER: _ClassVar[int]
    CLIENT_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    PREDICTION_FIELD_NUMBER: _ClassVar[int]
    PREVIEW_FIELD_NUMBER: _ClassVar[int]
    SENT_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SCENE_SHA256_FIELD_NUMBER: _ClassVar[int]
    RENDERER_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    DISPLAY_FIELD_NUMBER: _ClassVar[int]
    PICTURE_FIELD_NUMBER: _ClassVar[int]
    RENDERED_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    RENDERED_WIDTH_FIELD_NUMBER: _ClassVar[int]
    EXTRAPOLATION_FIELD_NUMBER: _ClassVar[int]
    SLICE_THICKNESS_MM_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FIELD_NUMBER: _ClassVar[int]
    TOOLS_FIELD_NUMBER: _ClassVar[int]
    GHOST_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    BELOW_MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    SPECKLE_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    INDENTATION_MM_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    data: bytes
    shared_data: SharedData
    timings: Timings
    error: _scenes_pb2.Error
    dropped: int
    client_time_ns: int
    prediction: Prediction
    preview: Preview
    sent_ns: int
    clock: ClockOffset
    scene: str
    scene_sha256: str
    renderer: str
    pose: _geometry_pb2.Matrix
    probe: _geometry_pb2.Probe
    height: int
    width: int
    outputs: _containers.RepeatedScalarFieldContainer[Output]
    encoding: Encoding
    display: Display
    picture: Picture
    rendered_height: int
    rendered_width: int
    extrapolation: Extrapolation
    slice_thickness_mm: float
    contact: Contact
    tools: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Tool]
    ghost: float
    registration: str
    min_confidence: float
    below_min_confidence: BelowConfidence
    speckle: Speckle
    phase: _containers.RepeatedScalarFieldContainer[float]
    indentation_mm: float
    def __init__(self, sequence: _Optional[int] = ..., data: _Optional[bytes] = ..., shared_data: _Optional[_Union[SharedData, _Mapping]] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ..., error: _Optional[_Union[_scenes_pb2.Error, _Mapping]] = ..., dropped: _Optional[int] = ..., client_time_ns: _Optional[int] = ..., prediction: _Optional[_Union[Prediction, _Mapping]] = ..., preview: _Optional[_Union[Preview, _Mapping]] = ..., sent_ns: _Optional[int] = ..., clock: _Optional[_Union[ClockOffset, _Mapping]] = ..., scene: _Optional[str] = ..., scene_sha256: _Optional[str] = ..., renderer: _Optional[str] = ..., pose: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., outputs: _Optional[_Iterable[_Union[Output, str]]] = ..., encoding: _Optional[_Union[Encoding, str]] = ..., display: _Optional[_Union[Display, _Mapping]] = ..., picture: _Optional[_Union[Picture, _Mapping]] = ..., rendered_height: _Optional[int] = ..., rendered_width: _Optional[int] = ..., extrapolation: _Optional[_Union[Extrapolation, _Mapping]] = ..., slice_thickness_mm: _Optional[float] = ..., contact: _Optional[_Union[Contact, str]] = ..., tools: _Optional[_Iterable[_Union[_geometry_pb2.Tool, _Mapping]]] = ..., ghost: _Optional[float] = ..., registration: _Optional[str] = ..., min_confidence: _Optional[float] = ..., below_min_confidence: _Optional[_Union[BelowConfidence, str]] = ..., speckle: _Optional[_Union[Speckle, str]] = ..., phase: _Optional[_Iterable[float]] = ..., indentation_mm: _Optional[float] = ...) -> None: ...

class Prediction(_message.Message):
    __slots__ = ("ahead_ms", "error_mm", "error_deg")
    AHEAD_MS_FIELD_NUMBER: _ClassVar[int]
    ERROR_MM_FIELD_NUMBER: _ClassVar[int]
    ERROR_DEG_FIELD_NUMBER: _ClassVar[int]
    ahead_ms: float
    error_mm: float
    error_deg: float
    def __init__(self, ahead_ms: _Optional[float] = ..., error_mm: _Optional[float] = ..., error_deg: _Optional[float] = ...) -> None: ...

class RealFrame(_message.Message):
    __slots__ = ("client_time_ns", "image", "image_height", "image_width")
    CLIENT_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    client_time_ns: int
    image: bytes
    image_height: int
    image_width: int
    def __init__(self, client_time_ns: _Optional[int] = ..., image: _Optional[bytes] = ..., image_height: _Optional[int] = ..., image_width: _Optional[int] = ...) -> None: ...

class Preview(_message.Message):
    __slots__ = ("real_age_ms", "moved_mm", "is_real", "expected_error", "agreement", "trust", "offset_mm", "offset_deg", "disagrees")
    REAL_AGE_MS_FIELD_NUMBER: _ClassVar[int]
    MOVED_MM_FIELD_NUMBER: _ClassVar[int]
    IS_REAL_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_ERROR_FIELD_NUMBER: _ClassVar[int]
    AGREEMENT_FIELD_NUMBER: _ClassVar[int]
    TRUST_FIELD_NUMBER: _ClassVar[int]
    OFFSET_MM_FIELD_NUMBER: _ClassVar[int]
    OFFSET_DEG_FIELD_NUMBER: _ClassVar[int]
    DISAGREES_FIELD_NUMBER: _ClassVar[int]
    real_age_ms: float
    moved_mm: float
    is_real: bool
    expected_error: float
    agreement: float
    trust: float
    offset_mm: float
    offset_deg: float
    disagrees: bool
    def __init__(self, real_age_ms: _Optional[float] = ..., moved_mm: _Optional[float] = ..., is_real: _Optional[bool] = ..., expected_error: _Optional[float] = ..., agreement: _Optional[float] = ..., trust: _Optional[float] = ..., offset_mm: _Optional[float] = ..., offset_deg: _Optional[float] = ..., disagrees: _Optional[bool] = ...) -> None: ...

class ClockStamps(_message.Message):
    __slots__ = ("answer_sent_ns", "answer_arrived_ns", "sent_ns")
    ANSWER_SENT_NS_FIELD_NUMBER: _ClassVar[int]
    ANSWER_ARRIVED_NS_FIELD_NUMBER: _ClassVar[int]
    SENT_NS_FIELD_NUMBER: _ClassVar[int]
    answer_sent_ns: int
    answer_arrived_ns: int
    sent_ns: int
    def __init__(self, answer_sent_ns: _Optional[int] = ..., answer_arrived_ns: _Optional[int] = ..., sent_ns: _Optional[int] = ...) -> None: ...

class ClockOffset(_message.Message):
    __slots__ = ("offset_ms", "uncertainty_ms", "drift_ppm")
    OFFSET_MS_FIELD_NUMBER: _ClassVar[int]
    UNCERTAINTY_MS_FIELD_NUMBER: _ClassVar[int]
    DRIFT_PPM_FIELD_NUMBER: _ClassVar[int]
    offset_ms: float
    uncertainty_ms: float
    drift_ppm: float
    def __init__(self, offset_ms: _Optional[float] = ..., uncertainty_ms: _Optional[float] = ..., drift_ppm: _Optional[float] = ...) -> None: ...

class SharedData(_message.Message):
    __slots__ = ("slot", "bytes")
    SLOT_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    slot: int
    bytes: int
    def __init__(self, slot: _Optional[int] = ..., bytes: _Optional[int] = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("queue_ms", "render_ms", "encode_ms")
    QUEUE_MS_FIELD_NUMBER: _ClassVar[int]
    RENDER_MS_FIELD_NUMBER: _ClassVar[int]
    ENCODE_MS_FIELD_NUMBER: _ClassVar[int]
    queue_ms: float
    render_ms: float
    encode_ms: float
    def __init__(self, queue_ms: _Optional[float] = ..., render_ms: _Optional[float] = ..., encode_ms: _Optional[float] = ...) -> None: ...

from ultragray_proto.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ListScenesRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListScenesResponse(_message.Message):
    __slots__ = ("scenes", "next_page_token")
    SCENES_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    scenes: _containers.RepeatedCompositeFieldContainer[SceneEntry]
    next_page_token: str
    def __init__(self, scenes: _Optional[_Iterable[_Union[SceneEntry, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class SceneEntry(_message.Message):
    __slots__ = ("name", "loaded", "gaussian_count", "image_height", "image_width", "file_bytes", "error", "owner", "private", "probe_kind", "metrics", "changed_at")
    class MetricsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    NAME_FIELD_NUMBER: _ClassVar[int]
    LOADED_FIELD_NUMBER: _ClassVar[int]
    GAUSSIAN_COUNT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    FILE_BYTES_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    PROBE_KIND_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    CHANGED_AT_FIELD_NUMBER: _ClassVar[int]
    name: str
    loaded: bool
    gaussian_count: int
    image_height: int
    image_width: int
    file_bytes: int
    error: Error
    owner: str
    private: bool
    probe_kind: str
    metrics: _containers.ScalarMap[str, float]
    changed_at: str
    def __init__(self, name: _Optional[str] = ..., loaded: _Optional[bool] = ..., gaussian_count: _Optional[int] = ..., image_height: _Optional[int] = ..., image_width: _Optional[int] = ..., file_bytes: _Optional[int] = ..., error: _Optional[_Union[Error, _Mapping]] = ..., owner: _Optional[str] = ..., private: _Optional[bool] = ..., probe_kind: _Optional[str] = ..., metrics: _Optional[_Mapping[str, float]] = ..., changed_at: _Optional[str] = ...) -> None: ...

class GetSceneRequest(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    def __init__(self, scene: _Optional[str] = ...) -> None: ...

class Scene(_message.Message):
    __slots__ = ("bounds_min_mm", "bounds_max_mm", "name", "loaded", "loaded_processes", "file_bytes", "gaussian_count", "sh_degree", "intensity", "centre_mm", "probe", "image_height", "image_width", "training_poses", "metrics", "dataset_name", "dataset_sha256", "label_names", "confidence", "owner", "private", "beam", "speckle", "parents", "edits", "made_labels", "motion")
    class MetricsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    class LabelNamesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: int
        value: str
        def __init__(self, key: _Optional[int] = ..., value: _Optional[str] = ...) -> None: ...
    class ParentsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    BOUNDS_MIN_MM_FIELD_NUMBER: _ClassVar[int]
    BOUNDS_MAX_MM_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    LOADED_FIELD_NUMBER: _ClassVar[int]
    LOADED_PROCESSES_FIELD_NUMBER: _ClassVar[int]
    FILE_BYTES_FIELD_NUMBER: _ClassVar[int]
    GAUSSIAN_COUNT_FIELD_NUMBER: _ClassVar[int]
    SH_DEGREE_FIELD_NUMBER: _ClassVar[int]
    INTENSITY_FIELD_NUMBER: _ClassVar[int]
    CENTRE_MM_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    TRAINING_POSES_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    DATASET_NAME_FIELD_NUMBER: _ClassVar[int]
    DATASET_SHA256_FIELD_NUMBER: _ClassVar[int]
    LABEL_NAMES_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    BEAM_FIELD_NUMBER: _ClassVar[int]
    SPECKLE_FIELD_NUMBER: _ClassVar[int]
    PARENTS_FIELD_NUMBER: _ClassVar[int]
    EDITS_FIELD_NUMBER: _ClassVar[int]
    MADE_LABELS_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    bounds_min_mm: _geometry_pb2.Position
    bounds_max_mm: _geometry_pb2.Position
    name: str
    loaded: bool
    loaded_processes: int
    file_bytes: int
    gaussian_count: int
    sh_degree: int
    intensity: str
    centre_mm: _geometry_pb2.Position
    probe: _geometry_pb2.Probe
    image_height: int
    image_width: int
    training_poses: TrainingPoses
    metrics: _containers.ScalarMap[str, float]
    dataset_name: str
    dataset_sha256: str
    label_names: _containers.ScalarMap[int, str]
    confidence: ConfidenceFit
    owner: str
    private: bool
    beam: _geometry_pb2.ElevationBeam
    speckle: bool
    parents: _containers.ScalarMap[str, str]
    edits: _containers.RepeatedScalarFieldContainer[str]
    made_labels: _containers.RepeatedScalarFieldContainer[str]
    motion: Motion
    def __init__(self, bounds_min_mm: _Optional[_Union[_geometry_pb2.Position, _Mapping]] = ..., bounds_max_mm: _Optional[_Union[_geometry_pb2.Position, _Mapping]] = ..., name: _Optional[str] = ..., loaded: _Optional[bool] = ..., loaded_processes: _Optional[int] = ..., file_bytes: _Optional[int] = ..., gaussian_count: _Optional[int] = ..., sh_degree: _Optional[int] = ..., intensity: _Optional[str] = ..., centre_mm: _Optional[_Union[_geometry_pb2.Position, _Mapping]] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., image_height: _Optional[int] = ..., image_width: _Optional[int] = ..., training_poses: _Optional[_Union[TrainingPoses, _Mapping]] = ..., metrics: _Optional[_Mapping[str, float]] = ..., dataset_name: _Optional[str] = ..., dataset_sha256: _Optional[str] = ..., label_names: _Optional[_Mapping[int, str]] = ..., confidence: _Optional[_Union[ConfidenceFit, _Mapping]] = ..., owner: _Optional[str] = ..., private: _Optional[bool] = ..., beam: _Optional[_Union[_geometry_pb2.ElevationBeam, _Mapping]] = ..., speckle: _Optional[bool] = ..., parents: _Optional[_Mapping[str, str]] = ..., edits: _Optional[_Iterable[str]] = ..., made_labels: _Optional[_Iterable[str]] = ..., motion: _Optional[_Union[Motion, _Mapping]] = ...) -> None: ...

class Motion(_message.Message):
    __slots__ = ("modes", "origin_mm", "spacing_mm")
    MODES_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_MM_FIELD_NUMBER: _ClassVar[int]
    SPACING_MM_FIELD_NUMBER: _ClassVar[int]
    modes: _containers.RepeatedCompositeFieldContainer[Mode]
    origin_mm: _containers.RepeatedScalarFieldContainer[float]
    spacing_mm: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, modes: _Optional[_Iterable[_Union[Mode, _Mapping]]] = ..., origin_mm: _Optional[_Iterable[float]] = ..., spacing_mm: _Optional[_Iterable[float]] = ...) -> None: ...

class Mode(_message.Message):
    __slots__ = ("name", "low", "high", "rest", "unit", "surrogate")
    NAME_FIELD_NUMBER: _ClassVar[int]
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    REST_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    SURROGATE_FIELD_NUMBER: _ClassVar[int]
    name: str
    low: float
    high: float
    rest: float
    unit: str
    surrogate: str
    def __init__(self, name: _Optional[str] = ..., low: _Optional[float] = ..., high: _Optional[float] = ..., rest: _Optional[float] = ..., unit: _Optional[str] = ..., surrogate: _Optional[str] = ...) -> None: ...

class Breathing(_message.Message):
    __slots__ = ("period_s", "depth")
    PERIOD_S_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    period_s: float
    depth: float
    def __init__(self, period_s: _Optional[float] = ..., depth: _Optional[float] = ...) -> None: ...

class ConfidenceFit(_message.Message):
    __slots__ = ("error", "fitted_on")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    FITTED_ON_FIELD_NUMBER: _ClassVar[int]
    error: float
    fitted_on: int
    def __init__(self, error: _Optional[float] = ..., fitted_on: _Optional[int] = ...) -> None: ...

class TrainingPoses(_message.Message):
    __slots__ = ("count", "position_min_mm", "position_max_mm", "first", "middle", "last")
    COUNT_FIELD_NUMBER: _ClassVar[int]
    POSITION_MIN_MM_FIELD_NUMBER: _ClassVar[int]
    POSITION_MAX_MM_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    MIDDLE_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    count: int
    position_min_mm: _geometry_pb2.Position
    position_max_mm: _geometry_pb2.Position
    first: _geometry_pb2.Matrix
    middle: _geometry_pb2.Matrix
    last: _geometry_pb2.Matrix
    def __init__(self, count: _Optional[int] = ..., position_min_mm: _Optional[_Union[_geometry_pb2.Position, _Mapping]] = ..., position_max_mm: _Optional[_Union[_geometry_pb2.Position, _Mapping]] = ..., first: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., middle: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., last: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ...) -> None: ...

class LoadSceneRequest(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    def __init__(self, scene: _Optional[str] = ...) -> None: ...

class LoadSceneResponse(_message.Message):
    __slots__ = ("scene", "loaded_processes")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    LOADED_PROCESSES_FIELD_NUMBER: _ClassVar[int]
    scene: str
    loaded_processes: int
    def __init__(self, scene: _Optional[str] = ..., loaded_processes: _Optional[int] = ...) -> None: ...

class UnloadSceneRequest(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    def __init__(self, scene: _Optional[str] = ...) -> None: ...

class UnloadSceneResponse(_message.Message):
    __slots__ = ("scene", "loaded_processes")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    LOADED_PROCESSES_FIELD_NUMBER: _ClassVar[int]
    scene: str
    loaded_processes: int
    def __init__(self, scene: _Optional[str] = ..., loaded_processes: _Optional[int] = ...) -> None: ...

class LabelSceneRequest(_message.Message):
    __slots__ = ("scene", "frames", "probe", "label_map", "registration", "into", "replace", "private", "label_names", "within_mm")
    class LabelNamesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: int
        value: str
        def __init__(self, key: _Optional[int] = ..., value: _Optional[str] = ...) -> None: ...
    SCENE_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    LABEL_MAP_FIELD_NUMBER: _ClassVar[int]
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    INTO_FIELD_NUMBER: _ClassVar[int]
    REPLACE_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    LABEL_NAMES_FIELD_NUMBER: _ClassVar[int]
    WITHIN_MM_FIELD_NUMBER: _ClassVar[int]
    scene: str
    frames: _containers.RepeatedCompositeFieldContainer[PaintedFrame]
    probe: _geometry_pb2.Probe
    label_map: bytes
    registration: str
    into: str
    replace: bool
    private: bool
    label_names: _containers.ScalarMap[int, str]
    within_mm: float
    def __init__(self, scene: _Optional[str] = ..., frames: _Optional[_Iterable[_Union[PaintedFrame, _Mapping]]] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., label_map: _Optional[bytes] = ..., registration: _Optional[str] = ..., into: _Optional[str] = ..., replace: _Optional[bool] = ..., private: _Optional[bool] = ..., label_names: _Optional[_Mapping[int, str]] = ..., within_mm: _Optional[float] = ...) -> None: ...

class EditSceneRequest(_message.Message):
    __slots__ = ("scene", "into", "edits", "private")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    INTO_FIELD_NUMBER: _ClassVar[int]
    EDITS_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    into: str
    edits: _containers.RepeatedCompositeFieldContainer[Edit]
    private: bool
    def __init__(self, scene: _Optional[str] = ..., into: _Optional[str] = ..., edits: _Optional[_Iterable[_Union[Edit, _Mapping]]] = ..., private: _Optional[bool] = ...) -> None: ...

class MakeSceneRequest(_message.Message):
    __slots__ = ("probe", "frequency_mhz", "dynamic_range_db", "bodies", "label_map", "label_map_format", "ct", "ct_format", "towards", "along", "middle_mm", "sweep_mm", "pose_count", "image_size", "level", "compensated", "gaussian_count", "seed", "into", "private")
    PROBE_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_MHZ_FIELD_NUMBER: _ClassVar[int]
    DYNAMIC_RANGE_DB_FIELD_NUMBER: _ClassVar[int]
    BODIES_FIELD_NUMBER: _ClassVar[int]
    LABEL_MAP_FIELD_NUMBER: _ClassVar[int]
    LABEL_MAP_FORMAT_FIELD_NUMBER: _ClassVar[int]
    CT_FIELD_NUMBER: _ClassVar[int]
    CT_FORMAT_FIELD_NUMBER: _ClassVar[int]
    TOWARDS_FIELD_NUMBER: _ClassVar[int]
    ALONG_FIELD_NUMBER: _ClassVar[int]
    MIDDLE_MM_FIELD_NUMBER: _ClassVar[int]
    SWEEP_MM_FIELD_NUMBER: _ClassVar[int]
    POSE_COUNT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    COMPENSATED_FIELD_NUMBER: _ClassVar[int]
    GAUSSIAN_COUNT_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    INTO_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    probe: _geometry_pb2.Probe
    frequency_mhz: float
    dynamic_range_db: float
    bodies: _containers.RepeatedCompositeFieldContainer[TissueBody]
    label_map: str
    label_map_format: str
    ct: str
    ct_format: str
    towards: _containers.RepeatedScalarFieldContainer[float]
    along: _containers.RepeatedScalarFieldContainer[float]
    middle_mm: _containers.RepeatedScalarFieldContainer[float]
    sweep_mm: float
    pose_count: int
    image_size: int
    level: float
    compensated: float
    gaussian_count: int
    seed: int
    into: str
    private: bool
    def __init__(self, probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., frequency_mhz: _Optional[float] = ..., dynamic_range_db: _Optional[float] = ..., bodies: _Optional[_Iterable[_Union[TissueBody, _Mapping]]] = ..., label_map: _Optional[str] = ..., label_map_format: _Optional[str] = ..., ct: _Optional[str] = ..., ct_format: _Optional[str] = ..., towards: _Optional[_Iterable[float]] = ..., along: _Optional[_Iterable[float]] = ..., middle_mm: _Optional[_Iterable[float]] = ..., sweep_mm: _Optional[float] = ..., pose_count: _Optional[int] = ..., image_size: _Optional[int] = ..., level: _Optional[float] = ..., compensated: _Optional[float] = ..., gaussian_count: _Optional[int] = ..., seed: _Optional[int] = ..., into: _Optional[str] = ..., private: _Optional[bool] = ...) -> None: ...

class TissueBody(_message.Message):
    __slots__ = ("tissue", "label", "shape", "name", "echo_db", "attenuation", "impedance")
    TISSUE_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    ECHO_DB_FIELD_NUMBER: _ClassVar[int]
    ATTENUATION_FIELD_NUMBER: _ClassVar[int]
    IMPEDANCE_FIELD_NUMBER: _ClassVar[int]
    tissue: str
    label: int
    shape: Shape
    name: str
    echo_db: float
    attenuation: float
    impedance: float
    def __init__(self, tissue: _Optional[str] = ..., label: _Optional[int] = ..., shape: _Optional[_Union[Shape, _Mapping]] = ..., name: _Optional[str] = ..., echo_db: _Optional[float] = ..., attenuation: _Optional[float] = ..., impedance: _Optional[float] = ...) -> None: ...

class Edit(_message.Message):
    __slots__ = ("move", "cut", "merge", "insert", "lesions", "relabel", "thin")
    MOVE_FIELD_NUMBER: _ClassVar[int]
    CUT_FIELD_NUMBER: _ClassVar[int]
    MERGE_FIELD_NUMBER: _ClassVar[int]
    INSERT_FIELD_NUMBER: _ClassVar[int]
    LESIONS_FIELD_NUMBER: _ClassVar[int]
    RELABEL_FIELD_NUMBER: _ClassVar[int]
    THIN_FIELD_NUMBER: _ClassVar[int]
    move: MoveEdit
    cut: CutEdit
    merge: MergeEdit
    insert: InsertEdit
    lesions: LesionsEdit
    relabel: RelabelEdit
    thin: ThinEdit
    def __init__(self, move: _Optional[_Union[MoveEdit, _Mapping]] = ..., cut: _Optional[_Union[CutEdit, _Mapping]] = ..., merge: _Optional[_Union[MergeEdit, _Mapping]] = ..., insert: _Optional[_Union[InsertEdit, _Mapping]] = ..., lesions: _Optional[_Union[LesionsEdit, _Mapping]] = ..., relabel: _Optional[_Union[RelabelEdit, _Mapping]] = ..., thin: _Optional[_Union[ThinEdit, _Mapping]] = ...) -> None: ...

class MoveEdit(_message.Message):
    __slots__ = ("shift_mm", "turn_deg", "about_mm", "shape")
    SHIFT_MM_FIELD_NUMBER: _ClassVar[int]
    TURN_DEG_FIELD_NUMBER: _ClassVar[int]
    ABOUT_MM_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    shift_mm: _containers.RepeatedScalarFieldContainer[float]
    turn_deg: _containers.RepeatedScalarFieldContainer[float]
    about_mm: _containers.RepeatedScalarFieldContainer[float]
    shape: Shape
    def __init__(self, shift_mm: _Optional[_Iterable[float]] = ..., turn_deg: _Optional[_Iterable[float]] = ..., about_mm: _Optional[_Iterable[float]] = ..., shape: _Optional[_Union[Shape, _Mapping]] = ...) -> None: ...

class CutEdit(_message.Message):
    __slots__ = ("shape", "keep")
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    KEEP_FIELD_NUMBER: _ClassVar[int]
    shape: Shape
    keep: str
    def __init__(self, shape: _Optional[_Union[Shape, _Mapping]] = ..., keep: _Optional[str] = ...) -> None: ...

class MergeEdit(_message.Message):
    __slots__ = ("shift_mm", "turn_deg", "about_mm", "scene", "register", "match_gain", "seam_mm", "fit_steps")
    SHIFT_MM_FIELD_NUMBER: _ClassVar[int]
    TURN_DEG_FIELD_NUMBER: _ClassVar[int]
    ABOUT_MM_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    REGISTER_FIELD_NUMBER: _ClassVar[int]
    MATCH_GAIN_FIELD_NUMBER: _ClassVar[int]
    SEAM_MM_FIELD_NUMBER: _ClassVar[int]
    FIT_STEPS_FIELD_NUMBER: _ClassVar[int]
    shift_mm: _containers.RepeatedScalarFieldContainer[float]
    turn_deg: _containers.RepeatedScalarFieldContainer[float]
    about_mm: _containers.RepeatedScalarFieldContainer[float]
    scene: str
    register: bool
    match_gain: bool
    seam_mm: float
    fit_steps: int
    def __init__(self, shift_mm: _Optional[_Iterable[float]] = ..., turn_deg: _Optional[_Iterable[float]] = ..., about_mm: _Optional[_Iterable[float]] = ..., scene: _Optional[str] = ..., register: _Optional[bool] = ..., match_gain: _Optional[bool] = ..., seam_mm: _Optional[float] = ..., fit_steps: _Optional[int] = ...) -> None: ...

class InsertEdit(_message.Message):
    __slots__ = ("frequency_mhz", "dynamic_range_db", "shape", "tissue", "label", "echo_db", "attenuation", "texture_from_mm", "wall_mm", "seed")
    FREQUENCY_MHZ_FIELD_NUMBER: _ClassVar[int]
    DYNAMIC_RANGE_DB_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    TISSUE_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    ECHO_DB_FIELD_NUMBER: _ClassVar[int]
    ATTENUATION_FIELD_NUMBER: _ClassVar[int]
    TEXTURE_FROM_MM_FIELD_NUMBER: _ClassVar[int]
    WALL_MM_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    frequency_mhz: float
    dynamic_range_db: float
    shape: Shape
    tissue: str
    label: str
    echo_db: float
    attenuation: float
    texture_from_mm: _containers.RepeatedScalarFieldContainer[float]
    wall_mm: float
    seed: int
    def __init__(self, frequency_mhz: _Optional[float] = ..., dynamic_range_db: _Optional[float] = ..., shape: _Optional[_Union[Shape, _Mapping]] = ..., tissue: _Optional[str] = ..., label: _Optional[str] = ..., echo_db: _Optional[float] = ..., attenuation: _Optional[float] = ..., texture_from_mm: _Optional[_Iterable[float]] = ..., wall_mm: _Optional[float] = ..., seed: _Optional[int] = ...) -> None: ...

class LesionsEdit(_message.Message):
    __slots__ = ("frequency_mhz", "dynamic_range_db", "count", "tissues", "radius_min_mm", "radius_max_mm", "seed")
    FREQUENCY_MHZ_FIELD_NUMBER: _ClassVar[int]
    DYNAMIC_RANGE_DB_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    TISSUES_FIELD_NUMBER: _ClassVar[int]
    RADIUS_MIN_MM_FIELD_NUMBER: _ClassVar[int]
    RADIUS_MAX_MM_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    frequency_mhz: float
    dynamic_range_db: float
    count: int
    tissues: _containers.RepeatedScalarFieldContainer[str]
    radius_min_mm: float
    radius_max_mm: float
    seed: int
    def __init__(self, frequency_mhz: _Optional[float] = ..., dynamic_range_db: _Optional[float] = ..., count: _Optional[int] = ..., tissues: _Optional[_Iterable[str]] = ..., radius_min_mm: _Optional[float] = ..., radius_max_mm: _Optional[float] = ..., seed: _Optional[int] = ...) -> None: ...

class RelabelEdit(_message.Message):
    __slots__ = ("shapes", "label")
    SHAPES_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    shapes: _containers.RepeatedCompositeFieldContainer[Shape]
    label: str
    def __init__(self, shapes: _Optional[_Iterable[_Union[Shape, _Mapping]]] = ..., label: _Optional[str] = ...) -> None: ...

class ThinEdit(_message.Message):
    __slots__ = ("gaussian_count", "file_bytes")
    GAUSSIAN_COUNT_FIELD_NUMBER: _ClassVar[int]
    FILE_BYTES_FIELD_NUMBER: _ClassVar[int]
    gaussian_count: int
    file_bytes: int
    def __init__(self, gaussian_count: _Optional[int] = ..., file_bytes: _Optional[int] = ...) -> None: ...

class Shape(_message.Message):
    __slots__ = ("sphere", "ellipsoid", "box", "tube", "mesh", "map", "label")
    SPHERE_FIELD_NUMBER: _ClassVar[int]
    ELLIPSOID_FIELD_NUMBER: _ClassVar[int]
    BOX_FIELD_NUMBER: _ClassVar[int]
    TUBE_FIELD_NUMBER: _ClassVar[int]
    MESH_FIELD_NUMBER: _ClassVar[int]
    MAP_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    sphere: SphereShape
    ellipsoid: EllipsoidShape
    box: BoxShape
    tube: TubeShape
    mesh: MeshShape
    map: MapShape
    label: LabelShape
    def __init__(self, sphere: _Optional[_Union[SphereShape, _Mapping]] = ..., ellipsoid: _Optional[_Union[EllipsoidShape, _Mapping]] = ..., box: _Optional[_Union[BoxShape, _Mapping]] = ..., tube: _Optional[_Union[TubeShape, _Mapping]] = ..., mesh: _Optional[_Union[MeshShape, _Mapping]] = ..., map: _Optional[_Union[MapShape, _Mapping]] = ..., label: _Optional[_Union[LabelShape, _Mapping]] = ...) -> None: ...

class SphereShape(_message.Message):
    __slots__ = ("centre_mm", "radius_mm")
    CENTRE_MM_FIELD_NUMBER: _ClassVar[int]
    RADIUS_MM_FIELD_NUMBER: _ClassVar[int]
    centre_mm: _containers.RepeatedScalarFieldContainer[float]
    radius_mm: float
    def __init__(self, centre_mm: _Optional[_Iterable[float]] = ..., radius_mm: _Optional[float] = ...) -> None: ...

class EllipsoidShape(_message.Message):
    __slots__ = ("centre_mm", "radii_mm", "turn_deg")
    CENTRE_MM_FIELD_NUMBER: _ClassVar[int]
    RADII_MM_FIELD_NUMBER: _ClassVar[int]
    TURN_DEG_FIELD_NUMBER: _ClassVar[int]
    centre_mm: _containers.RepeatedScalarFieldContainer[float]
    radii_mm: _containers.RepeatedScalarFieldContainer[float]
    turn_deg: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, centre_mm: _Optional[_Iterable[float]] = ..., radii_mm: _Optional[_Iterable[float]] = ..., turn_deg: _Optional[_Iterable[float]] = ...) -> None: ...

class BoxShape(_message.Message):
    __slots__ = ("min_mm", "max_mm")
    MIN_MM_FIELD_NUMBER: _ClassVar[int]
    MAX_MM_FIELD_NUMBER: _ClassVar[int]
    min_mm: _containers.RepeatedScalarFieldContainer[float]
    max_mm: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, min_mm: _Optional[_Iterable[float]] = ..., max_mm: _Optional[_Iterable[float]] = ...) -> None: ...

class MeshShape(_message.Message):
    __slots__ = ("data", "format")
    DATA_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    data: str
    format: str
    def __init__(self, data: _Optional[str] = ..., format: _Optional[str] = ...) -> None: ...

class MapShape(_message.Message):
    __slots__ = ("data", "format", "label")
    DATA_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    data: str
    format: str
    label: int
    def __init__(self, data: _Optional[str] = ..., format: _Optional[str] = ..., label: _Optional[int] = ...) -> None: ...

class LabelShape(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class TubeShape(_message.Message):
    __slots__ = ("points_mm", "radius_mm")
    POINTS_MM_FIELD_NUMBER: _ClassVar[int]
    RADIUS_MM_FIELD_NUMBER: _ClassVar[int]
    points_mm: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Position]
    radius_mm: float
    def __init__(self, points_mm: _Optional[_Iterable[_Union[_geometry_pb2.Position, _Mapping]]] = ..., radius_mm: _Optional[float] = ...) -> None: ...

class PaintedFrame(_message.Message):
    __slots__ = ("pose", "labels")
    POSE_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    pose: _geometry_pb2.Pose
    labels: bytes
    def __init__(self, pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., labels: _Optional[bytes] = ...) -> None: ...

class Error(_message.Message):
    __slots__ = ("reason", "field", "detail")
    REASON_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    reason: str
    field: str
    detail: str
    def __init__(self, reason: _Optional[str] = ..., field: _Optional[str] = ..., detail: _Optional[str] = ...) -> None: ...

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

class Encoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ENCODING_UNSPECIFIED: _ClassVar[Encoding]
    ENCODING_UINT8: _ClassVar[Encoding]
    ENCODING_FLOAT32: _ClassVar[Encoding]
    ENCODING_PNG: _ClassVar[Encoding]
    ENCODING_JPEG: _ClassVar[Encoding]
OUTPUT_UNSPECIFIED: Output
OUTPUT_BMODE: Output
OUTPUT_ECHO: Output
OUTPUT_TRANSMITTANCE: Output
OUTPUT_COVERAGE: Output
ENCODING_UNSPECIFIED: Encoding
ENCODING_UINT8: Encoding
ENCODING_FLOAT32: Encoding
ENCODING_PNG: Encoding
ENCODING_JPEG: Encoding

class RenderSettings(_message.Message):
    __slots__ = ("scene", "height", "width", "outputs", "encoding", "probe")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    height: int
    width: int
    outputs: _containers.RepeatedScalarFieldContainer[Output]
    encoding: Encoding
    probe: _geometry_pb2.Probe
    def __init__(self, scene: _Optional[str] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., outputs: _Optional[_Iterable[_Union[Output, str]]] = ..., encoding: _Optional[_Union[Encoding, str]] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ...) -> None: ...

class RenderRequest(_message.Message):
    __slots__ = ("settings", "pose")
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    settings: RenderSettings
    pose: _geometry_pb2.Pose
    def __init__(self, settings: _Optional[_Union[RenderSettings, _Mapping]] = ..., pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ...) -> None: ...

class RenderBatchRequest(_message.Message):
    __slots__ = ("settings", "poses")
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    settings: RenderSettings
    poses: _containers.RepeatedCompositeFieldContainer[_geometry_pb2.Pose]
    def __init__(self, settings: _Optional[_Union[RenderSettings, _Mapping]] = ..., poses: _Optional[_Iterable[_Union[_geometry_pb2.Pose, _Mapping]]] = ...) -> None: ...

class RenderStreamRequest(_message.Message):
    __slots__ = ("sequence", "settings", "pose")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    settings: RenderSettings
    pose: _geometry_pb2.Pose
    def __init__(self, sequence: _Optional[int] = ..., settings: _Optional[_Union[RenderSettings, _Mapping]] = ..., pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ...) -> None: ...

class Frame(_message.Message):
    __slots__ = ("sequence", "scene", "scene_sha256", "renderer", "pose", "probe", "height", "width", "outputs", "encoding", "data", "timings", "error")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SCENE_SHA256_FIELD_NUMBER: _ClassVar[int]
    RENDERER_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    scene: str
    scene_sha256: str
    renderer: str
    pose: _geometry_pb2.Matrix
    probe: _geometry_pb2.Probe
    height: int
    width: int
    outputs: _containers.RepeatedScalarFieldContainer[Output]
    encoding: Encoding
    data: bytes
    timings: Timings
    error: _scenes_pb2.Error
    def __init__(self, sequence: _Optional[int] = ..., scene: _Optional[str] = ..., scene_sha256: _Optional[str] = ..., renderer: _Optional[str] = ..., pose: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., outputs: _Optional[_Iterable[_Union[Output, str]]] = ..., encoding: _Optional[_Union[Encoding, str]] = ..., data: _Optional[bytes] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ..., error: _Optional[_Union[_scenes_pb2.Error, _Mapping]] = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("queue_ms", "render_ms", "encode_ms")
    QUEUE_MS_FIELD_NUMBER: _ClassVar[int]
    RENDER_MS_FIELD_NUMBER: _ClassVar[int]
    ENCODE_MS_FIELD_NUMBER: _ClassVar[int]
    queue_ms: float
    render_ms: float
    encode_ms: float
    def __init__(self, queue_ms: _Optional[float] = ..., render_ms: _Optional[float] = ..., encode_ms: _Optional[float] = ...) -> None: ...

from ultragray_proto.v1 import datasets_pb2 as _datasets_pb2
from ultragray_proto.v1 import geometry_pb2 as _geometry_pb2
from ultragray_proto.v1 import scenes_pb2 as _scenes_pb2
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class BeginRecordingRequest(_message.Message):
    __slots__ = ("dataset", "settings", "private")
    DATASET_FIELD_NUMBER: _ClassVar[int]
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    settings: RecordingSettings
    private: bool
    def __init__(self, dataset: _Optional[str] = ..., settings: _Optional[_Union[RecordingSettings, _Mapping]] = ..., private: _Optional[bool] = ...) -> None: ...

class RecordingSettings(_message.Message):
    __slots__ = ("probe", "image_height", "image_width")
    PROBE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    probe: _geometry_pb2.Probe
    image_height: int
    image_width: int
    def __init__(self, probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., image_height: _Optional[int] = ..., image_width: _Optional[int] = ...) -> None: ...

class Recording(_message.Message):
    __slots__ = ("name", "settings", "frames", "next_number", "bytes", "created_at", "owner", "private")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    NEXT_NUMBER_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    name: str
    settings: RecordingSettings
    frames: int
    next_number: int
    bytes: int
    created_at: str
    owner: str
    private: bool
    def __init__(self, name: _Optional[str] = ..., settings: _Optional[_Union[RecordingSettings, _Mapping]] = ..., frames: _Optional[int] = ..., next_number: _Optional[int] = ..., bytes: _Optional[int] = ..., created_at: _Optional[str] = ..., owner: _Optional[str] = ..., private: _Optional[bool] = ...) -> None: ...

class GetRecordingRequest(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

class RecordFramesRequest(_message.Message):
    __slots__ = ("dataset", "frame")
    DATASET_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    frame: IncomingFrame
    def __init__(self, dataset: _Optional[str] = ..., frame: _Optional[_Union[IncomingFrame, _Mapping]] = ...) -> None: ...

class IncomingFrame(_message.Message):
    __slots__ = ("number", "pose", "time_s", "image")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    TIME_S_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    number: int
    pose: _geometry_pb2.Pose
    time_s: float
    image: bytes
    def __init__(self, number: _Optional[int] = ..., pose: _Optional[_Union[_geometry_pb2.Pose, _Mapping]] = ..., time_s: _Optional[float] = ..., image: _Optional[bytes] = ...) -> None: ...

class RecordFramesResponse(_message.Message):
    __slots__ = ("recording", "refused_number", "error")
    RECORDING_FIELD_NUMBER: _ClassVar[int]
    REFUSED_NUMBER_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    recording: Recording
    refused_number: int
    error: _scenes_pb2.Error
    def __init__(self, recording: _Optional[_Union[Recording, _Mapping]] = ..., refused_number: _Optional[int] = ..., error: _Optional[_Union[_scenes_pb2.Error, _Mapping]] = ...) -> None: ...

class FinishRecordingRequest(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

class DeleteRecordingRequest(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

class DeleteRecordingResponse(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

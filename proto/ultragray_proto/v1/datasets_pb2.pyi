from ultragray_proto.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class UploadDatasetRequest(_message.Message):
    __slots__ = ("header", "file", "chunk")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FILE_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: UploadHeader
    file: str
    chunk: bytes
    def __init__(self, header: _Optional[_Union[UploadHeader, _Mapping]] = ..., file: _Optional[str] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class UploadHeader(_message.Message):
    __slots__ = ("dataset", "options", "archive", "private")
    DATASET_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    ARCHIVE_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    options: DatasetOptions
    archive: bool
    private: bool
    def __init__(self, dataset: _Optional[str] = ..., options: _Optional[_Union[DatasetOptions, _Mapping]] = ..., archive: _Optional[bool] = ..., private: _Optional[bool] = ...) -> None: ...

class DatasetOptions(_message.Message):
    __slots__ = ("crop", "image_size", "frames", "train_frames", "val_frames", "fan", "transform", "image_topic", "pose_topic", "image_delay_ms")
    CROP_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    TRAIN_FRAMES_FIELD_NUMBER: _ClassVar[int]
    VAL_FRAMES_FIELD_NUMBER: _ClassVar[int]
    FAN_FIELD_NUMBER: _ClassVar[int]
    TRANSFORM_FIELD_NUMBER: _ClassVar[int]
    IMAGE_TOPIC_FIELD_NUMBER: _ClassVar[int]
    POSE_TOPIC_FIELD_NUMBER: _ClassVar[int]
    IMAGE_DELAY_MS_FIELD_NUMBER: _ClassVar[int]
    crop: str
    image_size: str
    frames: str
    train_frames: str
    val_frames: str
    fan: str
    transform: str
    image_topic: str
    pose_topic: str
    image_delay_ms: str
    def __init__(self, crop: _Optional[str] = ..., image_size: _Optional[str] = ..., frames: _Optional[str] = ..., train_frames: _Optional[str] = ..., val_frames: _Optional[str] = ..., fan: _Optional[str] = ..., transform: _Optional[str] = ..., image_topic: _Optional[str] = ..., pose_topic: _Optional[str] = ..., image_delay_ms: _Optional[str] = ...) -> None: ...

class UploadDatasetResponse(_message.Message):
    __slots__ = ("dataset", "created")
    DATASET_FIELD_NUMBER: _ClassVar[int]
    CREATED_FIELD_NUMBER: _ClassVar[int]
    dataset: Dataset
    created: bool
    def __init__(self, dataset: _Optional[_Union[Dataset, _Mapping]] = ..., created: _Optional[bool] = ...) -> None: ...

class Dataset(_message.Message):
    __slots__ = ("kind", "name", "sha256", "bytes", "created_at", "train_frames", "val_frames", "height", "width", "probe", "warnings", "options", "owner", "private", "region")
    KIND_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    TRAIN_FRAMES_FIELD_NUMBER: _ClassVar[int]
    VAL_FRAMES_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    PROBE_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    PRIVATE_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    kind: str
    name: str
    sha256: str
    bytes: int
    created_at: str
    train_frames: int
    val_frames: int
    height: int
    width: int
    probe: _geometry_pb2.Probe
    warnings: _containers.RepeatedScalarFieldContainer[str]
    options: DatasetOptions
    owner: str
    private: bool
    region: ImageRegion
    def __init__(self, kind: _Optional[str] = ..., name: _Optional[str] = ..., sha256: _Optional[str] = ..., bytes: _Optional[int] = ..., created_at: _Optional[str] = ..., train_frames: _Optional[int] = ..., val_frames: _Optional[int] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., probe: _Optional[_Union[_geometry_pb2.Probe, _Mapping]] = ..., warnings: _Optional[_Iterable[str]] = ..., options: _Optional[_Union[DatasetOptions, _Mapping]] = ..., owner: _Optional[str] = ..., private: _Optional[bool] = ..., region: _Optional[_Union[ImageRegion, _Mapping]] = ...) -> None: ...

class ImageRegion(_message.Message):
    __slots__ = ("image_width", "image_height", "left", "top", "width", "height", "lateral_mm", "axial_mm", "image_to_probe")
    IMAGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    IMAGE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    TOP_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    LATERAL_MM_FIELD_NUMBER: _ClassVar[int]
    AXIAL_MM_FIELD_NUMBER: _ClassVar[int]
    IMAGE_TO_PROBE_FIELD_NUMBER: _ClassVar[int]
    image_width: int
    image_height: int
    left: int
    top: int
    width: int
    height: int
    lateral_mm: float
    axial_mm: float
    image_to_probe: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, image_width: _Optional[int] = ..., image_height: _Optional[int] = ..., left: _Optional[int] = ..., top: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., lateral_mm: _Optional[float] = ..., axial_mm: _Optional[float] = ..., image_to_probe: _Optional[_Iterable[float]] = ...) -> None: ...

class ListDatasetsRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListDatasetsResponse(_message.Message):
    __slots__ = ("datasets", "next_page_token")
    DATASETS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    datasets: _containers.RepeatedCompositeFieldContainer[Dataset]
    next_page_token: str
    def __init__(self, datasets: _Optional[_Iterable[_Union[Dataset, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class GetDatasetRequest(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

class GetContactSheetRequest(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

class GetContactSheetResponse(_message.Message):
    __slots__ = ("png",)
    PNG_FIELD_NUMBER: _ClassVar[int]
    png: bytes
    def __init__(self, png: _Optional[bytes] = ...) -> None: ...

class DeleteDatasetRequest(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

class DeleteDatasetResponse(_message.Message):
    __slots__ = ("dataset",)
    DATASET_FIELD_NUMBER: _ClassVar[int]
    dataset: str
    def __init__(self, dataset: _Optional[str] = ...) -> None: ...

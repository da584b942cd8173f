from ultragray_proto.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Registration(_message.Message):
    __slots__ = ("name", "scene", "base_to_scene", "probe_to_flange", "residual_mm", "residual_deg", "position_std_mm", "angle_std_deg", "owner", "changed_at")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    BASE_TO_SCENE_FIELD_NUMBER: _ClassVar[int]
    PROBE_TO_FLANGE_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_MM_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_DEG_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_MM_FIELD_NUMBER: _ClassVar[int]
    ANGLE_STD_DEG_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    CHANGED_AT_FIELD_NUMBER: _ClassVar[int]
    name: str
    scene: str
    base_to_scene: _geometry_pb2.Matrix
    probe_to_flange: _geometry_pb2.Matrix
    residual_mm: float
    residual_deg: float
    position_std_mm: _geometry_pb2.Position
    angle_std_deg: AxisTurns
    owner: str
    changed_at: str
    def __init__(self, name: _Optional[str] = ..., scene: _Optional[str] = ..., base_to_scene: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., probe_to_flange: _Optional[_Union[_geometry_pb2.Matrix, _Mapping]] = ..., residual_mm: _Optional[float] = ..., residual_deg: _Optional[float] = ..., position_std_mm: _Optional[_Union[_geometry_pb2.Position, _Mapping]] = ..., angle_std_deg: _Optional[_Union[AxisTurns, _Mapping]] = ..., owner: _Optional[str] = ..., changed_at: _Optional[str] = ...) -> None: ...

class AxisTurns(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class ListRegistrationsRequest(_message.Message):
    __slots__ = ("page_size", "page_token")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class ListRegistrationsResponse(_message.Message):
    __slots__ = ("registrations", "next_page_token")
    REGISTRATIONS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    registrations: _containers.RepeatedCompositeFieldContainer[Registration]
    next_page_token: str
    def __init__(self, registrations: _Optional[_Iterable[_Union[Registration, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class GetRegistrationRequest(_message.Message):
    __slots__ = ("registration",)
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    registration: str
    def __init__(self, registration: _Optional[str] = ...) -> None: ...

class PutRegistrationRequest(_message.Message):
    __slots__ = ("registration", "content")
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    CONTENT_FIELD_NUMBER: _ClassVar[int]
    registration: str
    content: Registration
    def __init__(self, registration: _Optional[str] = ..., content: _Optional[_Union[Registration, _Mapping]] = ...) -> None: ...

class DeleteRegistrationRequest(_message.Message):
    __slots__ = ("registration",)
    REGISTRATION_FIELD_NUMBER: _ClassVar[int]
    registration: str
    def __init__(self, registration: _Optional[str] = ...) -> None: ...

class DeleteRegistrationResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

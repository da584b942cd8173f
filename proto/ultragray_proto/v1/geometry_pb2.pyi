from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ToolFrame(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TOOL_FRAME_UNSPECIFIED: _ClassVar[ToolFrame]
    TOOL_FRAME_SCENE: _ClassVar[ToolFrame]
    TOOL_FRAME_PROBE: _ClassVar[ToolFrame]
TOOL_FRAME_UNSPECIFIED: ToolFrame
TOOL_FRAME_SCENE: ToolFrame
TOOL_FRAME_PROBE: ToolFrame

class Position(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("w", "x", "y", "z")
    W_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    w: float
    x: float
    y: float
    z: float
    def __init__(self, w: _Optional[float] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Matrix(_message.Message):
    __slots__ = ("values",)
    VALUES_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, values: _Optional[_Iterable[float]] = ...) -> None: ...

class Placement(_message.Message):
    __slots__ = ("position_mm", "quaternion")
    POSITION_MM_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_FIELD_NUMBER: _ClassVar[int]
    position_mm: Position
    quaternion: Quaternion
    def __init__(self, position_mm: _Optional[_Union[Position, _Mapping]] = ..., quaternion: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("matrix", "placement")
    MATRIX_FIELD_NUMBER: _ClassVar[int]
    PLACEMENT_FIELD_NUMBER: _ClassVar[int]
    matrix: Matrix
    placement: Placement
    def __init__(self, matrix: _Optional[_Union[Matrix, _Mapping]] = ..., placement: _Optional[_Union[Placement, _Mapping]] = ...) -> None: ...

class ConvexProbe(_message.Message):
    __slots__ = ("opening_angle_deg", "near_mm", "far_mm")
    OPENING_ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    NEAR_MM_FIELD_NUMBER: _ClassVar[int]
    FAR_MM_FIELD_NUMBER: _ClassVar[int]
    opening_angle_deg: float
    near_mm: float
    far_mm: float
    def __init__(self, opening_angle_deg: _Optional[float] = ..., near_mm: _Optional[float] = ..., far_mm: _Optional[float] = ...) -> None: ...

class LinearProbe(_message.Message):
    __slots__ = ("width_mm", "near_mm", "far_mm")
    WIDTH_MM_FIELD_NUMBER: _ClassVar[int]
    NEAR_MM_FIELD_NUMBER: _ClassVar[int]
    FAR_MM_FIELD_NUMBER: _ClassVar[int]
    width_mm: float
    near_mm: float
    far_mm: float
    def __init__(self, width_mm: _Optional[float] = ..., near_mm: _Optional[float] = ..., far_mm: _Optional[float] = ...) -> None: ...

class PhasedProbe(_message.Message):
    __slots__ = ("opening_angle_deg", "far_mm")
    OPENING_ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    FAR_MM_FIELD_NUMBER: _ClassVar[int]
    opening_angle_deg: float
    far_mm: float
    def __init__(self, opening_angle_deg: _Optional[float] = ..., far_mm: _Optional[float] = ...) -> None: ...

class RadialProbe(_message.Message):
    __slots__ = ("near_mm", "far_mm")
    NEAR_MM_FIELD_NUMBER: _ClassVar[int]
    FAR_MM_FIELD_NUMBER: _ClassVar[int]
    near_mm: float
    far_mm: float
    def __init__(self, near_mm: _Optional[float] = ..., far_mm: _Optional[float] = ...) -> None: ...

class SteeredProbe(_message.Message):
    __slots__ = ("width_mm", "steering_deg", "near_mm", "far_mm")
    WIDTH_MM_FIELD_NUMBER: _ClassVar[int]
    STEERING_DEG_FIELD_NUMBER: _ClassVar[int]
    NEAR_MM_FIELD_NUMBER: _ClassVar[int]
    FAR_MM_FIELD_NUMBER: _ClassVar[int]
    width_mm: float
    steering_deg: float
    near_mm: float
    far_mm: float
    def __init__(self, width_mm: _Optional[float] = ..., steering_deg: _Optional[float] = ..., near_mm: _Optional[float] = ..., far_mm: _Optional[float] = ...) -> None: ...

class ElevationBeam(_message.Message):
    __slots__ = ("thickness_mm", "focus_mm", "depth_of_field_mm")
    THICKNESS_MM_FIELD_NUMBER: _ClassVar[int]
    FOCUS_MM_FIELD_NUMBER: _ClassVar[int]
    DEPTH_OF_FIELD_MM_FIELD_NUMBER: _ClassVar[int]
    thickness_mm: float
    focus_mm: float
    depth_of_field_mm: float
    def __init__(self, thickness_mm: _Optional[float] = ..., focus_mm: _Optional[float] = ..., depth_of_field_mm: _Optional[float] = ...) -> None: ...

class Probe(_message.Message):
    __slots__ = ("linear", "convex", "phased", "radial", "steered")
    LINEAR_FIELD_NUMBER: _ClassVar[int]
    CONVEX_FIELD_NUMBER: _ClassVar[int]
    PHASED_FIELD_NUMBER: _ClassVar[int]
    RADIAL_FIELD_NUMBER: _ClassVar[int]
    STEERED_FIELD_NUMBER: _ClassVar[int]
    linear: LinearProbe
    convex: ConvexProbe
    phased: PhasedProbe
    radial: RadialProbe
    steered: SteeredProbe
    def __init__(self, linear: _Optional[_Union[LinearProbe, _Mapping]] = ..., convex: _Optional[_Union[ConvexProbe, _Mapping]] = ..., phased: _Optional[_Union[PhasedProbe, _Mapping]] = ..., radial: _Optional[_Union[RadialProbe, _Mapping]] = ..., steered: _Optional[_Union[SteeredProbe, _Mapping]] = ...) -> None: ...

class Box(_message.Message):
    __slots__ = ("centre_mm", "quaternion", "size_mm", "frame", "brightness", "roughness", "reverberation", "opacity", "label")
    CENTRE_MM_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_FIELD_NUMBER: _ClassVar[int]
    SIZE_MM_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    BRIGHTNESS_FIELD_NUMBER: _ClassVar[int]
    ROUGHNESS_FIELD_NUMBER: _ClassVar[int]
    REVERBERATION_FIELD_NUMBER: _ClassVar[int]
    OPACITY_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    centre_mm: Position
    quaternion: Quaternion
    size_mm: Size
    frame: ToolFrame
    brightness: float
    roughness: float
    reverberation: float
    opacity: float
    label: int
    def __init__(self, centre_mm: _Optional[_Union[Position, _Mapping]] = ..., quaternion: _Optional[_Union[Quaternion, _Mapping]] = ..., size_mm: _Optional[_Union[Size, _Mapping]] = ..., frame: _Optional[_Union[ToolFrame, str]] = ..., brightness: _Optional[float] = ..., roughness: _Optional[float] = ..., reverberation: _Optional[float] = ..., opacity: _Optional[float] = ..., label: _Optional[int] = ...) -> None: ...

class Cylinder(_message.Message):
    __slots__ = ("tip_mm", "hub_mm", "diameter_mm", "frame", "brightness", "roughness", "reverberation", "opacity", "label")
    TIP_MM_FIELD_NUMBER: _ClassVar[int]
    HUB_MM_FIELD_NUMBER: _ClassVar[int]
    DIAMETER_MM_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    BRIGHTNESS_FIELD_NUMBER: _ClassVar[int]
    ROUGHNESS_FIELD_NUMBER: _ClassVar[int]
    REVERBERATION_FIELD_NUMBER: _ClassVar[int]
    OPACITY_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    tip_mm: Position
    hub_mm: Position
    diameter_mm: float
    frame: ToolFrame
    brightness: float
    roughness: float
    reverberation: float
    opacity: float
    label: int
    def __init__(self, tip_mm: _Optional[_Union[Position, _Mapping]] = ..., hub_mm: _Optional[_Union[Position, _Mapping]] = ..., diameter_mm: _Optional[float] = ..., frame: _Optional[_Union[ToolFrame, str]] = ..., brightness: _Optional[float] = ..., roughness: _Optional[float] = ..., reverberation: _Optional[float] = ..., opacity: _Optional[float] = ..., label: _Optional[int] = ...) -> None: ...

class Needle(_message.Message):
    __slots__ = ("tip_mm", "hub_mm", "diameter_mm", "frame", "brightness", "roughness", "reverberation", "opacity", "label")
    TIP_MM_FIELD_NUMBER: _ClassVar[int]
    HUB_MM_FIELD_NUMBER: _ClassVar[int]
    DIAMETER_MM_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    BRIGHTNESS_FIELD_NUMBER: _ClassVar[int]
    ROUGHNESS_FIELD_NUMBER: _ClassVar[int]
    REVERBERATION_FIELD_NUMBER: _ClassVar[int]
    OPACITY_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    tip_mm: Position
    hub_mm: Position
    diameter_mm: float
    frame: ToolFrame
    brightness: float
    roughness: float
    reverberation: float
    opacity: float
    label: int
    def __init__(self, tip_mm: _Optional[_Union[Position, _Mapping]] = ..., hub_mm: _Optional[_Union[Position, _Mapping]] = ..., diameter_mm: _Optional[float] = ..., frame: _Optional[_Union[ToolFrame, str]] = ..., brightness: _Optional[float] = ..., roughness: _Optional[float] = ..., reverberation: _Optional[float] = ..., opacity: _Optional[float] = ..., label: _Optional[int] = ...) -> None: ...

class Size(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Tool(_message.Message):
    __slots__ = ("needle", "cylinder", "box")
    NEEDLE_FIELD_NUMBER: _ClassVar[int]
    CYLINDER_FIELD_NUMBER: _ClassVar[int]
    BOX_FIELD_NUMBER: _ClassVar[int]
    needle: Needle
    cylinder: Cylinder
    box: Box
    def __init__(self, needle: _Optional[_Union[Needle, _Mapping]] = ..., cylinder: _Optional[_Union[Cylinder, _Mapping]] = ..., box: _Optional[_Union[Box, _Mapping]] = ...) -> None: ...

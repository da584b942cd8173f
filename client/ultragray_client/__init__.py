"""The client of an UltraG-Ray service: poses go in, B-mode frames come out as numpy arrays.

`Client` is for ordinary programs, `AsyncClient` for asyncio; their methods are the same. Lengths are millimetres,
angles degrees; a pose is the rigid transform from the probe's frame to the scene's, [4, 4] or a `Placement`. What fails
is told as one of `ultragray_client.errors`.
"""

from __future__ import annotations

from ultragray_client import contract, errors
from ultragray_client.client import AsyncClient, Client
from ultragray_client.connection import Tls
from ultragray_client.contract import *  # noqa: F403
from ultragray_client.conversations import RecordingAnswer
from ultragray_client.errors import ClientError
from ultragray_client.exchange import StreamMode
from ultragray_client.frames import Frame, Localization, PlannedView, RealFrame, Slice, Timings, ViewPlan
from ultragray_client.geometry import Picture, Placement, PoseLike, Quaternion
from ultragray_client.holding import HoldStill
from ultragray_client.poses import check_poses, pose_from_position_quaternion, quaternion_from_pose
from ultragray_client.recording.recording import Recording
from ultragray_client.records import (
    AuditEntry,
    ConfidenceFit,
    Job,
    JobError,
    JobEvent,
    JobProgress,
    JobState,
    Me,
    Mode,
    Registration,
    Role,
    Scene,
    SceneEntry,
    Worker,
    WorkerDevice,
    WorkerState,
)
from ultragray_client.stream import AsyncFrameStream, FrameStream

__all__ = [
    "AsyncClient",
    "AsyncFrameStream",
    "AuditEntry",
    "Client",
    "ClientError",
    "ConfidenceFit",
    "Frame",
    "FrameStream",
    "HoldStill",
    "Job",
    "JobError",
    "JobEvent",
    "JobProgress",
    "JobState",
    "Localization",
    "Me",
    "Mode",
    "Picture",
    "Placement",
    "PlannedView",
    "PoseLike",
    "Quaternion",
    "RealFrame",
    "Recording",
    "RecordingAnswer",
    "Registration",
    "Role",
    "Scene",
    "SceneEntry",
    "Slice",
    "StreamMode",
    "Timings",
    "Tls",
    "ViewPlan",
    "Worker",
    "WorkerDevice",
    "WorkerState",
    "check_poses",
    "errors",
    "pose_from_position_quaternion",
    "quaternion_from_pose",
]
__all__ += contract.__all__

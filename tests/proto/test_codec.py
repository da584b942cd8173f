import math
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest

from ultragray.geometry.probe import LinearProbe, PhasedProbe, Probe
from ultragray.rendering.display import Display
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.settings import FRAME_ENCODINGS, Encoding, RenderSettings
from ultragray.samplers import AroundSampler, CoveredSampler
from ultragray.samplers import Sampler as PoseSampler
from ultragray.scene.confidence import Extrapolation
from ultragray_proto.codec import MessageInvalid, from_message, to_message, words
from ultragray_proto.v1 import datasets_pb2, geometry_pb2, jobs_pb2, rendering_pb2, scenes_pb2
from ultragray_service.core import scenes
from ultragray_service.core.poses import FrameHeader
from ultragray_service.errors import Refusal
from ultragray_workers.datasets.store import DatasetRecord
from ultragray_workers.jobs.kinds import RenderJob, Specification, TrainJob
from ultragray_workers.jobs.progress import Progress
from ultragray_workers.jobs.record import Job

# A dataclass and its message, and the fields that stand on one side only, for a reason.
PAIRS = [
    *(
        (Probe.members[one.name], one.message_type._concrete_class, set())
        for one in geometry_pb2.Probe.DESCRIPTOR.fields
    ),
    (Display, rendering_pb2.Display, set()),
    (Extrapolation, rendering_pb2.Extrapolation, set()),
    (RenderSettings, rendering_pb2.RenderSettings, {"scene"}),
    (TrainJob, jobs_pb2.TrainJob, set()),
    (RenderJob, jobs_pb2.RenderJob, {"pose_count"}),
    (Job, jobs_pb2.Job, {"reason"}),
    (Progress, jobs_pb2.JobProgress, set()),
    (DatasetRecord, datasets_pb2.Dataset, set()),
    (scenes.Scene, scenes_pb2.Scene, {"outputs", "bounds", "bounds_min_mm", "bounds_max_mm"}),
    (scenes.SceneEntry, scenes_pb2.SceneEntry, {"removable"}),
    (scenes.TrainingPoses, scenes_pb2.TrainingPoses, set()),
    (scenes.ConfidenceFit, scenes_pb2.ConfidenceFit, set()),
    (Refusal, scenes_pb2.Error, set()),
    (
        FrameHeader,
        rendering_pb2.Frame,
        {
            "sequence",
            "data",
            "shared_data",
            "error",
            "dropped",
            "client_time_ns",
            "prediction",
            "sent_ns",
            "clock",
            "preview",
            "timings",
            "queue_ms",
            "render_ms",
            "encode_ms",
        },
    ),
]


def names_of_message(descriptor):
    """The fields; those of a oneof by its one name."""
    return {
        one.containing_oneof.name
        if one.containing_oneof and not one.containing_oneof.name.startswith("_")
        else one.name
        for one in descriptor.fields
    }


@pytest.mark.parametrize(("cls", "message", "alone"), PAIRS, ids=lambda one: getattr(one, "__name__", ""))
def test_fields_stand_on_both_sides(cls, message, alone):
    given = {one.name for one in fields(cls) if one.init and one.name != "kind"}
    assert given ^ (names_of_message(message.DESCRIPTOR) - {"kind"}) == alone


def test_every_kind_has_a_message():
    """And every word its number."""
    assert {one.name for one in geometry_pb2.Probe.DESCRIPTOR.fields} == set(Probe.members)
    (specification,) = jobs_pb2.SubmitJobRequest.DESCRIPTOR.oneofs
    assert {one.name for one in specification.fields} == set(Specification.members)
    assert set(words(jobs_pb2.JobKind.DESCRIPTOR).values()) == set(Specification.members)
    assert set(words(rendering_pb2.Output.DESCRIPTOR).values()) == set(OUTPUTS)
    assert set(words(rendering_pb2.Encoding.DESCRIPTOR).values()) == set(FRAME_ENCODINGS)
    numbers = {item.name for member in PoseSampler.members.values() for item in fields(member)}
    assert numbers == {one.name for one in jobs_pb2.PoseSampler.DESCRIPTOR.fields}


Point = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Trained:
    count: int
    position_min_mm: Point | None
    first: npt.NDArray[np.float64] | None


@dataclass(frozen=True)
class Scene:
    name: str
    probe: Probe | None
    image_height: int | None
    metrics: dict[str, float]
    label_names: dict[int, str]
    training_poses: Trained
    dataset_name: str | None = None


@dataclass(frozen=True)
class Render:
    scene: str
    sampler: PoseSampler | None = None
    kind: Literal["render"] = field(default="render", kw_only=True)


@dataclass(frozen=True)
class Submitted:
    specification: TrainJob | Render
    priority: int = 0


@dataclass(frozen=True)
class Uploaded:
    name: str
    warnings: tuple[str, ...]
    options: dict[str, str]


LINEAR = LinearProbe(1.0, 0.0, 2.0)
TOLD = [
    (RenderSettings(), rendering_pb2.RenderSettings),
    (
        RenderSettings(height=7, width=9, outputs=("echo",), encoding=Encoding.PNG, probe=LINEAR),
        rendering_pb2.RenderSettings,
    ),
    (RenderSettings(display=Display(3.0, tgc_db=(1.0, 2.0), depth_mm=5.0)), rendering_pb2.RenderSettings),
    (
        Submitted(TrainJob("a", "b", settings={"steps": 7, "sh0_rate": 0.5, "transmittance": True, "memory_gb": None})),
        jobs_pb2.SubmitJobRequest,
    ),
    (Submitted(Render("a", AroundSampler(3, 0.0)), priority=-3), jobs_pb2.SubmitJobRequest),
    (Render("a", CoveredSampler(3)), jobs_pb2.RenderJob),
    (Uploaded("a", ("dark", "short"), {"crop": "1:2,3:4"}), datasets_pb2.Dataset),
]


@pytest.mark.parametrize(("value", "cls"), TOLD)
def test_there_and_back(value, cls):
    message = cls.FromString(to_message(value, cls).SerializeToString())
    assert from_message(message, type(value)) == value


def test_scene():
    pose = np.arange(16.0).reshape(4, 4)
    scene = Scene("liver", None, None, {"psnr_db": 30.5}, {1: "bone"}, Trained(7, (1.0, 2.0, 3.0), pose))
    message = to_message(scene, scenes_pb2.Scene)
    assert not message.HasField("probe")
    assert message.image_height == 0
    assert message.training_poses.position_min_mm == geometry_pb2.Position(x=1.0, y=2.0, z=3.0)
    again = from_message(message, Scene)
    assert (again.image_height, again.dataset_name, again.metrics) == (None, None, {"psnr_db": 30.5})
    assert (again.label_names, again.training_poses.position_min_mm) == ({1: "bone"}, (1.0, 2.0, 3.0))
    assert (again.training_poses.first == pose).all()


def test_arrays_are_points():
    message = to_message(Trained(1, np.array([1.0, 2.0, 3.0], np.float32), None), scenes_pb2.TrainingPoses)
    assert message.position_min_mm == geometry_pb2.Position(x=1.0, y=2.0, z=3.0)


def test_members_of_a_family_by_themselves():
    probe = geometry_pb2.Probe(phased=geometry_pb2.PhasedProbe(opening_angle_deg=60.0, far_mm=50.0))
    assert from_message(probe, Probe) == PhasedProbe(60.0, 50.0)
    assert from_message(jobs_pb2.PoseSampler(kind="covered", count=3), PoseSampler) == CoveredSampler(3)


def test_defaults_are_left_out():
    assert to_message(RenderSettings(), rendering_pb2.RenderSettings, scene="a") == rendering_pb2.RenderSettings(
        scene="a",
        outputs=["OUTPUT_BMODE"],
        encoding="ENCODING_UINT8",
        below_min_confidence="BELOW_CONFIDENCE_REFUSE",
        speckle="SPECKLE_OFF",
    )
    assert from_message(rendering_pb2.RenderSettings(scene="a"), RenderSettings) == RenderSettings()


def test_fields_beside_the_value():
    message = to_message(Display(3.0), rendering_pb2.Display, flip=True)
    assert (message.gain_db, message.flip) == (3.0, True)
    assert from_message(message, Display, flip=False) == Display(3.0)


KINDS = ", ".join(Probe.members)
REFUSED = [
    (geometry_pb2.Probe(), Probe, "kind", f"kind must be one of {KINDS}, got none"),
    (
        rendering_pb2.RenderSettings(probe=geometry_pb2.Probe()),
        RenderSettings,
        "probe.kind",
        "probe.kind must be one of",
    ),
    (
        rendering_pb2.RenderSettings(outputs=[1, 77]),
        RenderSettings,
        "outputs",
        f"outputs must be some of {', '.join(rendering_pb2.Output.keys()[1:])}, got number 77",
    ),
    (rendering_pb2.RenderSettings(outputs=[0]), RenderSettings, "outputs", "got number 0"),
    (rendering_pb2.RenderSettings(encoding=99), RenderSettings, "encoding", "must be one of ENCODING_UINT8"),
    (scenes_pb2.Scene(), Scene, "training_poses", "training_poses is required"),
    (jobs_pb2.SubmitJobRequest(), Submitted, "specification", "must be one of train, render, got none"),
    (
        jobs_pb2.SubmitJobRequest(render=jobs_pb2.RenderJob(sampler=jobs_pb2.PoseSampler(kind="fan", seed=3))),
        Submitted,
        "render.sampler.seed",
        "render.sampler.seed must be left out: kind fan does not take it",
    ),
    (
        jobs_pb2.RenderJob(sampler=jobs_pb2.PoseSampler(kind="odd")),
        Render,
        "sampler.kind",
        f"sampler.kind must be one of {', '.join(PoseSampler.members)}, got 'odd'",
    ),
]


@pytest.mark.parametrize(("message", "cls", "path", "detail"), REFUSED)
def test_refused(message, cls, path, detail):
    with pytest.raises(MessageInvalid) as raised:
        from_message(message, cls)
    assert raised.value.field == path
    assert detail in str(raised.value)


def test_infinite_settings_are_refused():
    message = jobs_pb2.TrainJob()
    message.settings.update({"rate": math.inf})
    with pytest.raises(MessageInvalid, match=r"settings\.rate must be a finite number, got inf"):
        from_message(message, TrainJob)


def test_the_error_of_a_dataclass_is_kept():
    probe = geometry_pb2.Probe(linear=geometry_pb2.LinearProbe(width_mm=1.0, near_mm=3.0, far_mm=2.0))
    with pytest.raises(MessageInvalid) as raised:
        from_message(rendering_pb2.RenderSettings(probe=probe), RenderSettings)
    assert raised.value.field == "probe.linear"
    assert "far_mm must be" in str(raised.value.original)


def test_words():
    assert words(rendering_pb2.BelowConfidence.DESCRIPTOR) == {1: "refuse", 2: "mask"}

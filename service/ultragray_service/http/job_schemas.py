"""The JSON of jobs: made of the kinds and their specifications, so that a new kind needs nothing here."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from pydantic import BaseModel, Field, TypeAdapter, create_model

from ultragray.contract import annotated_fields
from ultragray_workers.jobs.job import Job
from ultragray_workers.jobs.kinds import KINDS, Specification

from .schemas import RequestModel

if TYPE_CHECKING:
    JobKind: TypeAlias = str
    JobKindFilter: TypeAlias = str
else:
    JobKind, JobKindFilter = Literal[KINDS], Literal[("", *KINDS)]


def _documented(specification: type[Specification]) -> type[BaseModel]:
    """What the OpenAPI document says of the specification of a kind; `from_dict` reads it."""
    fields: dict[str, Any] = {}
    for item, annotation in annotated_fields(specification):
        options: dict[str, Any] = {"description": item.metadata.get("description")}
        options["json_schema_extra"] = item.metadata.get("json_schema_extra")
        if item.default is not MISSING:
            options["default"] = item.default
        elif item.default_factory is not MISSING:
            options["default"] = item.default_factory()
        is_poses = item.name == "poses"  # an array once it is read
        fields[item.name] = (list[list[list[float]]] | None if is_poses else annotation, Field(**options))
    kind = fields.pop("kind")[1].default  # which stands beside the specification
    return create_model(
        f"{kind.title()}Specification", __doc__=(specification.__doc__ or "").partition("\n")[0], **fields
    )


SPECIFICATIONS = tuple(_documented(cls) for cls in Specification.members.values())


class JobBody(RequestModel):
    """A job to be done in the background."""

    kind: JobKind
    specification: dict[str, Any] = Field(
        description=f"{' or '.join(model.__name__ for model in SPECIFICATIONS)}, by kind.",
        json_schema_extra={
            "anyOf": [{"$ref": f"#/components/schemas/{model.__name__}"} for model in SPECIFICATIONS],
        },
    )
    request_id: str | None = Field(
        None, description="Chosen by the client, 1 to 128 characters: sent again, it gives the same job."
    )
    priority: int = Field(0, description="-1000 to 1000; higher ones go first.")


@dataclass(frozen=True, kw_only=True)
class JobOut(Job):
    """A job."""

    kind: JobKind

    @classmethod
    def of(cls, job: Job) -> JobOut:
        """The job as JSON tells it: the kind stands beside the specification."""
        specification = {name: value for name, value in job.specification.items() if name != "kind"}
        return cls(**{**vars(job), "specification": specification})


JOB_OUT = TypeAdapter(JobOut)


class JobPage(BaseModel):
    """One page of jobs, newest first."""

    jobs: list[JobOut]
    next_page_token: str = Field(description="Empty on the last page.")

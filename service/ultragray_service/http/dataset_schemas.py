"""The JSON of datasets."""

from __future__ import annotations

from pydantic import BaseModel, Field

from ultragray.datasets.source import UPLOADED_FORMATS
from ultragray_workers.datasets.store import DatasetRecord

from .schemas import ProbeBody, probe_body


class DatasetOut(BaseModel):
    """An accepted dataset."""

    name: str
    kind: str = Field(
        description="Its format: " + "; ".join(f"{one.name}, {one.meaning}" for one in UPLOADED_FORMATS) + ".",
        json_schema_extra={"enum": [one.name for one in UPLOADED_FORMATS]},
    )
    sha256: str = Field(description="Of images, poses, probe and split, however they were sent.")
    bytes: int = Field(description="Of its files.")
    created_at: str = Field(description="ISO 8601, UTC.")
    train_frames: int
    val_frames: int
    height: int
    width: int
    probe: ProbeBody | None
    warnings: list[str] = Field(description="What looks wrong, for a person to decide.")
    options: dict[str, str] = Field(description="How it was read: the query parameters of its upload.")

    @classmethod
    def of(cls, record: DatasetRecord) -> DatasetOut:
        """The JSON of a record."""
        return cls(
            name=record.name,
            kind=record.kind,
            sha256=record.sha256,
            bytes=record.bytes,
            created_at=record.created_at,
            train_frames=record.train_frames,
            val_frames=record.val_frames,
            height=record.height,
            width=record.width,
            probe=None if record.probe is None else probe_body(record.probe),
            warnings=list(record.warnings),
            options=record.options,
        )


class DatasetPage(BaseModel):
    """One page of datasets by name."""

    datasets: list[DatasetOut]
    next_page_token: str = Field(description="Empty on the last page.")

"""How commands name a pose sampler."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from ultragray.errors import InvalidArgument

Kind = Annotated[
    str | None,
    typer.Option(
        "--sampler",
        help="Makes the poses of these: training, around, spline, fan or covered; each takes its own options only.",
        show_default=False,
    ),
]
Count = Annotated[int | None, typer.Option(help="around, spline, covered: how many poses.", show_default=False)]
TranslationMm = Annotated[float | None, typer.Option(help="around: deviation along each axis.", show_default="2")]
RotationDeg = Annotated[float | None, typer.Option(help="around: deviation of the angle.", show_default="5")]
Seed = Annotated[int | None, typer.Option(help="around, covered.", show_default="0")]
SpacingMm = Annotated[float | None, typer.Option(help="spline: instead of --count.", show_default=False)]
TiltDeg = Annotated[float | None, typer.Option(help="fan: the largest tilt, to both sides.", show_default=False)]
StepDeg = Annotated[float | None, typer.Option(help="fan: between two tilts.", show_default=False)]

MinConfidence = Annotated[
    float | None,
    typer.Option(help="0 to 1: samplers keep within it, other poses below it are refused.", show_default="any"),
]


def sampler_document(kind: str | None, **numbers: float | None) -> dict[str, Any] | None:
    """The JSON object of the sampler that the options name, None for none.

    Raises InvalidArgument for options of a sampler without `--sampler`.
    """
    given = {name: value for name, value in numbers.items() if value is not None}
    if kind is not None:
        return {"kind": kind, **given}
    for name in given:
        option = f"--{name.replace('_', '-')}"
        raise InvalidArgument(f"{option} is of a sampler: name it with --sampler", field=name)
    return None

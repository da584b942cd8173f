"""What every command about jobs takes."""

from __future__ import annotations

from typing import Annotated

import typer

JobArgument = Annotated[str, typer.Argument(help="Id of the job.", show_default=False)]
Server = Annotated[str, typer.Option(help="URL of the service.", envvar="ULTRAGRAY_SERVER")]
ApiKey = Annotated[
    str | None, typer.Option(help="Where the service asks for one.", envvar="ULTRAGRAY_API_KEY", show_default=False)
]
RequestId = Annotated[
    str | None,
    typer.Option(help="A name of your own: given again, it gives the same job.", show_default=False),
]
Priority = Annotated[int, typer.Option(min=-1000, max=1000, help="Higher ones go first.")]
Wait = Annotated[bool, typer.Option("--wait", help="Follow the job to its end, as `jobs watch` does.")]

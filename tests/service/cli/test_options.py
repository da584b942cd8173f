"""Options made of contract dataclasses: names, help, defaults, and the way back."""

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import LinearProbe, Probe
from ultragray.samplers import FanSampler, Sampler
from ultragray_service.cli.options import FieldsOf, with_options


class Way(str, Enum):
    THERE = "there"
    BACK = "back"


@dataclass(frozen=True)
class Inner(Contract):
    pixel_mm: float | None = described("Size of a pixel.", None, low=0.5)


@dataclass(frozen=True)
class Asked(Contract):
    name: str = described("Its name.")
    folder: Path = described("Where.")
    number: int = described("How many.", 3, low=1, high=9)
    is_loud: bool = described("Louder.", False)
    absorbs: bool = described("Absorption.", True)
    gains: tuple[float, ...] = described("Gains.", (1.0, 2.0))
    way: Way = described("Which way.", Way.THERE)
    probe: Probe | None = described("A probe.", None)
    inner: Inner | None = described("Not shown.", None)


def given(*arguments: object, some: bool = False) -> Any:
    found: list[Any] = []
    app = typer.Typer()

    @with_options
    def whole(asked: Asked, sampler: Sampler | None) -> None:
        found.append((asked, sampler))

    @with_options
    def fields(options: Annotated[dict[str, Any], FieldsOf(Asked, "number", "absorbs", environment="OUR_")]) -> None:
        found.append(options)

    app.command()(fields if some else whole)
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if isinstance(result.exception, InvalidArgument):
        raise result.exception
    return found[0] if found else result


def test_every_kind_of_field_has_its_option() -> None:
    asked, sampler = given(
        *("me", "--folder", "/tmp", "--number", 4, "--is-loud", "--no-absorbs", "--gains", "0.5, 3", "--way", "back"),
        *("--probe", '{"kind": "linear", "width_mm": 40, "near_mm": 0, "far_mm": 50}', "--scan-convert", 0.75),
        *("--sampler", "fan", "--tilt-deg", 4, "--step-deg", 2),
    )
    probe = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
    assert asked == Asked("me", Path("/tmp"), 4, True, False, (0.5, 3.0), Way.BACK, probe, Inner(0.75))
    assert sampler == FanSampler(4, 2)


def test_what_is_not_given_keeps_its_default() -> None:
    asked, sampler = given("me", "--folder", "/tmp")
    assert asked == Asked("me", Path("/tmp"))
    assert sampler is None


def test_fields_are_taken_as_they_are_given() -> None:
    assert given(some=True) == {}
    assert given("--number", 5, "--no-absorbs", some=True) == {"number": 5, "absorbs": False}


def test_help_has_the_meaning_the_limits_and_the_default() -> None:
    text = " ".join(given("--help").output.replace("│", " ").split())
    assert "How many. From 1 to 9. [default: (3)]" in text
    assert "Gains. [default: (1.0,2.0)]" in text
    assert "Which way. One of there, back. [default: (there)]" in text
    assert "Size of a pixel. At least 0.5." in text
    assert "[OUR_NUMBER]" in given("--help", some=True).output


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--number", 10), "number must be an integer from 1 to 9, got 10"),
        (("--gains", "1,b"), r"gains\[1\] must be a finite number, got 'b'"),
        (("--way", "up"), "way must be one of there, back, got 'up'"),
        (("--probe", "{"), "--probe must be one of C5-2, C9-4, "),
        (("--pixel-mm", 0.1), "pixel_mm must be a finite number of at least 0.5, got 0.1"),
        (("--tilt-deg", 3), "--tilt-deg is of a sampler: name it with --sampler"),
        (("--sampler", "fan", "--tilt-deg", 3), "--sampler fan needs --step-deg"),
    ],
)
def test_mistakes_are_named(arguments: tuple[object, ...], told: str) -> None:
    with pytest.raises(InvalidArgument, match=told):
        given("me", "--folder", "/tmp", *arguments)

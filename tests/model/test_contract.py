"""The contract's dataclasses: checks by annotation and limits, families, JSON, and what pydantic reads."""

from dataclasses import dataclass
from enum import Enum
from typing import Literal

import pytest
from pydantic import TypeAdapter, ValidationError

from ultragray.contract import Contract, Family, described, from_dict, kind_field, to_dict, under
from ultragray.errors import InvalidArgument, InvalidProbe


class Colour(str, Enum):
    RED = "red"
    BLUE = "blue"


class Shape(Family):
    error = InvalidProbe


@dataclass(frozen=True)
class Square(Shape):
    side_mm: float = described("Length of a side.", above=0.0, high=10.0)
    kind: Literal["square"] = kind_field("square")


@dataclass(frozen=True)
class Circle(Shape):
    radius_mm: float = described("Distance from the centre.", low=0.0)
    kind: Literal["circle"] = kind_field("circle")


@dataclass(frozen=True)
class Drawing(Contract):
    shape: Shape | None = described("What is drawn.", None)
    colour: Colour = described("Of the line.", Colour.RED)
    copies: int = described("How many.", 1, low=1, high=9)
    offsets_mm: tuple[float, ...] = described("Of the copies.", (), low=-5.0, high=5.0, most=3)
    mirrored: bool = described("Left and right change places.", False)
    paper: str = described("What it is drawn on.", "plain", choices=("plain", "ruled"))


@pytest.mark.parametrize(
    ("values", "field", "message"),
    [
        ({"copies": 0}, "copies", "copies must be an integer from 1 to 9, got 0"),
        ({"copies": True}, "copies", "copies must be an integer from 1 to 9, got true"),
        ({"offsets_mm": (1.0, 6.0)}, "offsets_mm[1]", r"offsets_mm\[1\] must be a finite number from -5 to 5, got 6.0"),
        ({"offsets_mm": (0.0,) * 4}, "offsets_mm", "offsets_mm must be a list of at most 3 values, got 4"),
        ({"offsets_mm": 3.0}, "offsets_mm", "offsets_mm must be a list, got 3.0"),
        ({"mirrored": 1}, "mirrored", "mirrored must be true or false, got 1"),
        ({"colour": "green"}, "colour", "colour must be one of red, blue, got 'green'"),
        ({"paper": "squared"}, "paper", "paper must be one of plain, ruled, got 'squared'"),
        ({"shape": 3}, "shape", "shape must be a Shape, got 3"),
    ],
)
def test_a_value_beyond_its_field_is_refused_by_name(values, field, message):
    with pytest.raises(InvalidArgument, match=message) as refused:
        Drawing(**values)
    assert refused.value.field == field


@pytest.mark.parametrize("side", [0.0, -1.0, 11.0, float("nan"), float("inf"), 10**400, "3", None])
def test_the_error_is_that_of_the_class(side):
    with pytest.raises(InvalidProbe, match="side_mm must be a finite number above 0 and at most 10, got"):
        Square(side)


def test_numbers_and_words_get_their_own_type():
    drawing = Drawing(offsets_mm=[1, 2], colour="blue")
    assert drawing == Drawing(offsets_mm=(1.0, 2.0), colour=Colour.BLUE)
    assert isinstance(drawing.offsets_mm[0], float)
    assert isinstance(drawing.colour, Colour)


def test_json_and_back():
    drawing = Drawing(Circle(2.0), Colour.BLUE, 3, (1.0,), True, "ruled")
    document = to_dict(drawing)
    assert document["shape"] == {"kind": "circle", "radius_mm": 2.0}
    assert from_dict(Drawing, document) == drawing
    assert from_dict(Drawing, {}) == Drawing()
    assert "shape" not in to_dict(Drawing(), with_none=False)


@pytest.mark.parametrize(
    ("document", "field", "message"),
    [
        ({"size": 3}, "size", "size is not a known key: Drawing takes shape, colour"),
        ({"shape": {"kind": "line"}}, "shape.kind", "shape.kind must be one of square, circle, got 'line'"),
        ({"shape": {}}, "shape.kind", "shape.kind must be one of square, circle, got null"),
        ({"shape": {"kind": "circle"}}, "shape.radius_mm", "shape.radius_mm is required by the shape circle"),
        ({"shape": {"kind": "circle", "radius_mm": -1}}, "shape.radius_mm", "shape.radius_mm must be a finite number"),
        ({"shape": 3}, "shape", "shape must be an object, got 3"),
    ],
)
def test_json_that_cannot_be_read_is_refused_by_its_path(document, field, message):
    with pytest.raises(InvalidArgument, match=message) as refused:
        from_dict(Drawing, document)
    assert refused.value.field == field


def test_a_path_grows_from_the_outside():
    with pytest.raises(InvalidArgument) as refused, under("settings"), under("shapes"), under("[3]"):
        Circle(-1.0)
    assert refused.value.field == "settings.shapes[3].radius_mm"
    assert str(refused.value).startswith("settings.shapes[3].radius_mm must be")


def test_pydantic_reads_the_same_classes():
    adapter = TypeAdapter(Drawing)
    assert adapter.validate_json('{"shape": {"kind": "circle", "radius_mm": 2}}') == Drawing(Circle(2.0))
    with pytest.raises(ValidationError) as refused:
        adapter.validate_json('{"shape": {"kind": "square", "side_mm": 0}}')
    (error,) = refused.value.errors()
    assert isinstance(error["ctx"]["error"], InvalidProbe)
    schema = adapter.json_schema()
    copies, offsets, paper = (schema["properties"][name] for name in ("copies", "offsets_mm", "paper"))
    assert (copies["description"], copies["minimum"], copies["maximum"]) == ("How many.", 1, 9)
    assert (offsets["maxItems"], offsets["items"]) == (3, {"type": "number", "minimum": -5.0, "maximum": 5.0})
    assert list(paper["enum"]) == ["plain", "ruled"]
    assert schema["properties"]["shape"]["anyOf"][0]["discriminator"]["propertyName"] == "kind"

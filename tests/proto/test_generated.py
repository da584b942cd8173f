"""The committed contract is the one that proto/generate.py makes, and its numbers never change."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

import pytest

from ultragray.contract import Contract, described

from ..scripts import loaded

PROTO = Path(__file__).resolve().parents[2] / "proto"
VERSION_LINE = "# Protobuf Python Version: "


@pytest.fixture(scope="module")
def generator():
    return loaded(PROTO / "generate.py")


def protoc_version(folder):
    lines = (folder / "ultragray_proto" / "v1" / "rendering_pb2.py").read_text().splitlines()
    return next(line for line in lines if line.startswith(VERSION_LINE))


def test_what_is_committed_is_current(generator, tmp_path):
    written = [path.relative_to(tmp_path) for path in generator.generate(tmp_path)]
    is_other_protoc = protoc_version(tmp_path) != protoc_version(PROTO)
    compared = [path for path in written if not (is_other_protoc and "_pb2" in path.name)]
    stale = [str(path) for path in compared if (PROTO / path).read_bytes() != (tmp_path / path).read_bytes()]
    assert not stale, f"{', '.join(stale)}: make generate"
    there = {
        path.relative_to(PROTO) for path in PROTO.glob("ultragray*/v1/*") if path.suffix in (".py", ".pyi", ".proto")
    }
    assert {path for path in there - set(written) if path.name != "__init__.py"} == set()


def test_stubs_do_not_import_the_model_library():
    for path in (PROTO / "ultragray_proto" / "v1").glob("*_pb2*"):
        assert "from ultragray." not in path.read_text()


class Colour(Enum):
    RED = "red"
    GREEN = "green"


@dataclass(frozen=True)
class Settings(Contract):
    gain_db: float = described("Added.", 0.0, low=0.0, high=3.0)
    side: int | None = described("Pixels.", None, low=1, high=4096)
    count: int = described("Of all.", 7)
    names: tuple[str, ...] = described("Some.", ())
    colour: Colour = described("Its colour.", Colour.RED)
    labels: dict[str, str] = field(default_factory=dict)


class Kinds:
    members: ClassVar[dict[str, type[Any]]] = {"plain": Settings}


TEMPLATE = f"""message Settings {{
  string scene = 1;
  // @fields {__name__}:Settings
}}

enum Colour {{
  COLOUR_UNSPECIFIED = 0;
  // @values {__name__}:Colour
}}

message Chosen {{
  oneof kind {{
    // @members {__name__}:Kinds
  }}
}}
"""
LOCKED = [
    "ultragray.v1.Settings.scene = 1: string",
    "ultragray.v1.Settings.side = 4: optional int32",
    "ultragray.v1.Settings.gone = 6: bool",
]


def declarations(text):
    return [line.strip() for line in text.splitlines() if line.strip().endswith(";")]


def test_a_new_field_takes_the_next_number_and_the_form_of_its_annotation(generator):
    assert declarations(generator.proto_text(TEMPLATE, generator.Lock(LOCKED))) == [
        "string scene = 1;",
        "optional int32 side = 4;",
        "double gain_db = 7;",
        "optional int64 count = 8;",
        "repeated string names = 9;",
        "Colour colour = 10;",
        "map<string, string> labels = 11;",
        "reserved 6;",
        'reserved "gone";',
        "COLOUR_UNSPECIFIED = 0;",
        "COLOUR_RED = 1;",
        "COLOUR_GREEN = 2;",
        "Settings plain = 1;",
    ]


def test_a_comment_says_meaning_limits_and_default(generator):
    text = generator.proto_text(TEMPLATE, generator.Lock(LOCKED))
    assert "  // Added. From 0 to 3.\n  double gain_db" in text
    assert "  // Of all. Absent: 7.\n" in text


@pytest.mark.parametrize("form", ["string", "repeated double"])
def test_a_form_that_cannot_hold_the_annotation_is_refused(generator, form):
    lock = generator.Lock([*LOCKED, f"ultragray.v1.Settings.gain_db = 5: {form}"])
    with pytest.raises(generator.ContractError, match=r"Settings\.gain_db is .* on the wire, which cannot hold float"):
        generator.proto_text(TEMPLATE, lock)


def test_the_lock_only_grows(generator):
    lock = generator.Lock(LOCKED)
    assert lock.grown([LOCKED[0], "ultragray.v1.Settings.new = 7: bool"]) == [
        *LOCKED,
        "ultragray.v1.Settings.new = 7: bool",
    ]
    with pytest.raises(generator.ContractError, match=r"scene = 2: string, was .*scene = 1: string"):
        lock.grown(["ultragray.v1.Settings.scene = 2: string"])


def test_a_method_keeps_its_messages(generator):
    lock = generator.Lock(["ultragray.v1.Render.Frame(ultragray.v1.A) returns (ultragray.v1.B)"])
    with pytest.raises(generator.ContractError, match="returns"):
        lock.grown(["ultragray.v1.Render.Frame(ultragray.v1.A) returns (stream ultragray.v1.B)"])

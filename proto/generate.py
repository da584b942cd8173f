"""Generates proto/ultragray_proto/v1 from proto/ultragray/v1: `python proto/generate.py`.

The stubs live in `ultragray_proto`, not in `ultragray`, which is the name of the model library.
"""

from __future__ import annotations

import re
import tempfile
from importlib.resources import files
from pathlib import Path

from grpc_tools import protoc

PROTO_ROOT = Path(__file__).resolve().parent
OUTPUT_FOLDER = PROTO_ROOT / "ultragray_proto" / "v1"

_IMPORT = re.compile(r"^(\s*)from ultragray\.v1 import", flags=re.MULTILINE)


def generate(output_folder: Path) -> list[Path]:
    """Writes the stubs (*_pb2.py, *_pb2.pyi, *_pb2_grpc.py) and returns their paths.

    Raises RuntimeError if protoc fails.
    """
    sources = sorted((PROTO_ROOT / "ultragray" / "v1").glob("*.proto"))
    with tempfile.TemporaryDirectory() as temporary:
        arguments = [
            "protoc",
            f"-I{PROTO_ROOT}",
            f"-I{files('grpc_tools') / '_proto'}",
            f"--python_out={temporary}",
            f"--pyi_out={temporary}",
            f"--grpc_python_out={temporary}",
            *map(str, sources),
        ]
        if protoc.main(arguments) != 0:
            raise RuntimeError("protoc failed")
        output_folder.mkdir(parents=True, exist_ok=True)
        written = []
        for generated in sorted(Path(temporary, "ultragray", "v1").iterdir()):
            text = _IMPORT.sub(r"\1from ultragray_proto.v1 import", generated.read_text())
            if generated.name.endswith("_pb2_grpc.py") and "class " not in text:
                continue  # a file of messages only
            target = output_folder / generated.name
            target.write_text(text)
            written.append(target)
    return written


if __name__ == "__main__":
    generate(OUTPUT_FOLDER)

"""The architecture as the source tree has it: who may import whom, no circles, no probe kinds in the open."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCE_ROOTS = [ROOT / name for name in ("model", "workers", "service", "client", "proto", "ros", "studies")]
PROBE_PACKAGE = "ultragray.geometry.probe"

BENEATH = {"ultragray", "ultragray.errors", "ultragray.contract", "ultragray.files", "ultragray.installation"}
BENEATH |= {"ultragray._cpu"}
STOREYS = [f"ultragray.{name}" for name in ("geometry", "scene", "rendering", "learn")]  # each imports those before it
PLUGINS = {f"ultragray.{name}" for name in ("datasets", "exchange", "samplers", "phantom")}
MAY_IMPORT = {
    **dict.fromkeys(BENEATH, BENEATH),
    "ultragray": BENEATH | set(STOREYS),  # its public names, on first use
    **{storey: BENEATH | set(STOREYS[:place]) for place, storey in enumerate(STOREYS)},
    **dict.fromkeys(PLUGINS, BENEATH | set(STOREYS) | PLUGINS),
    "ultragray_proto": set(),
    "ultragray_client": {"ultragray_proto"},
    "ultragray_ros": {"ultragray_client"},
    "ultragray_workers": {"ultragray"},
    "ultragray_service": {"ultragray", "ultragray_client", "ultragray_proto", "ultragray_workers"},
    "ultragray_studies": {"ultragray", "ultragray_client", "ultragray_proto", "ultragray_workers", "ultragray_service"},
}  # by the first names of both: a whole package, or a room of the library


@cache
def modules() -> dict[str, Path]:
    """Every module of the product by its name; those compiled by their stubs."""
    found = {}
    for root in SOURCE_ROOTS:
        for path in (*root.rglob("*.py"), *root.rglob("*.pyi")):
            package, *_ = parts = path.relative_to(root).with_suffix("").parts
            if package.startswith("ultragray"):
                found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def tree(name: str) -> ast.Module:
    return ast.parse(modules()[name].read_text(encoding="utf-8"))


def imports_of(name: str) -> set[str]:
    """The product's modules that a module names in imports, wherever they stand: in functions and for types too."""
    is_package = modules()[name].stem == "__init__"
    found = set()
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = name.split(".")
            above = parts[: len(parts) - node.level + is_package] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found |= {inner if (inner := f"{base}.{alias.name}") in modules() else base for alias in node.names}
    return (found & modules().keys()) - {name}


def circles() -> Iterator[list[str]]:
    """Sets of modules that all lead to each other (Tarjan's algorithm)."""
    graph = {name: imports_of(name) for name in modules()}
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    waiting: list[str] = []

    def visit(name: str) -> Iterator[list[str]]:
        order[name] = lowest[name] = len(order)
        waiting.append(name)
        for other in graph[name]:
            if other not in order:
                yield from visit(other)
                lowest[name] = min(lowest[name], lowest[other])
            elif other in waiting:
                lowest[name] = min(lowest[name], order[other])
        if lowest[name] == order[name]:
            place = waiting.index(name)
            together = waiting[place:]
            del waiting[place:]
            if len(together) > 1:
                yield sorted(together)

    for name in graph:
        if name not in order:
            yield from visit(name)


def room(name: str) -> str:
    """The room of a module of the library, the package of any other."""
    package, *inner = name.split(".")
    return f"{package}.{inner[0]}" if package == "ultragray" and inner else package


def test_each_room_imports_only_what_stands_before_it() -> None:
    wrong = [
        f"{name} imports {other}"
        for name in modules()
        for other in imports_of(name)
        if room(other) != room(name) and not {room(other), other.partition(".")[0]} & allowed(name)
    ]
    assert sorted(wrong) == []


def allowed(name: str) -> set[str]:
    """The rooms and packages that a module may import; within the library a room has to be named."""
    return MAY_IMPORT[room(name)] - ({"ultragray"} if name.startswith("ultragray.") else set())


def test_every_module_says_what_it_is_for() -> None:
    generated = ("_pb2", "_pb2_grpc")
    silent = [
        name
        for name, path in modules().items()
        if path.suffix == ".py" and not name.endswith(generated) and not ast.get_docstring(tree(name))
    ]
    assert sorted(silent) == []


def test_no_module_imports_itself_by_way_of_others() -> None:
    assert list(circles()) == []


def test_nobody_outside_its_package_asks_for_the_kind_of_a_probe() -> None:
    found = [
        f"{name}:{node.lineno}"
        for name in modules()
        if not name.startswith(PROBE_PACKAGE)
        for node in ast.walk(tree(name))
        if isinstance(node, (ast.Call, ast.Compare)) and asks_for_a_kind(node)
    ]
    assert found == []


def asks_for_a_kind(node: ast.Call | ast.Compare) -> bool:
    """`isinstance(probe, LinearProbe)`, or `probe.kind == "linear"`."""
    if isinstance(node, ast.Call):
        is_check = ast.unparse(node.func) in ("isinstance", "issubclass")
        return is_check and any(isinstance(part, ast.Name) and part.id in kinds_of_probes() for part in ast.walk(node))
    of_probe = ast.unparse(node.left).endswith("probe.kind")
    return of_probe and any(isinstance(other, ast.Constant) for other in node.comparators)


@cache
def kinds_of_probes() -> set[str]:
    """The classes of the probe package that define a `kind` of their own."""
    return {
        node.name
        for name in modules()
        if name.startswith(PROBE_PACKAGE)
        for node in tree(name).body
        if isinstance(node, ast.ClassDef)
        for item in node.body
        if isinstance(item, ast.AnnAssign) and ast.unparse(item.target) == "kind" and item.value
    }


def test_the_kinds_of_probes_are_found() -> None:
    assert {"LinearProbe", "RadialProbe"} <= kinds_of_probes()

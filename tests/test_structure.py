"""The architecture as the source tree has it: no import circles, storeys, no probe kinds in the open."""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCE_ROOTS = [ROOT / name for name in ("model", "workers", "service", "client", "proto", "ros", "studies")]
PROBE_MODULE = "ultragray.geometry.probe"
# What each distribution may import of the others; the product never imports its studies.
MAY_IMPORT = {
    "ultragray": set(),
    "ultragray_proto": set(),
    "ultragray_client": {"ultragray_proto"},
    "ultragray_ros": {"ultragray_client"},
    "ultragray_workers": {"ultragray"},
    "ultragray_service": {"ultragray", "ultragray_workers", "ultragray_proto", "ultragray_client"},
    "ultragray_studies": {"ultragray", "ultragray_workers", "ultragray_service", "ultragray_client"},
}
# The library: each storey imports those before it and what lies beneath all; plug-ins stand beside.
STOREYS = ("geometry", "scene", "rendering", "learn")
BENEATH = {"", "errors", "contract", "files", "installation", "_cpu"}
PLUGINS = ("datasets", "exchange", "phantom", "samplers")
ROOMS = {
    "": {*BENEATH, *STOREYS},  # public names, on first use
    **{room: BENEATH for room in BENEATH if room},
    **{storey: {*BENEATH, *STOREYS[:place]} for place, storey in enumerate(STOREYS)},
    **{plugin: {*BENEATH, *STOREYS, *PLUGINS} for plugin in PLUGINS},
}
SERVICE_ROOMS = (  # each may import those before it
    *("", "errors", "environment", "access", "settings", "misspelt", "tls", "telemetry", "listening", "core", "views"),
    *("doors", "service", "wiring", "http", "rpc", "igtl", "server", "healthcheck", "cli", "__main__"),
)


@cache
def modules():
    """Every module of the product by its name; those compiled by their stubs."""
    found = {}
    for root in SOURCE_ROOTS:
        for path in (*root.rglob("*.py"), *root.rglob("*.pyi")):
            package, *_ = parts = path.relative_to(root).with_suffix("").parts
            if package.startswith("ultragray"):
                found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def tree(name):
    return ast.parse(modules()[name].read_text(encoding="utf-8"))


@cache
def nodes_of(name):
    """All nodes of a module that the tests look at: imports, calls and comparisons."""
    kinds = ast.Import, ast.ImportFrom, ast.Call, ast.Compare
    return [node for node in ast.walk(tree(name)) if isinstance(node, kinds)]


@cache
def imports_of(name):
    """The product's modules that a module names in imports, wherever they stand: in functions and for types too."""
    is_package = modules()[name].stem == "__init__"
    found = set()
    for node in nodes_of(name):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = name.split(".")
            above = parts[: len(parts) - node.level + is_package] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found |= {inner if (inner := f"{base}.{alias.name}") in modules() else base for alias in node.names}
    return (found & modules().keys()) - {name}


def test_no_module_imports_itself_by_way_of_others():
    try:
        TopologicalSorter({name: imports_of(name) for name in modules()}).prepare()
    except CycleError as error:
        pytest.fail(" → ".join(error.args[1]))


def forbidden(rooms, may):
    """The imports between modules, whose rooms are told, from a room that may not import from that of the other."""
    return {
        (name, other)
        for name, room in rooms.items()
        for other in imports_of(name) & rooms.keys()
        if not may(room, rooms[other])
    }


def rooms_of(distribution):
    parts = ((name, (*name.split("."), "")) for name in modules())
    return {name: room for name, (top, room, *_) in parts if top == distribution}


def test_distributions_import_only_those_below_them():
    rooms = {name: name.partition(".")[0] for name in modules()}
    assert forbidden(rooms, lambda room, other: other in {room, *MAY_IMPORT[room]}) == set()


def test_rooms_of_the_library_import_only_those_below_them():
    assert forbidden(rooms_of("ultragray"), lambda room, other: other in {room, *ROOMS[room]}) == set()


def test_rooms_of_the_service_import_only_those_before_them():
    places = {name: SERVICE_ROOMS.index(room) for name, room in rooms_of("ultragray_service").items()}
    assert forbidden(places, lambda place, other: other <= place) == set()


def test_every_module_says_what_it_is_for():
    written = {name for name, path in modules().items() if path.suffix == ".py" and "_pb2" not in name}
    assert {name for name in written if not ast.get_docstring(tree(name))} == set()


def test_nobody_outside_its_module_asks_for_the_kind_of_a_probe():
    found = [
        f"{name}:{node.lineno}"
        for name in modules()
        if name != PROBE_MODULE
        for node in nodes_of(name)
        if isinstance(node, (ast.Call, ast.Compare)) and asks_for_a_kind(node)
    ]
    assert found == []
    assert {"LinearProbe", "RadialProbe"} <= kinds_of_probes()


def asks_for_a_kind(node):
    """`isinstance(probe, LinearProbe)`, or `probe.kind == "linear"`."""
    if isinstance(node, ast.Call):
        is_check = ast.unparse(node.func) in ("isinstance", "issubclass")
        return is_check and any(isinstance(part, ast.Name) and part.id in kinds_of_probes() for part in ast.walk(node))
    of_probe = ast.unparse(node.left).endswith("probe.kind")
    return of_probe and any(isinstance(other, ast.Constant) for other in node.comparators)


@cache
def kinds_of_probes():
    """The classes of the probe module that define a `kind` of their own."""
    return {
        node.name
        for node in tree(PROBE_MODULE).body
        if isinstance(node, ast.ClassDef)
        for item in node.body
        if isinstance(item, ast.AnnAssign) and ast.unparse(item.target) == "kind" and item.value
    }

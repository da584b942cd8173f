"""What the projects say about themselves, and which extra or dependency brings each module that is imported."""

import ast
import re
import subprocess
import sys
from importlib import metadata

import pytest
from packaging.utils import canonicalize_name

from ultragray import installation
from ultragray.errors import ExtraMissing
from ultragray.installation import MODULES_OF_EXTRAS, __version__, extra_of, install_advice, missing_extra
from ultragray.phantom.demo import copy_demo_scene

from ..surroundings import ROOT
from .projects import FOLDERS, names_of, packages, project, pyproject

BESIDE_TORCH = {"triton"}  # comes with torch's CUDA build, and is asked for by find_spec
BROUGHT_BY = {  # modules that are used with, and come with, what is required
    "starlette": "fastapi",
    "typing_extensions": "pydantic",
    "httptools": "uvicorn",
    "uvloop": "uvicorn",
    "websockets": "uvicorn",
}
NO_FEATURES = {"all", "dev", "docs", "envoy", "notebooks"}
NOT_IN_ALL = {"parquet", "ray", "video"}  # 130 and 260 MB, for those who share data sets or have a cluster; the GPL


def imported():
    """Modules of others that the packages of `ultragray` import anywhere, and one file that does."""
    found = {}
    for folder in pyproject("ultragray")["tool"]["scikit-build"]["wheel"]["packages"]:
        for path in sorted((ROOT / folder).rglob("*.py")):
            for name in imports_of(path):
                if name.partition(".")[0] not in {*sys.stdlib_module_names, *packages("ultragray")}:
                    found.setdefault(name, path)
    return found


def imports_of(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            yield node.module


def owners(module, holders):
    """The canonical names of the distributions that may hold a module: those that do, or of its own name."""
    top = module.partition(".")[0]
    return {canonicalize_name(name) for name in (BROUGHT_BY.get(top, top), *holders.get(top, ()))}


def test_every_imported_module_is_brought_by_what_the_table_says():
    own, holders = project("ultragray"), metadata.packages_distributions()
    brought = {None: names_of(own["dependencies"])}
    brought |= {extra: names_of(own["optional-dependencies"][extra]) for extra in MODULES_OF_EXTRAS}
    for module, path in imported().items():
        extra = extra_of(module)
        if module.partition(".")[0] not in BESIDE_TORCH:
            assert owners(module, holders) & brought[extra], f"{path} imports {module}; the table: {extra or 'core'}"


def test_the_table_names_the_extras_that_there_are():
    assert set(MODULES_OF_EXTRAS) == set(project("ultragray")["optional-dependencies"]) - NO_FEATURES


def test_all_holds_every_extra_but_those_for_few():
    (everything,) = project("ultragray")["optional-dependencies"]["all"]
    assert set(re.findall(r"\w+", everything)) - {"ultragray"} == set(MODULES_OF_EXTRAS) - NOT_IN_ALL


def test_no_sentence_names_an_extra_by_hand():
    """Those that do grow old; `install_advice` knows how this installation was made."""
    for folder in ("model", "workers", "service", "client"):
        for path in (ROOT / folder).rglob("*.py"):
            if path.name != "installation.py":
                named = re.findall(r"ultragray\[(\w+)\]", path.read_text(encoding="utf-8"))
                assert not named, f"{path}: {named}"


@pytest.mark.parametrize("extra", MODULES_OF_EXTRAS)
def test_advice_fits_the_installation(extra, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 11, 0))
    monkeypatch.setattr(installation, "_CHECKOUT", tmp_path)
    assert install_advice(extra) == f"pip install 'ultragray[{extra}]'"
    (tmp_path / "proto").mkdir()
    (tmp_path / "proto" / "pyproject.toml").touch()
    stubs = "./proto " if extra == "serve" else ""
    assert install_advice(extra) == f"pip install {stubs}'ultragray[{extra}]'"
    monkeypatch.setattr(sys, "prefix", str(tmp_path / ".venv"))
    assert install_advice(extra) == f".venv/bin/pip install {stubs}'ultragray[{extra}]'"


def test_a_module_of_nobody_is_no_missing_extra():
    with pytest.raises(ModuleNotFoundError):
        missing_extra(ModuleNotFoundError("no module", name="ultragray.renderring"), "it")
    told = missing_extra(ModuleNotFoundError("no module", name="opentelemetry.sdk"), "it")
    assert isinstance(told, ExtraMissing)
    assert "[tracing]" in told.detail


CORE_ALONE = f"""
import sys
sys.path[:] = {sys.path!r}

class NoExtras:
    def find_spec(self, name, path=None, target=None):
        if name in {sorted(name for names in MODULES_OF_EXTRAS.values() for name in names)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, NoExtras())
from ultragray_service.cli.app import app
app()
"""


def core_alone(*arguments):
    return subprocess.run([sys.executable, "-c", CORE_ALONE, *arguments], capture_output=True, text=True, timeout=300)


@pytest.mark.long
def test_the_core_renders_without_any_extra(working_folder):
    for arguments in (
        ("demo", "-o", "demo.ugr"),
        ("render", "demo.ugr", "--height", "16", "--width", "16", "-o", "frames.npz"),
        ("render", "demo.ugr", "--height", "16", "--width", "16", "-o", "pictures"),
    ):
        done = core_alone(*arguments)
        assert done.returncode == 0, done.stderr
    assert (working_folder / "frames.npz").stat().st_size > 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "extra"),
    [("serve", "serve"), ("worker", "serve"), ("keys list", "serve"), ("report absent -o r.html", "train")],
)
def test_a_command_without_its_extra_says_what_to_install(command, extra):
    done = core_alone(*command.split())
    assert done.returncode == 2
    *_, last = done.stderr.splitlines()
    assert re.fullmatch(r"error: this command needs \w+, which is not installed: .*", last), done.stderr
    assert last.endswith(install_advice(extra))
    assert "Traceback" not in done.stderr


PROJECTS = sorted(FOLDERS)


@pytest.mark.parametrize("name", PROJECTS)
def test_the_readme_holds_without_the_repository(name):
    text = (FOLDERS[name] / project(name)["readme"]).read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]*)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    assert [link for link in links if "://" not in link] == [], "a package index does not have the files beside it"


@pytest.mark.slow
def test_the_example_of_the_library_runs(working_folder):
    copy_demo_scene(working_folder / "demo.ugr")
    text = (ROOT / project("ultragray")["readme"]).read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names = {}
    exec(example, names)
    assert tuple(names["frames"].bmode.shape) == (4, 256, 256)


def test_every_package_has_one_owner():
    owned = [package for name in PROJECTS for package in packages(name)]
    there = {path.parent.name for path in ROOT.glob("*/ultragray*/__init__.py")}
    assert sorted(owned) == sorted(there)


def test_service_and_client_need_the_messages_of_their_version():
    wanted = f"ultragray-proto~={__version__}"
    assert wanted in project("ultragray")["optional-dependencies"]["serve"]
    assert wanted in project("ultragray-client")["dependencies"]


def test_client_and_messages_pin_what_the_service_pins():
    own = project("ultragray")
    service = {*own["dependencies"], *own["optional-dependencies"]["serve"]}
    for name in ("ultragray-client", "ultragray-proto"):
        assert set(project(name)["dependencies"]) <= service

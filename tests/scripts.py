"""Scripts and packages that are not installed, such as generators, as modules."""

import importlib
import importlib.util
import sys

from .surroundings import ROOT

BENCHMARKS = ROOT / "benchmarks"


def loaded(path):
    """The module of a script, which is run under its name and not kept among the imported ones."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def benchmark(name):
    """A module of the folder benchmarks, whose scripts import each other as they do when they are run."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(BENCHMARKS))


def loaded_package(folder):
    """The package in a folder, kept among the imported modules, so that `import_module` finds what is in it."""
    if folder.name not in sys.modules:
        places = [str(folder)]
        spec = importlib.util.spec_from_file_location(
            folder.name, folder / "__init__.py", submodule_search_locations=places
        )
        sys.modules[folder.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[folder.name])
    return sys.modules[folder.name]

"""Wrong command lines, one a row: exit code 2, one line that says what is wrong, and nothing is written."""

import os
import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ultragray.phantom.demo import copy_demo_scene

from .command_line import noise_sweep, python, run, succeeded

SOURCES = str(Path(__file__).resolve().parents[3])
NOBODY = "http://127.0.0.1:9"  # the port of `discard`, where nobody listens

WRONG = {  # the command line, and a part of the line that it gives
    # Commands and options.
    "rendr scene.ugr": "no such command 'rendr'. Did you mean 'render'?",
    "--vresion": "no such option: --vresion; did you mean --version?",
    "render scene.ugr -o a.npz --heigth 3": "no such option: --heigth; did you mean --height",
    "jobs list --server http://x": "no such option: --server",
    "render": "missing argument 'SCENE'",
    "render scene.ugr": "missing option '--output' / '-o'",
    "render scene.ugr -o": "option '-o' requires an argument",
    "render scene.ugr other.ugr -o a.npz": "unexpected extra argument",
    "keys create alice": "missing option '--role'",
    # Values of options.
    "render scene.ugr -o a.npz --height tall": "--height must be a valid integer, got 'tall'",
    "render scene.ugr -o a.npz --height 0": "height must be an integer from 1",
    "render scene.ugr -o a.npz --sampler orbit": "--sampler must be one of around",
    "render scene.ugr -o a.npz --probe {": "P4-2, or a JSON object",
    "render scene.ugr -o a.npz --backend gpu": "backend must be one of",
    'render scene.ugr -o a.npz --probe {"kind":"sector"}': "kind must be one of convex, linear, phased",
    "render scene.ugr -o a.npz --tgc-db 1,two": "tgc_db[1] must be a finite number from -100 to 100, got 'two'",
    "render scene.ugr -o a.dcm --outputs echo": "bmode alone in format dicom",
    "render scene.ugr -o pictures --dtype uint8": "--dtype must be left out for PNGs",
    "render scene.ugr -o a.npz --seed 3": "--seed is of a sampler",
    "render scene.ugr -o a.npz --sampler around": "--sampler around needs --count",
    "render scene.ugr -o a.npz --sampler around --count 3 --step-deg 2": "--sampler around takes no --step-deg",
    "render scene.ugr -o a.npz --sampler around --count 100001": "count 100,001 is more than the 100,000 poses",
    "render scene.ugr -o a --sampler around --count 20 --shard-frames 5": "--shard-frames is of shards: name an engine",
    "render scene.ugr -o a --sampler around --count 20 --on spark": "on must be ray or ray://HEAD:PORT, got 'spark'",
    "render scene.ugr -o a.npz --threads -1": "--threads must be greater than or equal to 0, got '-1'",
    "train sweep -o a.ugr --set stepz=3": "stepz",
    "train sweep -o a.ugr --set steps": "--set takes NAME=VALUE, got 'steps'",
    "train sweep -o a.ugr --device gpu": "device must be cpu, cuda or cuda:N",
    "train sweep -o a.ugr --config none.toml": "none.toml",
    "train sweep -o a.ugr --resume": "no checkpoint to resume from",
    "compare sweep --methods middle": "methods must be some of all, scene, median, mean, maximum",
    "compare sweep --times 0": "times must be",
    "voxelize scene.ugr -o v.nii --right 0,1,0": "right and down are for a slice",
    "voxelize scene.ugr -o s.png --plane-mm 0,0,nan --size-mm 9,9": "plane_mm must be 3 finite numbers",
    "voxelize scene.ugr -o s.png": "is for a slice: give plane_mm and size_mm",
    "voxelize scene.ugr -o v.nrrd --spacing-mm 0.01": "the limit is",
    "edit scene.ugr -o a.ugr": "at least one edit must be given: --edits, --cut-box-mm",
    "edit scene.ugr -o a.ugr --insert cyst --at-mm 500,0,0": "shape must lie in the scene, from [",
    "from-labels -o a.ugr": "--tissue must be a TOML or JSON file with a list of bodies",
    "from-labels -o a.ugr --tissue pose.json": "pose.json must be a TOML or JSON file with a list of bodies",
    "worker --artifact-folder . --device tpu": "device must be auto, cpu, cuda or cuda:N, got 'tpu'",
    "worker --artifact-folder . --label lab1": "--label takes NAME=VALUE, got 'lab1'",
    "eval scene.ugr sweep --split half": "--split must be one of val, train, got 'half'",
    "check sweep --train-frames x": "train_frames",
    "check sweep --crop 1:2,3:4": "crop is for PLUS sequences",
    "convert sweep -o made --image-size huge": "image_size",
    "keys create alice --role king": "--role must be one of reader, operator, admin, got 'king'",
    "keys create alice --role reader --limit speed=3": "speed",
    "jobs submit render demo --require lab1": "--require",
    "jobs submit train liver --scene s --priority 5000": "--priority must be less than or equal to 1000, got '5000'",
    "bench --train --jobs": "give one of --train, --jobs",
    "bench --backend gpu": "backend must be cpu or cuda",
    "serve scene.ugr --http-port 70000": "http_port",
    "serve scene.ugr --log-format xml": "log_format",
    "serve scene.ugr --data-folder .": "cannot be given together",
    "serve --data-folder none": "data_folder must be an existing folder",
    "serve scene.ugr --http-port 0 --grpc-port BUSY": "the port is in use; give another one with --grpc-port",
    "serve scene.ugr --grpc-port 0 --http-port BUSY": "the port is in use; give another one with --http-port",
    # Files that are not there, or are something else.
    "render none.ugr -o a.npz": "none.ugr: no such file",
    "render notes.ugr -o a.npz": "notes.ugr: not a scene file",
    "render . -o a.npz": ".: ",
    "render scene.ugr -o a.npz --poses none.npy": "none.npy: no such file",
    "render scene.ugr -o a.npz --poses notes.txt": "poses are read from .npy, .json and .mcap files",
    "show notes.txt": "notes.txt: a dataset is",
    "show scene.ugr --crop 1:2,3:4": "options of sweeps are not for scene.ugr",
    "check none": "none: no such file or folder",
    "train none -o a.ugr": "none: no such file or folder",
    "motion scene.ugr -o a.ugr --sweep none --surrogate none.csv": "none.csv not found",
    "import scene.ugr -o a.ugr": "import reads .ply and .pt files",
    "import none.ply -o a.ugr": "none.ply: no such file",
    "import notes.ply -o a.ugr": "notes.ply",
    "import notes.pt -o a.ugr": "--config must be given",
    "serve notes.ugr": "notes.ugr: not a scene file",
    "show cut.ugr": "cut.ugr: cut off",
    "show begun.ugr": "begun.ugr: not a scene file",
    "train notes -o a.ugr": "notes must hold a folder with conf.json",
    "datasets upload notes": "notes must hold a folder with conf.json",
    "datasets upload none": "none: no such file or folder",
    "datasets upload notes.txt": "an upload is an archive",
    "localize scene.ugr notes.txt --start pose.npy": "must end in .png or .npy",
    "calibrate points notes.txt pose.npy -o a.json": "must end in .npy or .csv",
    "storage copy none to": "FROM must be an existing folder",
    "worker --data-folder none": "artifact_folder must be an existing folder",
    "scenes upload notes.ugr": "notes.ugr: not a scene file",
    "backup backups --data-folder none": "none",
    "restore none": "none",
    "keys list --data-folder none": "data_folder must be an existing folder, got 'none'",
    "workers list --data-folder none": "no such option: --data-folder",
    # Outputs.
    "render scene.ugr -o a.foo": "got 'a.foo'",
    "render scene.ugr -o a.mha": "did you mean .igs.mha?",
    "render scene.ugr -o kept.npz": "kept.npz exists: --force replaces it",
    "render scene.ugr -o sweep": "sweep holds files: --force writes among them",
    "render scene.ugr -o none/a.npz": "none does not",
    "render scene.ugr -o a.png": "or be a folder for PNGs",
    "export scene.ugr -o none/none/a.pt": "none does not",
    "import notes.ply -o a.txt": "output must end in .ugr",
    "eval scene.ugr sweep -o notes.txt": "notes.txt is a file",
    "report sweep -o sweep": "is a folder",
    "voxelize scene.ugr -o v.mha": "must end in .nii.gz, .nii or .nrrd",
    "slicer scene.ugr -o a.xml": "must end in .mrml",
    "train sweep -o scene.ugr": "scene.ugr exists: --force",
    "convert sweep -o sweep": "sweep holds files",
    "export scene.ugr -o a.stl": "output must end in .ugz, .ply or .pt",
    "bench -o scene.ugr": "scene.ugr exists: --force",
    f"scenes download demo -o scene.ugr --address {NOBODY}": "scene.ugr exists: --force",
    f"scenes render demo -o a.gif --address {NOBODY}": "must end in .png, .jpg or .npz",
    f"scenes render demo -o a.png --outputs bmode,echo --address {NOBODY}": "a picture holds one output",
    f"scenes render demo -o a.png --height 100000 --address {NOBODY}": "height must be",
    f"scenes render demo -o a.png --registration arm --address {NOBODY}": "a registration leads the poses of a file",
    f"jobs download 7 name -o none/name --address {NOBODY}": "output must lie in a folder that exists",
    # A service that is not there.
    "scenes list --address ftp://localhost": "--address must be HOST:PORT or a URL such as http://127.0.0.1:8000",
    "scenes list --address 127.0.0.1:9": f"no service answers at {NOBODY} (connection refused)",
    "scenes show a/b": "scenes have names of letters, digits, '.', '_' and '-', got 'a/b'",
    "jobs cancel a/b": "jobs have names",
    f"scenes list --address {NOBODY}": f"no service answers at {NOBODY} (connection refused)",
    f"datasets upload sweep --address {NOBODY}": f"no service answers at {NOBODY}",
    f"jobs watch 7 --address {NOBODY}": f"no service answers at {NOBODY}",
    f"jobs list --address {NOBODY} --ca notes.txt": "--ca: notes.txt holds no certificates",
    f"jobs list --address {NOBODY} --client-key k.pem": "--client-certificate and --client-key must be given together",
}

AS_PROCESSES = (  # the start of a process and its end are real here
    "rendr scene.ugr",
    "render scene.ugr -o a.npz --heigth 3",
    "render none.ugr -o a.npz",
    "render scene.ugr -o a.npz --backend gpu",
    "train none -o a.ugr",
    "import notes.ply -o a.ugr",
    f"jobs watch 7 --address {NOBODY}",
    "serve scene.ugr --http-port 0 --grpc-port BUSY",
    "serve scene.ugr --grpc-port 0 --http-port BUSY",
)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a scene, a sweep, and files that are something else."""
    folder = tmp_path_factory.mktemp("place")
    copy_demo_scene(folder / "scene.ugr")
    whole = (folder / "scene.ugr").read_bytes()
    (folder / "cut.ugr").write_bytes(whole[: len(whole) // 2])
    (folder / "begun.ugr").write_bytes(whole[:20])
    (folder / "notes").mkdir()
    (folder / "notes" / "notes.txt").touch()
    noise_sweep(folder / "sweep")
    np.save(folder / "pose.npy", np.eye(4))
    (folder / "pose.json").write_text("[]")
    for name in ("notes.txt", "notes.ugr", "notes.ply", "notes.pt", "kept.npz"):
        (folder / name).write_text("some notes, long enough to be looked at")
    return folder


@pytest.fixture(scope="module")
def busy_port():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        yield taken.getsockname()[1]


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def check(line, code, stdout, stderr):
    assert code == 2, stderr
    assert stdout == ""
    (told,) = [one for one in stderr.splitlines() if not one.startswith(("simulating", "warning: "))]
    assert told.startswith("error: ")
    assert WRONG[line] in told
    for noise in ("Traceback", SOURCES, ".py", "PosixPath", "<class", "0x", ".tmp", "Errno"):
        assert noise not in told


@pytest.mark.parametrize("line", [line for line in WRONG if line not in AS_PROCESSES])
def test_one_line_tells_a_mistake(line, place, monkeypatch):
    monkeypatch.chdir(place)
    before = contents(place)
    result = run(*line.split())
    check(line, result.exit_code, result.stdout, result.stderr)
    assert contents(place) == before


@pytest.mark.long
@pytest.mark.parametrize("line", AS_PROCESSES)
def test_a_process_ends_with_one_line(line, place, busy_port):
    before = contents(place)
    arguments = line.replace("BUSY", str(busy_port)).split()
    program = "from ultragray_service.cli.app import app; app()"
    ended = subprocess.run(
        python(program, *arguments), cwd=place, env=clean_environment(), capture_output=True, text=True, timeout=300
    )
    log = [one for one in ended.stderr.splitlines() if not one.startswith(("{", "Datasets and jobs end"))]
    check(line, ended.returncode, ended.stdout, "\n".join(log))
    assert contents(place) == before


def clean_environment():
    return {name: value for name, value in os.environ.items() if not name.startswith("ULTRAGRAY_")}


def test_a_mistake_is_told_before_torch_is_imported(place):
    lines = [
        line for line in WRONG if line.split()[0] in ("render", "train", "eval", "check", "scenes", "jobs", "show")
    ]
    quick = [line for line in lines if not line.endswith(("--backend gpu", "--device gpu")) and "BUSY" not in line]
    program = (
        "from typer.testing import CliRunner; from ultragray_service.cli.app import app\n"
        f"for line in {quick!r}:\n"
        "    CliRunner().invoke(app, line.split()); assert 'torch' not in sys.modules, line"
    )
    done = subprocess.run(python(program), cwd=place, env=clean_environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("variable", "meant"),
    [
        ("ULTRAGRAY_ADRESS", "; did you mean ULTRAGRAY_ADDRESS?"),
        ("ULTRAGRAY_HTTP_PROT", "; did you mean ULTRAGRAY_HTTP_PORT?"),
        ("ULTRAGRAY_SERVER", ""),  # the beginning that all share makes it like none of them
    ],
)
def test_a_misspelt_variable_is_told(variable, meant, place, monkeypatch):
    monkeypatch.setenv(variable, "1")
    result = succeeded("show", place / "scene.ugr", "--json")
    assert f"the environment variable {variable} is not known and is ignored{meant}\n" in result.stderr

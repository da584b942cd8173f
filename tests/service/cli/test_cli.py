"""The command line: real files in, real files out; a mistake gives one line and exit code 2."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import urllib.request

import numpy as np
import pytest
import torch
import typer

import ultragray
from ultragray import GaussianScene, LinearProbe
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.phantom.demo import DEMO_FILE
from ultragray_service.cli.app import app
from ultragray_service.cli.serve import ensure_scenes, link_scenes
from ultragray_service.settings import Settings
from ultragray_workers.scene_shelf import SCENES_FOLDER

from .command_line import python, refused, run, succeeded

SILENT = ("serve", "worker")  # they tell in a log


def all_commands():
    """Every command that does something itself, by its words."""
    waiting = list(typer.main.get_command(app).commands.items())
    found = {}
    while waiting:
        name, command = waiting.pop(0)
        if hasattr(command, "commands"):
            waiting += [(f"{name} {word}", inner) for word, inner in command.commands.items()]
        else:
            found[name] = command
    return found


COMMANDS = all_commands()
FIRST_WORDS = tuple(dict.fromkeys(name.split()[0] for name in COMMANDS))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command):
    result = succeeded(*command.split(), "--help")
    assert f"Usage: root {command}" in result.output
    assert "Examples" in result.output
    lines = re.findall(r"^ (?:\w+=\S+ )?ultragray ([a-z].*)$", result.output, re.MULTILINE)
    assert any(line.startswith(command) for line in lines), "an example is of another command"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_tells_something_tells_it_to_programs_too(command):
    options = {name: parameter for parameter in COMMANDS[command].params for name in parameter.opts}
    assert ("--json" in options) is (command not in SILENT)
    if "--output" in options:
        assert "--force" in options
    for name, option in options.items():
        if name.startswith("--") and name not in ("--help",):
            assert str(option.help)[-1] in ".)]", f"{command} {name}: {option.help}"


def test_help_is_instant_it_imports_nothing_heavy():
    program = (
        "from typer.testing import CliRunner; from ultragray_service.cli.app import app\n"
        "told = CliRunner().invoke(app, ['--help']).stdout\n"
        f"assert all(word in told for word in {FIRST_WORDS!r})\n"
        "assert not {'torch', 'fastapi', 'grpc', 'cv2', 'uvicorn'} & set(sys.modules)\n"
        f"for word in {FIRST_WORDS!r}:  # loads the module of the command\n"
        "    CliRunner().invoke(app, [word, '--help']); assert 'torch' not in sys.modules, word"
    )
    done = subprocess.run(python(program), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_completion_knows_commands_and_options():
    def completed(words):
        environment = {**os.environ, "_ULTRAGRAY_COMPLETE": "complete_bash", "COMP_WORDS": words}
        environment["COMP_CWORD"] = str(len(words.split(" ")) - 1)
        program = "from ultragray_service.cli.app import app; app(prog_name='ultragray')"
        return subprocess.run(python(program), env=environment, capture_output=True, text=True, check=False).stdout

    assert completed("ultragray re").split() == ["render", "recordings", "registrations", "restore", "report"]
    assert "--outputs" in completed("ultragray render --out").split()


def test_version():
    assert run("--version").output.strip() == f"ultragray {ultragray.__version__}"


def test_the_defaults_that_serve_names_are_those_of_the_settings():
    options = {p.name: p for p in typer.main.get_command(app).commands["serve"].params}
    for name, option in options.items():
        field = "threads_per_process" if name == "threads" else name
        if hasattr(Settings, field):
            default = getattr(Settings, field)
            says_none = default is None or default is False  # a flag
            assert option.show_default == (False if says_none else str(default))
            assert f"ULTRAGRAY_{field.upper()}" in option.help


def test_show_tells_what_the_file_says(scene_file):
    result = succeeded("show", scene_file, "--json")
    document = json.loads(result.output)
    assert document["sha256"] == file_sha256(scene_file)
    assert document["gaussian_count"] == 60
    assert document["probe"] == {"kind": "linear", "width_mm": 30.0, "near_mm": 0.0, "far_mm": 40.0}
    assert document["centre_mm"] == [1.0, 2.0, 3.0]
    assert document["training_poses"]["count"] == 5
    table = run("show", scene_file).output
    for expected in (file_sha256(scene_file), "gaussian_count", "60", "width_mm=30"):
        assert expected in table


@pytest.fixture
def released(tmp_path, random_scene, random_poses):
    torch.save({"step": 3, "splats": random_scene(8).splats}, tmp_path / "ckpt.pt")
    conf = {
        "images_file_train": "images_train.npy",
        "ultrasound_near_plane": 0.0,
        "ultrasound_far_plane": 4.0,
        "ultrasound_opening_width": 3.0,
    }
    (tmp_path / "conf.json").write_text(json.dumps(conf))
    np.save(tmp_path / "images_train.npy", np.zeros((4, 9, 7), np.uint8))
    np.save(tmp_path / "poses_train.npy", random_poses(4))
    return tmp_path


def test_import_of_a_checkpoint_writes_a_scene(released):
    output = released / "scene.ugr"
    common = ("import", released / "ckpt.pt", "--config", released / "conf.json", "-o", output)
    succeeded(*common, "--poses", released / "poses_train.npy")
    scene = GaussianScene.load(output)
    assert scene.info.probe == LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=45.0)
    assert len(scene.training_poses) == 4
    assert f"{output} exists: --force replaces it" in refused(*common, "--centered")
    succeeded(*common, "--force", "--center", "-1", "2.5", "-3e2")
    assert GaussianScene.load(output).info.centre_mm == (-1.0, 2.5, -300.0)
    succeeded(*common, "--force", "--centered", "--image-height", 5)
    assert GaussianScene.load(output).info.image_height == 5


def test_import_of_a_checkpoint_says_what_it_needs(released):
    output = released / "scene.ugr"
    common = ("import", released / "ckpt.pt", "--config", released / "conf.json", "-o", output)
    for extra in ([], ["--centered", "--center", 0, 0, 0]):
        message = refused(*common, *extra)
        assert all(option in message for option in ("--poses", "--center X Y Z", "--centered"))
    (released / "images_train.npy").unlink()
    assert "--image-height" in refused(*common, "--centered")
    (released / "ckpt.pt").write_bytes(b"")
    assert "ckpt.pt: truncated" in refused(*common, "--centered", "--image-height", 9)
    assert not output.exists()


def test_demo_writes_the_demo_scene(tmp_path):
    output = tmp_path / "d.ugr"
    succeeded("demo", "-o", output)
    assert output.read_bytes() == DEMO_FILE.read_bytes()
    assert "folder that exists" in refused("demo", "-o", tmp_path / "absent" / "d.ugr")
    assert "output must end in .ugr, got 'd.txt'" in refused("demo", "-o", tmp_path / "d.txt")


def test_a_data_folder_without_scenes_gets_the_demo(tmp_path, capsys):
    folder = tmp_path / "data"
    with pytest.raises(InvalidArgument, match="existing folder"):  # its name may be mistyped
        ensure_scenes(folder)
    folder.mkdir()
    ensure_scenes(folder)
    assert [p.name for p in folder.iterdir()] == ["demo.ugr"]
    assert "holds no scenes: wrote" in capsys.readouterr().err
    assert (folder / "demo.ugr").read_bytes() == DEMO_FILE.read_bytes()
    ensure_scenes(folder)
    assert capsys.readouterr().err == ""


def test_given_scenes_are_linked_under_their_own_names(scene_file, tmp_path):
    folder = tmp_path / "links"
    folder.mkdir()
    link_scenes([scene_file], folder)
    assert (folder / "scene.ugr").resolve() == scene_file.resolve()
    with pytest.raises(InvalidArgument, match="'scene' comes twice"):
        link_scenes([scene_file], folder)
    odd = scene_file.rename(tmp_path / "no name.ugr")
    with pytest.raises(InvalidArgument, match="letters, digits"):
        link_scenes([odd], folder)
    with pytest.raises(SceneFileInvalid, match="no such file"):
        link_scenes([tmp_path / "absent.ugr"], folder)


def test_a_shared_queue_needs_a_shared_artifact_folder(scene_file, monkeypatch):
    monkeypatch.setenv("ULTRAGRAY_DATABASE_URL", "postgresql://localhost/jobs")
    assert "--artifact-folder" in refused("serve", scene_file)


@contextlib.contextmanager
def served(folder, *arguments):
    """`ultragray serve` on free ports, started in `folder`, and the address of its HTTP."""
    program = "from ultragray_service.cli.app import app; app()"
    command = python(program, "serve", *arguments, "--http-port", 0, "--grpc-port", 0, "--threads", 1)
    with subprocess.Popen(command, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True, cwd=folder) as service:
        try:
            assert service.stdout is not None
            yield service, next(m[0] for line in service.stdout if (m := re.search(r"http://127\.0\.0\.1:\d+", line)))
        finally:
            service.terminate()  # it takes its folder of links with it


def names_of_scenes(address):
    with urllib.request.urlopen(f"{address}/v1/scenes", timeout=300) as answer:
        return [scene["name"] for scene in json.load(answer)["scenes"]]


@pytest.fixture
def used_folder(tmp_path, scene_file):
    """A folder in which somebody has served ./data and trained scenes, one of them under the name of `scene_file`."""
    folder = tmp_path / "used"
    trained = folder / "data" / "artifacts" / SCENES_FOLDER
    trained.mkdir(parents=True)
    for path in (folder / "data" / "demo.ugr", trained / "liver.ugr", trained / "scene.ugr"):
        shutil.copy(scene_file, path)
    return folder


@pytest.mark.slow
def test_serve_serves_the_given_file_alone_until_sigterm(scene_file, used_folder):
    before = sorted(used_folder.rglob("*"))
    with served(used_folder, scene_file) as (service, address):
        assert names_of_scenes(address) == ["scene"]
        service.send_signal(signal.SIGTERM)
        said, _ = service.communicate(timeout=300)
        assert service.returncode == 0
    assert "Traceback" not in said
    assert scene_file.exists()
    assert sorted(used_folder.rglob("*")) == before

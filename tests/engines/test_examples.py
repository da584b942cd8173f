"""The examples in C and C++, built against an installed libultragray as projects of others are: frames and leaks."""

import subprocess

import numpy as np
import pytest

from ultragray import GaussianScene
from ultragray.phantom.demo import DEMO_FILE
from ultragray_client import Client
from ultragray_client import RenderSettings as ClientSettings

from ..model.library.test_builds import needs
from ..model.library.test_library import of_python
from .conftest import ENGINES, ROOT
from .test_csharp import free_port

EXAMPLES = ENGINES / "examples"
LEAKS = ["valgrind", "--quiet", "--leak-check=full", "--errors-for-leak-kinds=all", "--error-exitcode=9"]
pytestmark = pytest.mark.long


def cmake(source, folder, *options):
    for command in (["-S", source, "-B", folder, *options], ["--build", folder, "--parallel", "2"]):
        ran = subprocess.run(["cmake", *command], capture_output=True, text=True)
        assert ran.returncode == 0, ran.stdout + ran.stderr
    return folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder that libultragray is installed in."""
    needs("cmake", "c++", "pkg-config", "valgrind")
    prefix = tmp_path_factory.mktemp("prefix")
    options = ["-DULTRAGRAY_PYTHON=OFF", "-DCMAKE_BUILD_TYPE=Release", f"-DCMAKE_INSTALL_PREFIX={prefix}"]
    build = cmake(ROOT, tmp_path_factory.mktemp("library"), *options)
    subprocess.run(["cmake", "--install", build], check=True, capture_output=True)
    return prefix


@pytest.fixture(scope="module")
def built(installed, tmp_path_factory):
    """The folder of the examples, which find_package found the library for."""
    return cmake(EXAMPLES, tmp_path_factory.mktemp("examples"), f"-DCMAKE_PREFIX_PATH={installed}")


@pytest.fixture(scope="module")
def python_scene():
    return GaussianScene.load(DEMO_FILE)


def swept(steps):
    """Poses [C, 4, 4] along 10 mm of elevation, as the examples have them."""
    poses = np.tile(np.eye(4), (steps, 1, 1))
    poses[:, 1, 3] = 10.0 * np.arange(steps) / steps
    return poses


def test_a_frame_in_c_is_that_of_python_and_nothing_leaks(built, python_scene, tmp_path):
    picture = tmp_path / "frame.pgm"
    for watched in (LEAKS, []):  # valgrind has no AVX-512: the picture of the second run stays
        ran = subprocess.run([*watched, built / "frame", DEMO_FILE, picture], capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
    pose = np.eye(4)
    pose[1, 3] = 19.0
    shown, (extrapolation,) = of_python(python_scene, {"height": 384, "width": 384}, pose[None])
    assert picture.read_bytes() == b"P5 384 384 255\n" + shown["bmode"].tobytes()
    assert ran.stdout == f"expected similarity {extrapolation.confidence:.3f}\n"
    refused = subprocess.run([*LEAKS, built / "frame", __file__, picture], capture_output=True, text=True)
    assert (refused.returncode, refused.stderr.count("\n")) == (1, 1), refused.stderr


def test_a_program_that_pkg_config_finds_the_library_for(installed, tmp_path):
    (folder,) = installed.glob("lib*/**/pkgconfig")
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "ultragray"],
        env={"PKG_CONFIG_PATH": str(folder), "PATH": "/usr/bin"},
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    program = tmp_path / "frame"
    rpath = f"-Wl,-rpath,{folder.parent}"
    subprocess.run(["cc", EXAMPLES / "frame.c", *flags, rpath, "-o", program], check=True)
    subprocess.run([program, DEMO_FILE, tmp_path / "frame.pgm"], check=True)


def test_a_sweep_in_cpp_is_that_of_python_and_nothing_leaks(built, python_scene):
    for watched in (LEAKS, []):
        ran = subprocess.run([*watched, built / "sweep", DEMO_FILE, "3"], capture_output=True)
        assert ran.returncode == 0, ran.stderr
    shown, _ = of_python(python_scene, {"height": 128, "width": 96}, swept(3))
    assert ran.stdout == shown["bmode"].tobytes()


@pytest.fixture
def stream(built):
    if not (built / "stream").is_file():
        pytest.skip("needs Debian's libgrpc++-dev, libprotobuf-dev and protobuf-compiler-grpc")
    return built / "stream"


def test_a_stream_in_cpp_gets_the_frames_of_the_service(stream, start_service, data_folder):
    service = start_service()
    command = [stream, service.grpc, "demo", "20", data_folder / "demo.ugr"]
    ran = subprocess.run(command, capture_output=True)
    assert ran.returncode == 0, ran.stderr
    with Client(service.grpc, timeout_s=300.0) as client:
        frames = [client.render("demo", pose, ClientSettings(height=128, width=96))["bmode"] for pose in swept(20)]
    assert ran.stdout == np.stack(frames).tobytes()
    assert ran.stderr.count(b"differs from this machine's by 0\n") == 20
    refused = subprocess.run([stream, service.grpc, "nope", "1"], capture_output=True, text=True)
    assert (refused.returncode, refused.stderr.partition(";")[0]) == (1, "there is no scene 'nope'")


def test_a_stream_in_cpp_goes_on_after_the_service_was_killed(stream, start_service):
    port, steps = free_port(), 300
    service = start_service(grpc_port=port)
    command = [stream, service.grpc, "demo", str(steps)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:
        first = program.stdout.read(128 * 96)
        service.process.kill()
        service.process.wait()
        start_service(grpc_port=port)
        rest, told = program.communicate()
    assert program.returncode == 0, told
    assert b"the stream broke, and is opened again" in told
    assert len(first + rest) == steps * 128 * 96

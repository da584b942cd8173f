"""Builds the image of docker/Dockerfile with neither an engine nor a registry of images: `make test-image`.

buildah builds it, as root, without namespaces. Its base is a Debian that mmdebstrap makes from this machine's own apt
sources, its Node is this machine's, and pip is configured in the build as it is here. What was built before is reused.
"""

import configparser
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit

from ultragray import __version__

ROOT = Path(__file__).resolve().parents[2]
IMAGE = "localhost/ultragray:cpu"
RELEASE = "bookworm"  # as the Dockerfile's own base
BASE = f"localhost/ultragray-debian:{RELEASE}"
NODE = "localhost/ultragray-node:latest"
CA_BUNDLE = Path("/etc/ssl/certs/ca-certificates.crt")
TOOLS = ("buildah", "mmdebstrap", "node", "npm")
_APT_SOURCES = ("sources.list", "sources.list.d/debian.sources")
# As Debian's images: manuals, translations and documents stay away, licences do not.
_LEFT_OUT = (
    *("path-exclude=/usr/share/man/*", "path-exclude=/usr/share/locale/*", "path-exclude=/usr/share/doc/*"),
    "path-include=/usr/share/doc/*/copyright",
)


def run(*command):
    subprocess.run(command, check=True)


def output(*command):
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.strip()


def problems():
    """A sentence for each thing that the build needs and this machine lacks."""
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        yield f"not installed: {', '.join(missing)}; on Debian: sudo apt-get install {' '.join(missing)}"
    if os.geteuid() != 0:
        yield "the image is built and mounted as root; run: sudo make test-image"


def has(image):
    return subprocess.run(["buildah", "inspect", "--type", "image", image], capture_output=True).returncode == 0


def commit(image, base, *steps):
    """Make `image` of `base` by steps of buildah; each gets the container as its second word."""
    container = output("buildah", "from", "--pull-never", base)
    try:
        for command, *arguments in steps:
            run("buildah", command, *(("--quiet",) if command in ("add", "copy") else ()), container, *arguments)
        run("buildah", "commit", "--quiet", container, image)
    finally:
        run("buildah", "rm", container)


def make_base():
    """A Debian like the official image, from this machine's apt sources."""
    sources = [path for name in _APT_SOURCES if (path := Path("/etc/apt", name)).is_file()]
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(folder, "debian.tar")
        options = [f"--dpkgopt={option}" for option in _LEFT_OUT]
        run("mmdebstrap", "--quiet", "--variant=minbase", *options, RELEASE, archive, *sources)
        commit(BASE, "scratch", ("add", archive, "/"))


def make_node():
    """The base with this machine's Node and npm, and npm's configuration."""
    node, npm = Path(shutil.which("node") or ""), Path(shutil.which("npm") or "").resolve().parents[1]
    with tempfile.TemporaryDirectory() as folder:
        command = Path(folder, "npm")
        command.write_text('#!/bin/sh\nexec node /opt/npm/bin/npm-cli.js --globalconfig /etc/npmrc "$@"\n')
        command.chmod(0o755)
        configured = Path(output("npm", "config", "get", "globalconfig"))
        settings = Path(folder, "npmrc")
        settings.write_bytes(configured.read_bytes() if configured.is_file() else b"")
        steps = [
            ("copy", node.resolve(), "/usr/bin/node"),
            ("copy", npm, "/opt/npm"),
            ("copy", command, "/usr/bin/npm"),
            ("copy", settings, "/etc/npmrc"),
            *([("copy", CA_BUNDLE, CA_BUNDLE)] if CA_BUNDLE.is_file() else []),
        ]
        commit(NODE, BASE, *steps)


def pip_configuration(folder):
    """Options that give the build this machine's pip configuration, with the local files that it names."""
    configuration = configparser.RawConfigParser()
    configuration.add_section("global")
    volumes = []
    for line in output(sys.executable, "-m", "pip", "config", "list").splitlines():
        section, _, rest = line.partition(".")
        name, _, value = rest.partition("=")
        words = value.strip("'\"").replace("\\n", " ").split()
        for number, word in enumerate(words):
            if word.startswith("file://"):  # an index, whose pages lead to files beside it
                folder_of_index = Path(urlsplit(word).path).parent
                volumes.append(f"--volume={folder_of_index}:{folder_of_index}:ro")
            elif (path := Path(word)).is_absolute() and path.exists():
                inside = path if path.is_dir() else Path("/mnt", path.name)  # a file may be in a package's way
                volumes.append(f"--volume={path}:{inside}:ro")
                words[number] = str(inside)
        if section == ":env:" or name not in configuration["global"]:  # the environment goes before the files
            configuration["global"][name] = " ".join(words)
    written = folder / "pip.conf"
    with written.open("w") as file:
        configuration.write(file)
    return [f"--secret=id=pip,src={written}", *sorted(set(volumes))]


def build(*arguments):
    with tempfile.TemporaryDirectory() as folder:
        run(
            *("buildah", "build", "--isolation=chroot", "--format=docker", "--layers", "--pull-never"),
            *("--file", ROOT / "docker" / "Dockerfile", "--tag", IMAGE),
            *("--build-arg", f"BASE_IMAGE={BASE}", "--build-arg", f"NODE_IMAGE={NODE}"),
            *("--build-arg", f"VERSION={__version__}", "--build-arg", f"REVISION={revision()}"),
            *pip_configuration(Path(folder)),
            *arguments,
            ROOT,
        )


def revision():
    return output("git", "-C", ROOT, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")


def main():
    found = list(problems())
    if found:
        sys.exit("\n".join(f"error: {problem}" for problem in found))
    if not has(BASE):
        make_base()
    if not has(NODE):
        make_node()
    build(*sys.argv[1:])


if __name__ == "__main__":
    main()

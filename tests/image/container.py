"""A container without an engine: an image's files as the root of processes, with the rights that the image gives."""

from __future__ import annotations

import json
import shlex
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

# The root is read-only. $1: the root, $2 … $4: where /data, the cache and /tmp are; the rest is the command.
_ENTER = """
set -eu
root=$1 data=$2 cache=$3 temporary=$4; shift 4
mount --make-rprivate /
mount --bind "$root" "$root"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
mount --bind /etc/hosts "$root/etc/hosts"
mount --bind "$data" "$root/data"
mount --bind "$cache" "$root/var/cache/ultragray"
mount --bind "$temporary" "$root/tmp"
mount -o remount,bind,ro "$root"
cd /
exec chroot "$root" "$@"
"""


@dataclass(frozen=True)
class Container:
    """One image, mounted, with its writable folders beside it."""

    root: Path
    folder: Path  # holds data, cache and tmp
    configuration: Mapping[str, Any]  # what the image says: User, Env, Cmd, Healthcheck, Labels …

    @property
    def data(self) -> Path:
        return self.folder / "data"

    def command(self, *words: str, environment: Mapping[str, str] | None = None) -> list[str]:
        """What starts `words` as the image's user, in its environment and working folder."""
        user, _, group = self.configuration["User"].partition(":")
        variables = [*self.configuration["Env"], *(f"{name}={value}" for name, value in (environment or {}).items())]
        folders = [str(self.folder / name) for name in ("data", "cache", "tmp")]
        inside = f"cd {shlex.quote(self.configuration['WorkingDir'])} && exec {shlex.join(words)}"
        return [
            *("unshare", "--mount", "sh", "-c", _ENTER, "sh", str(self.root), *folders),
            *("/usr/bin/setpriv", "--reuid", user, "--regid", group or user, "--clear-groups"),
            *("--no-new-privs", "--inh-caps=-all", "--bounding-set=-all"),
            *("/usr/bin/env", "--ignore-environment", *variables, "/bin/sh", "-c", inside),
        ]

    def run(self, *words: str, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
        command = self.command(*words, environment=environment)
        return subprocess.run(command, capture_output=True, text=True, timeout=300)

    def start(self, words: Sequence[str], environment: Mapping[str, str], log: IO[bytes]) -> subprocess.Popen[bytes]:
        """The process that is returned is the one of `words` itself: signals reach it."""
        return subprocess.Popen(self.command(*words, environment=environment), stderr=log, stdin=subprocess.DEVNULL)


@contextmanager
def container_of(image: str, folder: Path) -> Iterator[Container]:
    """The container lives as long as the `with` block; `folder` keeps what it wrote."""
    inspected = subprocess.run(["buildah", "inspect", "--type", "image", image], check=True, capture_output=True)
    configuration = json.loads(inspected.stdout)["Docker"]["config"]
    user, _, group = configuration["User"].partition(":")
    for name in ("data", "cache", "tmp"):
        (folder / name).mkdir()
        subprocess.run(["chown", f"{user}:{group}", folder / name], check=True)
    name = subprocess.run(
        ["buildah", "from", "--pull-never", image], check=True, stdout=subprocess.PIPE, text=True
    ).stdout.strip()
    try:
        mounted = subprocess.run(["buildah", "mount", name], check=True, stdout=subprocess.PIPE, text=True)
        root = Path(mounted.stdout.strip())
        (root / "etc" / "hosts").touch()  # engines make it
        yield Container(root, folder, configuration)
    finally:
        subprocess.run(["buildah", "rm", name], check=True, stdout=subprocess.DEVNULL)

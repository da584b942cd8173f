"""The helper process that loads a scene file which somebody sent, so that only whole ones are served."""

from __future__ import annotations

from typing import Any

from ultragray.errors import SceneFileInvalid
from ultragray.scene_info import read_header

from .helper import answer_request


def main() -> None:
    """Answers the request on stdin."""
    answer_request(check_scene_file)


def check_scene_file(request: dict[str, Any]) -> None:
    """Loads the file at `path`. Raises SceneFileInvalid, in words of the one who sent it."""
    try:
        read_header(request["path"])
        from ultragray.scene import GaussianScene  # torch, which a file that is no scene does not need

        GaussianScene.load(request["path"])
    except SceneFileInvalid as error:
        raise SceneFileInvalid(error.detail.replace(request["path"], "the body"), field="body") from error

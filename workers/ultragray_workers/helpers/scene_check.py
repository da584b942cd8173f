"""Work of a helper process: loading a scene file which somebody sent, so that only whole ones are served."""

from __future__ import annotations

from ultragray.errors import SceneFileInvalid
from ultragray.scene_info import read_header


def check_scene_file(path: str) -> None:
    """Load the file. Raises SceneFileInvalid, which calls it the body."""
    try:
        read_header(path)
        from ultragray.scene import GaussianScene  # torch, which a file that is no scene does not need

        GaussianScene.load(path)
    except SceneFileInvalid as error:
        raise SceneFileInvalid(error.detail.replace(path, "the body"), field="body") from error

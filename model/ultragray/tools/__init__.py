"""Things in the image that the sweep did not have, such as a needle. Needs no torch."""

from .box import Box
from .crossing import Crossing, ScanView
from .cylinder import Cylinder
from .file import load_tools
from .needle import Needle
from .shaft import Shaft
from .tool import DEFAULT_LABEL, MAX_TOOLS, Tool, ToolFrame

__all__ = [
    "DEFAULT_LABEL",
    "MAX_TOOLS",
    "Box",
    "Crossing",
    "Cylinder",
    "Needle",
    "ScanView",
    "Shaft",
    "Tool",
    "ToolFrame",
    "load_tools",
]

"""Things in the image that the sweep did not have, such as a needle. Needs no torch."""

from ultragray.tools.box import Box
from ultragray.tools.crossing import Crossing, ScanView
from ultragray.tools.cylinder import Cylinder
from ultragray.tools.file import load_tools
from ultragray.tools.needle import Needle
from ultragray.tools.shaft import Shaft
from ultragray.tools.tool import DEFAULT_LABEL, MAX_TOOLS, Tool, ToolFrame

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

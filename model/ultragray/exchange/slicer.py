"""A scene file of 3D Slicer (.mrml) for a scene that is served: a connector, the pose that it sends, and a volume.

MRML is XML with one element for each node; nodes have ids and refer to each other by them. The names of elements and
attributes are those that 3D Slicer and its extension SlicerOpenIGTLink write. Free of torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from ultragray.files import write_whole
from ultragray.geometry.probe import FloatArray

_CONNECTOR, _TRANSFORM = "vtkMRMLIGTLConnectorNode1", "vtkMRMLLinearTransformNode1"
_VOLUME, _DISPLAY = "vtkMRMLScalarVolumeNode1", "vtkMRMLScalarVolumeDisplayNode1"
_STORAGE = "vtkMRMLVolumeArchetypeStorageNode1"
_WAITS_FOR_CONNECTION, _RESUMED_AFTER_LOADING = "1", "1"


@dataclass(frozen=True, eq=False)
class SlicerScene:
    """The contents of a scene file: where the service is, which device sends which pose, and a volume beside it."""

    host: str
    port: int  # of OpenIGTLink
    device: str  # name of the transform
    pose: FloatArray  # [4, 4] probe→scene, mm: what is sent on connecting
    volume: str  # name of the volume's file, in the folder of the scene file

    @property
    def xml(self) -> str:
        root = ElementTree.Element("MRML", version="Slicer", userTags="")
        attributes = {
            "OpenIGTLinkIF.out.name": self.device,
            "OpenIGTLinkIF.out.type": "TRANSFORM",
            "OpenIGTLinkIF.pushOnConnect": "true",
        }
        _node(
            root,
            "LinearTransform",
            _TRANSFORM,
            self.device,
            attributes=";".join(f"{key}:{value}" for key, value in attributes.items()),
            matrixTransformToParent=" ".join(repr(float(number)) for number in self.pose.ravel()),
        )
        _node(
            root,
            "IGTLConnector",
            _CONNECTOR,
            "UltraG-Ray",
            references=f"outgoing:{_TRANSFORM};",
            connectorType="CLIENT",
            serverHostname=self.host,
            serverPort=str(self.port),
            persistent=_RESUMED_AFTER_LOADING,
            state=_WAITS_FOR_CONNECTION,
            restrictDeviceName="0",
            checkCRC="1",
        )
        _node(
            root,
            "VolumeDisplay",
            _DISPLAY,
            "VolumeDisplay",
            colorNodeID="vtkMRMLColorTableNodeGrey",
            window="1",
            level="0.5",
            autoWindowLevel="0",
        )
        _node(root, "VolumeArchetypeStorage", _STORAGE, "VolumeArchetypeStorage", fileName=self.volume)
        references = f"display:{_DISPLAY};storage:{_STORAGE};"
        _node(root, "Volume", _VOLUME, self.volume.partition(".")[0], references=references)
        ElementTree.indent(root, " ")
        return ElementTree.tostring(root, encoding="unicode") + "\n"

    def write(self, path: Path) -> None:
        write_whole(path, f'<?xml version="1.0" encoding="UTF-8"?>\n{self.xml}')


def _node(root: ElementTree.Element, tag: str, node_id: str, name: str, **values: str) -> None:
    ElementTree.SubElement(root, tag, {"id": node_id, "name": name, **values})

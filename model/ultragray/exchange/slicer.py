"""A scene file of 3D Slicer (.mrml) for a scene that is served: a connector, the pose that it sends, and a volume.

MRML is XML with one element for each node; nodes have ids and refer to each other by them. The names of elements and
attributes are those that 3D Slicer and its extension SlicerOpenIGTLink write. Free of torch.
"""

from __future__ import annotations

from xml.etree import ElementTree

from ultragray.geometry.probe import FloatArray

_CONNECTOR, _TRANSFORM = "vtkMRMLIGTLConnectorNode1", "vtkMRMLLinearTransformNode1"
_VOLUME, _DISPLAY = "vtkMRMLScalarVolumeNode1", "vtkMRMLScalarVolumeDisplayNode1"
_STORAGE = "vtkMRMLVolumeArchetypeStorageNode1"
_WAITS_FOR_CONNECTION, _RESUMED_AFTER_LOADING = "1", "1"


def slicer_scene(
    host: str,
    port: int,  # of OpenIGTLink
    device: str,  # name of the transform
    pose: FloatArray,  # [4, 4] probe→scene, mm: what is sent on connecting
    volume: str,  # name of the volume's file, in the folder of the scene file
) -> str:
    """The text of a scene file: where the service is, which device sends which pose, and a volume beside it."""
    root = ElementTree.Element("MRML", version="Slicer", userTags="")
    attributes = {
        "OpenIGTLinkIF.out.name": device,
        "OpenIGTLinkIF.out.type": "TRANSFORM",
        "OpenIGTLinkIF.pushOnConnect": "true",
    }
    _node(
        root,
        "LinearTransform",
        _TRANSFORM,
        device,
        attributes=";".join(f"{key}:{value}" for key, value in attributes.items()),
        matrixTransformToParent=" ".join(repr(float(number)) for number in pose.ravel()),
    )
    _node(
        root,
        "IGTLConnector",
        _CONNECTOR,
        "UltraG-Ray",
        references=f"outgoing:{_TRANSFORM};",
        connectorType="CLIENT",
        serverHostname=host,
        serverPort=str(port),
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
    _node(root, "VolumeArchetypeStorage", _STORAGE, "VolumeArchetypeStorage", fileName=volume)
    references = f"display:{_DISPLAY};storage:{_STORAGE};"
    _node(root, "Volume", _VOLUME, volume.partition(".")[0], references=references)
    ElementTree.indent(root, " ")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _node(root: ElementTree.Element, tag: str, node_id: str, name: str, **values: str) -> None:
    ElementTree.SubElement(root, tag, {"id": node_id, "name": name, **values})

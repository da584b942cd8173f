"""DatasetService."""

from __future__ import annotations

import grpc

from ultragray.datasets.source import UPLOAD_OPTIONS
from ultragray.errors import InvalidArgument
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import datasets_pb2
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE
from ultragray_service.core.uploads import DatasetUpload
from ultragray_service.service import Service


class DatasetService:
    """The methods of ultragray.v1.DatasetService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def UploadDataset(  # noqa: N802
        self, requests: object, context: grpc.aio.ServicerContext
    ) -> datasets_pb2.UploadDatasetResponse:
        self._service.life.require_serving()
        first = await context.read()
        if first is grpc.aio.EOF or first.WhichOneof("part") != "header":
            raise InvalidArgument("the first message must hold the header", field="header")
        header = first.header
        options = {name: value for name in UPLOAD_OPTIONS if (value := getattr(header.options, name))}
        async with self._service.uploads.receive(header.dataset, options, private=header.private) as upload:
            if header.archive:
                await upload.begin_archive()
            await _receive(context, upload, archive=header.archive)
            record, is_new = await upload.finish()
        told = to_message(self._service.datasets.with_owner(record), datasets_pb2.Dataset)
        return datasets_pb2.UploadDatasetResponse(dataset=told, created=is_new)

    async def ListDatasets(  # noqa: N802
        self, request: datasets_pb2.ListDatasetsRequest, context: grpc.aio.ServicerContext
    ) -> datasets_pb2.ListDatasetsResponse:
        page_size = request.page_size or DEFAULT_PAGE_SIZE
        page = await self._service.datasets.page(page_size, request.page_token)
        return to_message(page, datasets_pb2.ListDatasetsResponse)

    async def GetDataset(  # noqa: N802
        self, request: datasets_pb2.GetDatasetRequest, context: grpc.aio.ServicerContext
    ) -> datasets_pb2.Dataset:
        return to_message(await self._service.datasets.get(request.dataset), datasets_pb2.Dataset)

    async def GetContactSheet(  # noqa: N802
        self, request: datasets_pb2.GetContactSheetRequest, context: grpc.aio.ServicerContext
    ) -> datasets_pb2.GetContactSheetResponse:
        return datasets_pb2.GetContactSheetResponse(png=await self._service.datasets.contact_sheet(request.dataset))

    async def DeleteDataset(  # noqa: N802
        self, request: datasets_pb2.DeleteDatasetRequest, context: grpc.aio.ServicerContext
    ) -> datasets_pb2.DeleteDatasetResponse:
        await self._service.delete_dataset(request.dataset)
        return datasets_pb2.DeleteDatasetResponse(dataset=request.dataset)


async def _receive(context: grpc.aio.ServicerContext, upload: DatasetUpload, *, archive: bool) -> None:
    while (message := await upload.next(context.read())) is not grpc.aio.EOF:
        part = message.WhichOneof("part")
        if part == "chunk":
            await upload.write(message.chunk)
        elif part == "file" and not archive:
            await upload.begin_file(message.file)
        else:
            expected = "chunk" if archive else "file or chunk"
            raise InvalidArgument(f"a message after the header must hold {expected}, got {part or 'neither'}")

"""The HTTP session of the watches: it asks for the metadata of objects alone.

The metadata say whose an object is, which is all that the watches are for.  A list is decoded
object by object, and only the fields that the handlers read are kept of each.
"""

from __future__ import annotations

from typing import Any

import aiohttp

from fiber_api import names
from fiber_operator.api_errors import Body
from fiber_operator.cluster import LEASES, PODS, POOLS, Configuration, open_session
from fiber_operator.listing import METADATA_LIST, PIECE, Listing
from fiber_operator.planning.documents import mapping

WATCHED = (POOLS, PODS, LEASES)

_KEPT = ("namespace", "name", "uid", "generation", "resourceVersion")


async def open_watch_session(
    configuration: Configuration, trace: aiohttp.TraceConfig
) -> aiohttp.ClientSession:
    """Open the session, logged in; ``trace`` sees each request."""
    return await open_session(
        configuration,
        trace_configs=[trace],
        middlewares=[_ask_for_metadata],
        response_class=_Answer,
    )


async def _ask_for_metadata(
    request: aiohttp.ClientRequest, handler: aiohttp.ClientHandlerType
) -> aiohttp.ClientResponse:
    if request.url.name in {resource.plural for resource in WATCHED}:
        watch = request.url.query.get("watch") == "true"
        kind = "PartialObjectMetadata" if watch else METADATA_LIST
        request.headers["Accept"] = f"application/json;as={kind};g=meta.k8s.io;v=v1"
    return await handler(request)


class _Answer(aiohttp.ClientResponse):
    """An answer whose JSON is read object by object if it is a list of metadata."""

    async def json(self, **options: Any) -> Any:
        accept = self.request_info.headers.get("Accept", "")
        if self.status >= 400 or METADATA_LIST not in accept:
            return await super().json(**options)
        listing = Listing(self.content.iter_chunked(PIECE), f"list {self.url.name}")
        items = [_brief(item) async for item in listing]
        return {**listing.rest, "items": items}


def _brief(item: Body) -> Body:
    metadata = mapping(item, "metadata")
    label = {names.LABEL_POOL: mapping(metadata, "labels").get(names.LABEL_POOL)}
    kept = {name: metadata[name] for name in _KEPT if name in metadata}
    said = mapping(metadata, "annotations").get(names.ANNOTATION_CONNECTED)
    if said is not None:
        kept["annotations"] = {names.ANNOTATION_CONNECTED: said}
    return {"metadata": {**kept, "labels": label}}

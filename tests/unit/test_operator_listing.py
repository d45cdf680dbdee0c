"""A list is read object by object, and never taken for shorter than it is."""

from __future__ import annotations

import asyncio
import json
import tracemalloc
from collections.abc import AsyncIterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber_api.rest import Transient
from fiber_operator.responses import PIECE, ListReader

Json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
OBJECTS = st.lists(st.dictionaries(st.text(), Json, max_size=4), max_size=5)


async def pieces(data: bytes, size: int) -> AsyncIterator[bytes]:
    for start in range(0, len(data), size):
        yield data[start : start + size]


def read(data: bytes, size: int = 7) -> tuple[list[Any], str]:
    async def main() -> tuple[list[Any], str]:
        listing = ListReader(pieces(data, size), "list pods")
        return [item async for item in listing], listing.more()

    return asyncio.run(main())


def a_list(items: Any, **metadata: Any) -> dict[str, Any]:
    return {"kind": "PodList", "apiVersion": "v1", "metadata": metadata, "items": items}


@pytest.mark.slow
@given(OBJECTS, st.booleans(), st.sampled_from([None, 1]), st.integers(1, 99), st.randoms())
def test_a_list_is_read_whole(
    items: Any, plain: bool, indent: int | None, size: int, random: Any
) -> None:
    members = list(a_list(items, **{"continue": "next"}).items())
    random.shuffle(members)
    data = json.dumps(dict(members), ensure_ascii=plain, indent=indent)
    assert read(data.encode(), size) == (items, "next")


def test_the_last_page_of_a_list_has_no_continue_token() -> None:
    assert read(json.dumps(a_list([])).encode()) == ([], "")


@pytest.mark.slow
@given(OBJECTS, st.integers(min_value=0))
def test_a_partial_list_raises_unavailable(items: Any, length: int) -> None:
    data = json.dumps(a_list(items)).encode()
    with pytest.raises(Transient):
        read(data[: length % len(data)])


@pytest.mark.parametrize(
    "document",
    [
        {},
        [],
        "PodList",
        {"kind": "Pod", "metadata": {}, "items": []},
        {"kind": "PodList", "items": []},
        {"kind": "PodList", "metadata": {}},
        a_list(None),
        a_list({}),
        a_list([1]),
        a_list([{}, None]),
    ],
    ids=str,
)
def test_an_answer_that_is_no_list_of_objects_is_refused(document: Any) -> None:
    with pytest.raises(Transient):
        read(json.dumps(document).encode())


@pytest.mark.parametrize(
    "data",
    [b"", b"<html>", b"\xff", b"{}{}", b'{"items":[{}{}]}', b"{1:2}x", b"[" * 100_000],
)
def test_an_answer_that_is_no_document_is_refused(data: bytes) -> None:
    with pytest.raises(Transient, match="list pods"):
        read(data)


def test_an_empty_list_of_metadata_has_null_for_its_items() -> None:
    document = b'{"kind": "PartialObjectMetadataList", "metadata": {}, "items": null}'
    assert read(document) == ([], "")


def test_a_list_is_decoded_with_one_object_in_memory() -> None:
    item = json.dumps({"large": "\N{GRINNING FACE}" + "x" * 500_000}, ensure_ascii=False).encode()
    count = 40

    async def answer() -> AsyncIterator[bytes]:
        yield b'{"kind": "PodList", "metadata": {}, "items": ['
        for number in range(count):
            for start in range(0, len(item), PIECE):
                yield item[start : start + PIECE]
            yield b"," if number < count - 1 else b"]}"

    async def main() -> int:
        seen = 0
        async for found in ListReader(answer(), "list pods"):
            seen += len(found["large"]) > 500_000
        return seen

    tracemalloc.start()
    try:
        assert asyncio.run(main()) == count
        assert tracemalloc.get_traced_memory()[1] < 20 * len(item)
    finally:
        tracemalloc.stop()


def test_an_answer_that_goes_on_after_its_end_is_refused() -> None:
    with pytest.raises(Transient):
        read(json.dumps(a_list([{}])).encode() + b" {}")

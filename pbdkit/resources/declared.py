"""Bounds on what an HDF5 file declares and refers to, checked before any value of it is read.

A file of some kilobytes can declare arrays of terabytes, refer to the bytes of other files, and
name filters that HDF5 loads as programs. A seal does not tell: anybody can make one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from pbdkit.errors import StorageError
from pbdkit.resources.memory import machine_memory

if TYPE_CHECKING:
    import h5py

DENSEST = 1100
"""Largest ratio of declared to stored bytes of a compressed variable (deflate: 1032)."""
SPARSEST = 16
"""Largest ratio of the bytes that a variable declares, written or not, to those of the file."""
EMPTY = 2**20
"""Bytes that a variable may declare whatever is stored."""
LARGEST_CHUNK = 2**26
"""Bytes of a chunk that are taken whatever is stored."""
MOST_OBJECTS = 10_000
"""Maximum number of objects and of links in a file, and of attributes of each."""
LARGEST_TEXTS = 2**28
"""Bytes that a block of texts can take when it is looked at."""
FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32"}
"""The filters of HDF5 that are applied; others would be loaded as programs."""
NO_VARIABLE = b"This is a netCDF dimension but not a netCDF variable"
"""Begins the attribute NAME of datasets that are dimensions only, whose values nobody reads."""


def check_declared(content: h5py.File, size: int) -> None:
    """Check what an open file of `size` bytes declares, and that all of it is in the file.

    Raises StorageError, without the name of the file, for links that lead elsewhere, external
    storage, virtual datasets, groups in a circle, filters other than `FILTERS`, and for variables,
    attributes and texts larger than a file of that size can hold.
    """
    from h5py import h5a, h5d, h5g, h5l, h5o

    links: list[tuple[bytes, bool]] = []
    objects = [b"."]

    # h5py ends a visit where something is returned; it does not bear exceptions there.
    def note_link(name: bytes, info: Any) -> bool | None:
        links.append((name, info.type == h5l.TYPE_HARD))
        return len(links) > MOST_OBJECTS or None

    def note_object(name: bytes, info: Any) -> bool | None:
        objects.append(name)
        return len(objects) > MOST_OBJECTS or None

    if content.id.links.visit(note_link, info=True) or h5o.visit(
        content.id, note_object, info=True
    ):
        raise StorageError(f"it holds more than {MOST_OBJECTS} objects")
    for name, is_hard in links:
        if not is_hard:
            raise StorageError(f"its link '{_text(name)}' leads elsewhere; {_REMEDY}")
    for name in objects:
        found = h5o.open(content.id, name)
        if (count := h5a.get_num_attrs(found)) > MOST_OBJECTS:
            raise StorageError(f"'{_text(name)}' has {count} attributes")
        for n in range(count):
            _check_attribute(h5a.open(found, index=n), size)
        if isinstance(found, h5g.GroupID) and h5o.get_info(found).rc > 1:
            raise StorageError(f"its group '{_text(name)}' lies in several groups; {_REMEDY}")
        if isinstance(found, h5d.DatasetID):
            _check_dataset(found, _text(name), size)


_REMEDY = "copy the data into one netCDF-4 file, for instance by xarray: open_dataset, to_netcdf"


def _text(name: bytes) -> str:
    return name.decode(errors="replace")[:80]


def _check_attribute(attribute: Any, size: int) -> None:
    """Elements of variable length may all be the same large one."""
    if _is_ragged(attribute.get_type()):
        count = math.prod(attribute.shape or ())
        if count > max(64, LARGEST_TEXTS // size):
            raise StorageError(f"its attribute '{_text(attribute.name)}' has {count} parts")


def _is_ragged(kind: Any) -> bool:
    from h5py import h5t

    variable = isinstance(kind, h5t.TypeStringID) and kind.is_variable_str()
    return bool(variable or kind.detect_class(h5t.VLEN))


def _check_dataset(dataset: Any, name: str, size: int) -> None:
    from h5py import h5d, h5ds

    created, kind = dataset.get_create_plist(), dataset.get_type()
    if created.get_layout() == h5d.VIRTUAL or created.get_external_count():
        raise StorageError(f"the values of its variable '{name}' lie in other files; {_REMEDY}")
    for n in range(created.get_nfilters()):
        number, *_, word = created.get_filter(n)
        if number not in FILTERS:
            raise StorageError(
                f"its variable '{name}' is stored by the filter {number} ({_text(word)}); "
                f"pbdkit applies {', '.join(FILTERS.values())}: write it anew with these"
            )
    if _is_dimension_only(dataset):
        return
    shape, stored = dataset.shape or (), dataset.get_storage_size()
    declared = math.prod(shape) * kind.get_size()
    if declared > max(DENSEST * stored, SPARSEST * size) + EMPTY:
        raise StorageError(f"it cannot hold the {declared:.3g} bytes that '{name}' declares")
    if created.get_layout() == h5d.CHUNKED:
        chunk = math.prod(created.get_chunk()) * kind.get_size()
        if chunk > DENSEST * stored + LARGEST_CHUNK:
            raise StorageError(f"it cannot hold the chunks of {chunk:.3g} bytes of '{name}'")
    if h5ds.is_scale(dataset) and declared > machine_memory() // 4:
        raise StorageError(f"'{name}' declares {declared:.3g} bytes, more than fit into memory")
    if _is_ragged(kind):
        _check_texts(dataset, name, size)


def _is_dimension_only(dataset: Any) -> bool:
    from h5py import h5a

    if not h5a.exists(dataset, b"NAME"):
        return False
    import h5py

    said = h5py.Dataset(dataset).attrs["NAME"]
    return isinstance(said, bytes) and said.startswith(NO_VARIABLE)


def _check_texts(dataset: Any, name: str, size: int) -> None:
    """Read texts of variable length, some at a time: together they are in the file, once each."""
    import h5py

    texts, total = h5py.Dataset(dataset), 0
    if h5py.check_string_dtype(texts.dtype) is None:
        raise StorageError(f"its variable '{name}' holds values of variable length")
    for block in _blocks(texts, size):
        total += sum(map(len, block.ravel()))
        if total > size:
            raise StorageError(f"it cannot hold the texts that '{name}' declares")


def _blocks(texts: Any, size: int) -> Iterator[Any]:
    if not texts.shape or not texts.size:
        return
    each = size * math.prod(texts.shape[1:])
    step = max(1, LARGEST_TEXTS // each)
    for start in range(0, len(texts), step):
        yield texts[start : start + step]

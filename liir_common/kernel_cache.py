"""Keep numba's cache on disk from answering with code of another version of this package.

A compiled function holds constants and inlined functions of other modules, but numba asks only whether
the function's own file has changed. After `install` it asks for all files that episodes are compiled from,
and for kernels of the services for their own file as well.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import (
    CacheImpl,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)

from liir_common.build import source_digest

_COMMON = Path(__file__).parent
_SERVICES = _COMMON.parent / "services"


class _OfThisProject:
    _stamp: str

    def get_source_stamp(self) -> str:
        return self._stamp

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        file = Path(py_file)
        if not (file.is_relative_to(_COMMON) or file.is_relative_to(_SERVICES)):
            return None
        locator = super().from_function(py_func, py_file)  # type: ignore[misc]
        if locator:
            own = "" if file.is_relative_to(_COMMON) else hashlib.sha256(file.read_bytes()).hexdigest()
            locator._stamp = source_digest() + own
        return locator


class _UserProvided(_OfThisProject, UserProvidedCacheLocator):
    pass


class _InTree(_OfThisProject, InTreeCacheLocator):
    pass


class _UserWide(_OfThisProject, UserWideCacheLocator):
    pass


@cache
def install() -> None:
    """Stamp the cached code of this project's functions, compiled from here on, with their sources."""
    # numba takes the first locator that wants a function.
    CacheImpl._locator_classes[:0] = [_UserProvided, _InTree, _UserWide]

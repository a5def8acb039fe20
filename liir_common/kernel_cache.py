"""Keep numba's cache on disk from answering with code of another version of this package.

A compiled function holds constants and inlined functions of other modules, but numba asks only whether
the function's own file has changed. After `install` it asks for all files that kernels are compiled from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numba.core.caching import (
    CacheImpl,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)

from liir_common.build import source_digest

_PACKAGE = Path(__file__).parent


class _OfThisPackage:
    def get_source_stamp(self) -> str:
        return source_digest()

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if not Path(py_file).is_relative_to(_PACKAGE):
            return None
        return super().from_function(py_func, py_file)  # type: ignore[misc]


class _UserProvided(_OfThisPackage, UserProvidedCacheLocator):
    pass


class _InTree(_OfThisPackage, InTreeCacheLocator):
    pass


class _UserWide(_OfThisPackage, UserWideCacheLocator):
    pass


def install() -> None:
    """Stamp the cached code of this package's functions, compiled from here on, with `source_digest`."""
    # numba takes the first locator that wants a function.
    CacheImpl._locator_classes[:0] = [_UserProvided, _InTree, _UserWide]

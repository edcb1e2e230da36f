"""Large modules, imported when they are first used: most of what a start would take, and no run needs all of them."""

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any


class _Late(ModuleType):
    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)


if TYPE_CHECKING:
    import tifffile
    from scipy import fft, linalg, ndimage, sparse, spatial, special
    from scipy.sparse import csgraph
    from scipy.sparse import linalg as sparse_linalg
else:
    fft, linalg, ndimage, sparse, spatial, special, csgraph, sparse_linalg, tifffile = map(
        _Late,
        (
            *("scipy.fft", "scipy.linalg", "scipy.ndimage", "scipy.sparse", "scipy.spatial", "scipy.special"),
            *("scipy.sparse.csgraph", "scipy.sparse.linalg", "tifffile"),
        ),
    )

__all__ = ["csgraph", "fft", "linalg", "ndimage", "sparse", "sparse_linalg", "spatial", "special", "tifffile"]

"""Large modules, imported when they are first used: most of what a start would take, and no run needs all of them."""

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any


class _Late(ModuleType):
    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)


if TYPE_CHECKING:
    import imagecodecs
    import tifffile
    from scipy import fft, optimize, sparse, spatial
    from scipy.sparse import csgraph
    from scipy.sparse import linalg as sparse_linalg
else:
    fft, optimize, sparse, spatial, csgraph, sparse_linalg, tifffile, imagecodecs = map(
        _Late,
        (
            *("scipy.fft", "scipy.optimize", "scipy.sparse", "scipy.spatial"),
            *("scipy.sparse.csgraph", "scipy.sparse.linalg", "tifffile", "imagecodecs"),
        ),
    )

__all__ = ["csgraph", "fft", "imagecodecs", "optimize", "sparse", "sparse_linalg", "spatial", "tifffile"]

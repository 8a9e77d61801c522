"""Libraries that only a part of distrace needs. Extras of the package install them."""

import platform
import sys
from importlib import import_module

EXTRAS = {
    "igl": "train",
    "embreex": "train",
    "pycolmap": "photos",
    "av": "movie",
    "matplotlib": "report",
    "plotly": "report",
    "OpenEXR": "scans",
    "viser": "view",
    "ray": "cluster",
    "huggingface_hub": "hub",
    "tensorboard": "tensorboard",
}
ONLY_X86_64 = ("embreex", "pycolmap")  # have no wheels for Linux on other processors


class MissingLibrary(ModuleNotFoundError):
    """A library is not installed; the message is one sentence that says how to install it."""


def require(purpose: str, *libraries: str) -> None:
    """Raises `MissingLibrary` where a library that the purpose needs is not installed.

    >>> require("a movie", "av")
    """
    for library in libraries:
        try:
            import_module(library)
        except ModuleNotFoundError as error:
            if error.name != library:
                raise
            if library in ONLY_X86_64 and sys.platform == "linux" and platform.machine() != "x86_64":
                advice = f"it has no wheel for Linux on {platform.machine()}: build it from its sources"
            else:
                advice = f"install it by pip install 'distrace[{EXTRAS[library]}]'"
            raise MissingLibrary(f"{purpose} needs {library}; {advice}", name=library) from error

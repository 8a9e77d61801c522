"""Libraries that only a part of distrace needs. Extras of the package install them."""

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
}


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
            extra = f"pip install 'distrace[{EXTRAS[library]}]'"
            raise MissingLibrary(f"{purpose} needs {library}; install it by {extra}", name=library) from error

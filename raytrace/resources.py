"""Files that travel with the package: glass catalogs and lenses."""

from pathlib import Path


def shipped(folder: str) -> Path:
    """The folder `glass_catalogs` or `lenses`: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    installed = package / folder
    return installed if installed.is_dir() else package.parent / folder

"""Pictures of a folder, enlarged: textures at another scale, as for docs/papers.md.

    python docs/experiments/enlarge.py DIR --by 2 -o FOLDER

Sides become `--by` times as long (Pillow, Lanczos); files are PNG in the same subfolders.
"""

import argparse
from pathlib import Path

from PIL import Image
from tqdm import tqdm

from raytrace.imaging.pictures import files


def options(parser: argparse.ArgumentParser) -> None:
    """The options of this script."""
    parser.add_argument("folder", metavar="DIR", type=Path, help="pictures, in any subfolders")
    parser.add_argument("--by", type=float, default=2.0, help="factor of the sides (default 2)")
    parser.add_argument("-o", "--output", metavar="FOLDER", type=Path, required=True, help="of the enlarged pictures")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args()
    for path in tqdm(files(arguments.folder), unit="pictures"):
        target = (arguments.output / path.relative_to(arguments.folder)).with_suffix(".png")
        target.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(path) as picture:
            size = tuple(round(arguments.by * side) for side in picture.size)
            picture.convert("L").resize(size, Image.Resampling.LANCZOS).save(target, compress_level=1)


if __name__ == "__main__":
    main()

"""The measures of the house, counted: lines of the package and of each room, and how long its functions are.

    python tests/house.py

Lines are all those of the .py files. The body of a function is what stands behind its docstring, from the first line of
its first statement to the last of its last; functions inside functions count by themselves, too.
"""

import ast
import statistics
from collections import Counter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "raytrace"
#: Rooms that nothing imports: experiments and measurements, no part of the library.
APART = ("studies", "bench")


def lines_of_rooms() -> Counter[str]:
    """Lines by room, a folder or a file directly under the package."""
    found = Counter()
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        found[room] += len(path.read_text(encoding="utf-8").splitlines())
    return found


def lines_of_library() -> int:
    return sum(lines for room, lines in lines_of_rooms().items() if room not in APART)


def body_lengths() -> dict[str, int]:
    """Lines of the body of every function, by "room/file.py:line name"."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                place = f"{path.relative_to(PACKAGE)}:{node.lineno} {node.name}"
                found[place] = _body_length(node)
    return found


def _body_length(function: ast.FunctionDef) -> int:
    body = function.body[ast.get_docstring(function) is not None :]
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def median_body() -> float:
    return statistics.median(body_lengths().values())


def main() -> None:
    rooms, lengths = lines_of_rooms(), body_lengths()
    for room, lines in sorted(rooms.items(), key=lambda one: -one[1]):
        print(f"{lines:7,} {room}")
    print(f"{sum(rooms.values()):7,} lines, {lines_of_library():,} of them the library (all but {' and '.join(APART)})")
    median, long = statistics.median(lengths.values()), sum(length > 25 for length in lengths.values())
    print(f"{len(lengths):7,} functions, median body {median:g} lines, {long} of more than 25")
    for place, length in sorted(lengths.items(), key=lambda one: -one[1])[:5]:
        print(f"{length:7,} {place}")


if __name__ == "__main__":
    main()

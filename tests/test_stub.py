"""The stubs of the public API, `raytrace/__init__.pyi` and those of its packages, name the module of every public name.

`python tests/test_stub.py` writes it anew from the table in `raytrace/__init__.py`.
"""

from pathlib import Path

import raytrace as rt

PACKAGE = Path(rt.__file__).parent
STUB = PACKAGE / "__init__.pyi"


def stub() -> str:
    """Of the package: the names that are typed, errors, and the packages whose names are typed with theirs."""
    lines = [
        '"""Signatures of the public API for editors; written by `python tests/test_stub.py`."""',
        "",
        "from collections.abc import Callable",
        "from typing import Any",
        "",
        *(f"from raytrace import {name} as {name}" for name in sorted(rt.NAMESPACES)),
        *imported({name: rt.PUBLIC[name] for name in rt.TOP} | rt.ERRORS),
        "",
        "__version__: str",
        *(f"{name}: dict[str, str]" for name in ("PUBLIC", "ERRORS")),
        *(f"{name}: tuple[str, ...]" for name in ("TOP", "NAMESPACES")),
        "",
        "def public_name(name: str) -> Any: ...",
        "def package_of(name: str) -> str: ...",
        "def namespace(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]: ...",
    ]
    return "\n".join([*lines, ""])


def imported(names: dict[str, str]) -> list[str]:
    """The imports of names by their places."""
    lines = []
    for name, place in names.items():
        module, _, defined = place.partition(":")
        lines.append(f"from raytrace.{module} import {defined or name} as {name}")
    return sorted(lines, key=order)


def order(line: str) -> tuple:
    """As ruff sorts imports: by module, then constants, classes and functions by their names."""
    _, module, _, name, *_ = line.split()
    return module, 0 if name.isupper() else 1 if name[0].isupper() else 2, name


def stub_of(package: str) -> str:
    """Of a package: what its `__init__.py` imports, and the public names that are defined in it."""
    source = (PACKAGE / package / "__init__.py").read_text(encoding="utf-8")
    own = [line for line in source.splitlines() if line.startswith("from raytrace.")]
    names = {name: place for name, place in rt.PUBLIC.items() if rt.package_of(name) == package}
    lines = [line for line in imported(names) if f"from raytrace.{package} import" not in line]
    return "\n".join([*sorted({*own, *lines}, key=order), ""])


def stubs() -> dict[Path, str]:
    """Of `io`, whose functions stand in its `__init__.py`, there is none."""
    packages = [name for name in rt.NAMESPACES if name != "io"]
    return {STUB: stub()} | {PACKAGE / name / "__init__.pyi": stub_of(name) for name in packages}


def test_the_stubs_are_those_of_the_table():
    for path, text in stubs().items():
        assert path.read_text(encoding="utf-8") == text, f"{path}: run `python tests/test_stub.py`"


if __name__ == "__main__":
    for path, text in stubs().items():
        path.write_text(text, encoding="utf-8")

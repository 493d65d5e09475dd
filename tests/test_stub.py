"""The stub of the public API, `raytrace/__init__.pyi`, names the module of every public name: editors read it.

`python tests/test_stub.py` writes it anew from the table in `raytrace/__init__.py`.
"""

from pathlib import Path

import raytrace as rt

STUB = Path(rt.__file__).with_suffix(".pyi")


def stub() -> str:
    lines = [
        "# ruff: noqa: I001",
        '"""Signatures of the public API for editors; written by `python tests/test_stub.py`."""',
        "",
    ]
    for name, place in sorted(rt.PUBLIC.items(), key=lambda entry: (entry[1].partition(":")[0], entry[0])):
        module, _, defined = place.partition(":")
        lines.append(f"from raytrace.{module} import {defined or name} as {name}")
    return "\n".join([*lines, "", "PUBLIC: dict[str, str]", ""])


def test_the_stub_is_that_of_the_table():
    assert STUB.read_text(encoding="utf-8") == stub(), "run `python tests/test_stub.py`"


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")

"""Values and files that a store does not hold."""

from pathlib import Path

#: What JSON can hold that no store expects, as it is written.
STRANGE = {
    "list": "[1]",
    "null": "null",
    "text": '"low"',
    "truth": "true",
    "nothing": "",
    "names": "{}",
    "400 digits": "9" * 400,
    "5000 digits": "9" * 5000,
    "not a number": "NaN",
    "infinity": "-Infinity",
    "depth": "[" * 200_000,
    "deep names": '{"a":' * 200_000,
    "torn": '{"a": 1',
    "no text": "\udcff\udcfe",
    "lone half": '"\\ud800"',
}


def put(path: Path, content: str) -> None:
    path.write_bytes(content.encode("utf-8", "surrogateescape"))

"""Settings of the book: `python -m sphinx docs docs/_build/html` builds it; `-b linkcheck` checks external links."""

import re
import socket
import sys
import tomllib
from pathlib import Path

import raytrace

root = Path(__file__).parent
sys.path.insert(0, str(root))

project = "raytrace"
release = tomllib.loads((root.parent / "pyproject.toml").read_text("utf-8"))["project"]["version"]

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
exclude_patterns = ["_build", "experiments"]
nitpicky = False

html_theme = "furo"
html_title = "raytrace"
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_show_copyright = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}

myst_enable_extensions = ["deflist", "dollarmath", "attrs_block"]
myst_heading_anchors = 4

# Tutorials are executed by the build. Outputs are kept inside _build until the text of the tutorial changes.
nb_execution_mode = "cache"
nb_execution_cache_path = str(root / "_build" / ".notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 60  # s per cell; tests/test_book.py limits the tutorial
nb_execution_in_temp = True  # files that a tutorial writes stay out of docs/
nb_merge_streams = True


def is_offline() -> bool:
    """Whether no name of a host is resolved."""
    try:
        socket.getaddrinfo("github.com", 443)
    except OSError:
        return True
    return False


# Links between pages are checked by every build, external links by linkcheck where there is a network.
linkcheck_ignore = ["https?://"] if is_offline() else []
linkcheck_anchors = True
linkcheck_timeout = 10
linkcheck_retries = 1
linkcheck_report_timeouts_as_broken = False


#: The start of a statement about an argument in a docstring: "fields: …".
LABEL = re.compile(r"(Raises|Returns|Warns|Source)\b|[a-z][\w, ()]{0,60}: ")


def paragraphs(app, what, name, obj, options, lines: list[str]) -> None:
    """The text of a docstring, which is plain, as paragraphs of reStructuredText; code in backticks stays code."""
    parts = [""]
    for line in (line.strip() for line in lines):
        if not line or LABEL.match(line):
            parts.append("")
        parts[-1] = f"{parts[-1]} {line}".strip()
    texts = [re.split(r"`([^`]+)`", part.replace("``", "`")) for part in parts if part]
    lines[:] = []
    for text in texts:
        plain = [re.sub(r"([\\*|_<>])", r"\\\1", piece) for piece in text[::2]]
        code = [f"\\ ``{piece.strip()}``\\ " for piece in text[1::2]] + [""]
        lines += ["".join(piece for pair in zip(plain, code, strict=True) for piece in pair), ""]


def setup(app):
    """Write the pages that follow from tables of the package before the build reads them, and compile the trace once,
    outside the time limits of the cells."""
    from generate import write

    raytrace.tracing.prepare()
    app.connect("builder-inited", write)
    app.connect("autodoc-process-docstring", paragraphs)

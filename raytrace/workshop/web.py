"""A document as one HTML file without references to others: tables as tables, figures embedded as SVG or PNG."""

import base64
import html
import io
import re

from raytrace.plotting import style
from raytrace.workshop.document import Block, Document, Grid, Heading, Picture, Section

_LARGEST = 400_000  # bytes of an SVG; a figure of more marks is embedded as PNG

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, "Helvetica Neue", Arial, sans-serif; color: #262626; background: #fff;
  max-width: 60rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: .5rem 0; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; border-bottom: 1px solid #262626; margin: 2.2rem 0 .8rem; padding-bottom: .2rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
p { margin: .35rem 0; overflow-wrap: anywhere; }
p.about, p.gap, footer { color: #5a5a5a; }
p.gap { font-style: italic; }
nav ol { columns: 16rem; margin: .3rem 0 0; }
nav a { color: #0b5a8f; text-decoration: none; }
nav a:hover { text-decoration: underline; }
.table { overflow-x: auto; margin: .6rem 0 1rem; }
table { border-collapse: collapse; font-size: .82rem; font-variant-numeric: tabular-nums;
  border-top: 1.5px solid #262626; border-bottom: 1.5px solid #262626; }
th, td { padding: .15rem .6rem; text-align: right; white-space: nowrap; vertical-align: top; }
th.left, td.left { text-align: left; }
td.long { white-space: normal; min-width: 14rem; }
thead { border-bottom: 1px solid #262626; }
th small { color: #5a5a5a; font-weight: normal; font-size: .75rem; }
tbody tr:nth-child(even) { background: #f6f7f8; }
figure { display: inline-block; max-width: 100%; margin: .6rem 1rem .6rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption { text-align: center; }
footer { margin-top: 3rem; font-size: .8rem; border-top: 1px solid #d0d0d0; padding-top: .5rem; }
@media print { body { max-width: none; } h2, h3 { break-after: avoid; } figure, tr { break-inside: avoid; } }
"""


def page(document: Document) -> str:
    """The document as the text of an HTML file."""
    title, date = html.escape(document.title), html.escape(document.date)
    contents = "\n".join(
        f'<li><a href="#{section.name}">{html.escape(section.title)}</a></li>' for section in document.sections
    )
    about = "\n".join(f'<p class="about">{html.escape(line)}</p>' for line in document.lines)
    body = "\n".join(map(_section, document.sections))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{_STYLE}</style>
</head>
<body>
<header>
<h1>{title}</h1>
{about}
</header>
<nav>
<h2>Contents</h2>
<ol>
{contents}
</ol>
</nav>
<main>
{body}
</main>
<footer>raytrace{"  ·  " * bool(date)}{date}</footer>
</body>
</html>
"""


def _section(section: Section) -> str:
    parts = [f'<section id="{section.name}">', f"<h2>{html.escape(section.title)}</h2>"]
    if section.gap:
        parts.append(f'<p class="gap">{html.escape(section.gap)}</p>')
    return "\n".join([*parts, *map(_block, section.blocks), "</section>"])


def _block(block: Block) -> str:
    if isinstance(block, Heading):
        return f"<h3>{html.escape(block.text)}</h3>"
    if isinstance(block, Grid):
        return _table(block)
    if isinstance(block, Picture):
        caption = f"<figcaption>{html.escape(block.caption)}</figcaption>" if block.caption else ""
        picture = f'<img src="{_source(block.figure)}"{_size(block.figure)} alt="{html.escape(block.text)}">'
        return f"<figure>{picture}{caption}</figure>"
    return f"<p>{html.escape(block)}</p>"


def _table(grid: Grid) -> str:
    def cell(tag: str, text: str, side: str) -> str:
        kinds = ["left"] * (side == "left") + ["long"] * (tag == "td" and len(text) > 40)
        look = f' class="{" ".join(kinds)}"' if kinds else ""
        return f"<{tag}{look}>{text}</{tag}>"

    heads = "".join(
        cell("th", html.escape(first) + f"<br><small>{html.escape(second)}</small>" * bool(second), side)
        for (first, second), side in zip(grid.heads, grid.sides, strict=True)
    )
    rows = "\n".join(
        "<tr>"
        + "".join(cell("td", html.escape(text), side) for text, side in zip(row, grid.sides, strict=True))
        + "</tr>"
        for row in grid.rows
    )
    return f'<div class="table"><table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table></div>'


def _size(figure: style.Figure) -> str:
    width, height = (round(96 * float(size)) for size in figure.get_size_inches())
    return f' width="{width}" height="{height}"'


@style.styled
def _source(figure: style.Figure) -> str:
    """A figure as the address of its content."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    content = re.sub(rb"\s*<metadata>.*?</metadata>", b"", file.getvalue(), flags=re.DOTALL)
    if len(content) <= _LARGEST:
        return f"data:image/svg+xml;base64,{base64.b64encode(content).decode()}"
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=160)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"

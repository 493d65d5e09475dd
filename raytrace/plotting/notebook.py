"""A lens in a notebook: its drawing, first-order data and prescription."""

import html
import io

from raytrace.plotting.layout import layout
from raytrace.plotting.style import first_order_text
from raytrace.system.lens import Lens, field_points
from raytrace.tracing.lens_report import Info, Layout, text
from raytrace.tracing.paraxial import first_order


def page(lens: Lens) -> str:
    """HTML with the cross section as an inline SVG and the prescription as a table; plain text where it has none."""
    try:
        title, drawing = first_order_text(lens, first_order(lens)), io.StringIO()
        layout(Layout(lens, field_points(None, like=lens))).savefig(drawing, format="svg")
        table = Info(lens).to_frame().to_html(index=False, float_format="{:.7g}".format, na_rep="")
    except (ValueError, RuntimeError):
        return f"<pre>{html.escape(text(lens))}</pre>"
    svg = drawing.getvalue()
    return f"<b>{html.escape(lens.name or 'Lens')}</b><br>{html.escape(title)}{svg[svg.index('<svg'):]}{table}"

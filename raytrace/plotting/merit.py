"""Figure of a merit function: what its square is made of."""


from raytrace.optimization.evaluate import MeritResult
from raytrace.optimization.merit import arguments
from raytrace.plotting.style import FAINT, field_colours, new_figure, number_text, styled
from raytrace.system.optimization_data import Row

_MOST = 16  # bars


@styled
def contributions(found: MeritResult):
    """A bar for every operand and field, the largest part first; rays of a field share one, other rows have their own.

    Bars are coloured by operand; what the smallest have together is the last bar.
    """
    shares = _shares(found)
    names = sorted(shares, key=lambda name: -shares[name][1])
    shown, rest = names[:_MOST], names[_MOST:]
    kinds = [*dict.fromkeys(shares[name][0] for name in shown)]
    colours = dict(zip(kinds, field_colours(len(kinds)), strict=True))
    figure = new_figure(6.4, 0.24 * (len(shown) + bool(rest)) + 1.2)
    panel = figure.subplots()
    bars = [(name, 100 * shares[name][1], colours[shares[name][0]]) for name in shown]
    if rest:
        bars.append((f"{len(rest)} more", 100 * sum(shares[name][1] for name in rest), FAINT))
    labels, parts, fills = zip(*bars, strict=True)
    panel.barh(range(len(bars)), parts, color=fills, height=0.72)
    panel.set_yticks(range(len(bars)), labels)
    panel.invert_yaxis()
    panel.grid(axis="x", color=FAINT, linewidth=0.6, alpha=0.6)
    panel.set_axisbelow(True)
    panel.set_xlabel("part of the square of the merit (%)")
    title = f"merit {number_text(float(found.merit))}"
    panel.set_title(f"{found.lens.name}: {title}" if found.lens.name else title)
    return figure


def _shares(found: MeritResult) -> dict[str, tuple[str, float]]:
    """Operand and part of every bar by its name."""
    several = len({*found.configurations.tolist()}) > 1
    shares: dict[str, tuple[str, float]] = {}
    numbers = (found.row, found.configurations, found.weights, found.contributions)
    for row, number, at, weight, part in zip(found.valued(), *(n.tolist() for n in numbers), strict=True):
        if weight:
            name = f"{_name(number, row)}, conf. {at}" if several else _name(number, row)
            shares[name] = (row.name, shares.get(name, ("", 0.0))[1] + part)
    return shares or {"no row has a weight": ("", 0.0)}


def _name(number: int, row: Row) -> str:
    if any(row.numbers[2:]):
        return f"{row.name} field {row.numbers[0]:.3g}, {row.numbers[1]:.3g}"
    return f"{number} {row.name} {arguments(row)}".rstrip()

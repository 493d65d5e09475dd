"""Report: a study as a page of Markdown."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence

from raytrace.studies.codesign.claims import claims, penalty
from raytrace.studies.codesign.experiment import Outcome, Settings
from raytrace.studies.codesign.optima import Optimum
from raytrace.studies.codesign.step_time import StepTime
from raytrace.studies.codesign.study import NAMES, PAPER, Summary, summaries

#: What stands below this line is written by hand: a report that is made again keeps it.
KEPT = "<!-- kept when this page is made again -->"

#: What leads to the page of the sweep.
#: Said of the columns that hold published numbers.
_OF_PAPER = "; “paper”: the published study of this lens and these models, which does not say which focus is its own"

SWEEP = "At other apertures, ρ, noise, normalisations and starts: [codesign_sweep.md](codesign_sweep.md)."

#: Figures of the page, by file name: what each shows.
CAPTIONS = {
    "loss.png": "Loss in training, mean of every epoch; bands: range over seeds.",
    "focus.png": "The sensor in training, and the object distance whose paraxial image it is.",
    "blur.png": "RMS blur of traced rays on the axis, of the learned lenses.",
    "distance.png": "Loss of test pictures with DRT PSFs after step 2, over object distance.",
    "examples.png": "A patch of dead leaves as the sensor sees it and restored, with DRT PSFs after step 2.",
    "scan.png": "Expected error behind the best linear filter, over the sensor distance: without a network, without "
    "drawn noise.",
}


@dataclasses.dataclass(frozen=True)
class Report:
    """All that a page says.

    missing: (row, seed) of runs that are not finished; figures: file names that exist; sweep: whether there is a page
    of one beside this; of_paper: whether the lens is the paper's, whose numbers then stand beside the found ones.
    """

    lens: str
    pictures: str
    settings: Settings
    found: tuple[Outcome, ...]
    missing: tuple[tuple[str, int], ...]
    optima: tuple[Optimum, ...]
    times: tuple[StepTime, ...]
    figures: tuple[str, ...]
    machine: Mapping[str, str | int]
    sweep: bool = False
    of_paper: bool = True


def markdown(report: Report, *, folder: str = "codesign", kept: str = "") -> str:
    """The page. folder: where its figures lie, as the page calls it; kept: text to end with, below `KEPT`."""
    parts = [
        "# Co-design: which PSF model chooses the better lens?",
        _command(report),
        _experiment(report),
        _progress(report),
        "## Loss and focus",
        _table(report.found, of_paper=report.of_paper),
        *(["## The paper's claims", _claims(report)] if report.of_paper else []),
        *(f"![{CAPTIONS[name]}]({folder}/{name})\n\n*{CAPTIONS[name]}*" for name in report.figures),
        "## The best linear filter beside training",
        _closed_form(report),
        "## Time of a step",
        _times(report),
        f"{KEPT}\n{kept.strip()}".strip(),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def below_the_mark(page: str) -> str:
    """What a page made before keeps."""
    return page.partition(KEPT)[2].strip()


def _command(report: Report) -> str:
    rows = list(dict.fromkeys([one.model for one in report.found] + [row for row, _ in report.missing]))
    seeds = sorted({one.seed for one in report.found} | {seed for _, seed in report.missing})
    words = [f"--models {' '.join(rows)}", f"--seeds {' '.join(map(str, seeds))}", *options(report.settings)]
    return f"    raytrace codesign compare {report.lens} --data DIR -o FOLDER --docs docs {' '.join(words)}"


def options(settings: Settings) -> list[str]:
    """The settings that are not the default ones, as options of the command."""
    usual, found = Settings(), []
    for field in dataclasses.fields(Settings):
        value = getattr(settings, field.name)
        if field.name in ("model", "seed") or value == getattr(usual, field.name):
            continue
        option = {"fields": "field", "wavelengths": "wavelength"}.get(field.name, field.name).replace("_", "-")
        shown = " ".join(f"{one:g}" for one in value) if isinstance(value, tuple) else value
        found.append(f"--{option} {shown}")
    return found


def _experiment(report: Report) -> str:
    s = report.settings
    aperture = "the file's aperture" if s.f_number is None else f"F/{s.f_number:g}"
    start = {
        "paraxial": f"the paraxial image of {s.focus_distance / 1e3:g} m",
        "rms": f"the least RMS spot of an object at {s.focus_distance / 1e3:g} m",
        "spectral": "the optimum of the closed form",
    }.get(s.start, f"{s.start} mm")
    where = "the axis" if s.fields == (0.0,) else "the fields " + ", ".join(f"{y:g}" for y in s.fields)
    light = {"window": "the window", "energy": "the light through the pupil"}[s.normalise]
    return (
        f"{report.lens} at {aperture}, {_colours(s)}, on {where}; objects at {s.near / 1e3:g} to "
        f"{s.far / 1e3:g} m, drawn evenly; windows of {s.size} × {s.size} pixels of {1e3 * s.pixel:g} µm, PSFs "
        f"normalised to {light}; noise of standard deviation {s.noise:g} on pictures in [0, 1]. Learned: {s.vary}, "
        f"from {start}. RED-Net of {s.depth} layers of {s.width} maps in {s.precision}, L¹ loss, Adam at "
        f"{s.rate_network:g} (network) and {s.rate_optics:g} (lens), {s.epochs} epochs of each step, batches of "
        f"{s.batch} patches of {s.patch} × {s.patch}. {report.pictures}."
    )


def _colours(s: Settings) -> str:
    listed = ", ".join(f"{one:g}" for one in s.wavelengths)
    if len(s.wavelengths) == 1:
        return f"{listed} µm"
    return f"{listed} µm weighted {', '.join(f'{one:g}' for one in s.wavelength_weights)}"


def _progress(report: Report) -> str:
    if not report.missing:
        return ""
    missing = ", ".join(f"{row} {seed}" for row, seed in report.missing)
    return (
        f"**Unfinished: {len(report.found)} of {len(report.found) + len(report.missing)} runs.** Missing, by model and "
        f"seed: {missing}."
    )


def _table(found: Sequence[Outcome], *, of_paper: bool) -> str:
    if not found:
        return "No run is finished yet."
    header = (
        "model", "seeds", "L¹, step 1", "L¹, step 2 (DRT)", "change", "focus, paraxial (m)", "focus, RMS (m)",
        "sensor (mm)", *(("paper: L¹, step 1", "paper: step 2", "paper: focus (m)") if of_paper else ()),
    )  # fmt: skip
    rows = []
    for one in summaries(found):
        rows.append(
            (
                NAMES.get(one.model, one.model),
                one.seeds,
                _spread(one, "l1_joint", 4),
                _spread(one, "l1_drt", 4),
                f"{100 * penalty(one):+.1f} %",
                _spread(one, "focus_paraxial_m", 1),
                _spread(one, "focus_rms_m", 1),
                _spread(one, "sensor_mm", 4),
                *(_paper(one.model) if of_paper else ()),
            )
        )
    return (
        f"{table(header, rows)}\n\nMean ± standard deviation over seeds, of test pictures; every model of a seed sees "
        "the same crops, distances and noise. Focus is the object distance from vertex 1 whose image is on the sensor: "
        "the paraxial one, or that of least RMS spot"
        f"{_OF_PAPER if of_paper else ''}."
        " Rows one by one: [table2.csv](codesign/table2.csv)."
    )


def _paper(model: str) -> tuple[str, ...]:
    if model not in PAPER:
        return ("–",) * 3
    first, second, focus = PAPER[model]
    return f"{first:.4f}", f"{second:.4f}", f"{focus:.1f}"


def _claims(report: Report) -> str:
    rows = [(one.text, f"**{one.answer}**", one.figures, one.criterion) for one in claims(report.found, report.times)]
    return table(("claim", "here", "figures", "yes if"), rows)


def _closed_form(report: Report) -> str:
    trained = {one.model: one for one in summaries(report.found)}
    header = (
        "model", "sensor (mm)", "trained (mm)", "focus, paraxial (m)", "focus, RMS (m)", "error, own PSFs",
        "error, DRT PSFs",
    )  # fmt: skip
    rows = [
        (
            NAMES.get(one.model, one.model),
            f"{one.sensor_mm:.4f}" + (" (no optimum)" if one.no_optimum else ""),
            _spread(trained[one.model], "sensor_mm", 4) if one.model in trained else "–",
            shown(one.focus_paraxial_m, 1),
            shown(one.focus_rms_m, 1),
            f"{one.error:.6f}",
            f"{one.error_drt:.6f}",
        )
        for one in report.optima
    ]
    text = (
        f"{table(header, rows)}\n\nMean square error of a pixel behind the best linear filter that does not know the "
        "object distance, for pictures of this power spectrum: [spectral.csv](codesign/spectral.csv)."
    )
    return f"{text} {SWEEP}" if report.sweep else text


def _times(report: Report) -> str:
    rows = [
        (NAMES.get(one.model, one.model), f"{one.psf:.1f}", f"{one.image:.1f}", f"{one.network:.1f}")
        for one in report.times
    ]
    about = ", ".join(f"{key} {value}" for key, value in report.machine.items())
    parts = table(("model", "PSFs (ms)", "image (ms)", "network (ms)"), rows)
    return f"{parts}\n\nA batch, forward and backward, median of several: {about}."


def _spread(one: Summary, column: str, digits: int) -> str:
    mean, deviation = shown(one.mean[column], digits), shown(one.deviation[column], digits)
    return f"{mean} ± {deviation}" if one.seeds > 1 else mean


def shown(value: float, digits: int) -> str:
    """A number with so many digits behind the point; ∞, and – for none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "∞" if math.isinf(value) else "–"


def table(header: Sequence, rows: Iterable[Sequence]) -> str:
    """A table of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)

"""Report of a study: as text, as a document, as a page of Markdown."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

from raytrace.maths.result import Result, plain
from raytrace.pages import grid, picture, shown
from raytrace.studies.codesign.claims import Claim, Seen, claims, penalty, percent
from raytrace.studies.codesign.experiment import Outcome
from raytrace.studies.codesign.optima import Optimum
from raytrace.studies.codesign.settings import GAUSSIAN, NAMES, Settings
from raytrace.studies.codesign.study import PAPER, StepTime, Summary, rows, summaries

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

_OF_PAPER = "; “paper”: the published study of this lens and these models, which does not say which focus is its own"
_SWEEP = "At other apertures, ρ, noise, normalisations and starts: [codesign_sweep.md](codesign_sweep.md)."


_NOTHING = Seen()


@dataclasses.dataclass(frozen=True)
class Report(Result):
    """All that a page says.

    missing: (row, seed) of runs that are not finished; figures: file names that exist; sweep: whether there is a page
    of one beside this; folder: beside the page, of tables and figures; of_paper: whether the lens is the paper's, whose
    numbers then stand beside the found ones.
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
    folder: str = "codesign"
    seen: Seen = _NOTHING

    @property
    def claims(self) -> list[Claim]:
        """Those of the paper, if the lens is its."""
        if not self.of_paper:
            return []
        return claims(self.found, self.times, self.seen, pending={row for row, _ in self.missing})

    def document(self) -> dict:
        return plain(
            {
                "settings": dataclasses.asdict(self.settings),
                "rows": rows(self.found),
                "missing": [{"model": row, "seed": seed} for row, seed in self.missing],
                "models": [dataclasses.asdict(one) for one in summaries(self.found)],
                "claims": [{**dataclasses.asdict(one), "answer": one.answer} for one in self.claims],
                "closed_form": [one.document() for one in self.optima],
                "times": [dataclasses.asdict(one) for one in self.times],
            }
        )

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        columns = ("L1 step 1", "L1 step 2", "paraxial m", "RMS m", "sensor mm")
        yield f"{'model':>26} {'seeds':>5} " + " ".join(f"{column:>10}" for column in columns)
        for one in summaries(self.found):
            mean = one.mean
            yield (
                f"{NAMES[one.model]:>26} {one.seeds:>5} {mean['l1_joint']:>10.5f} {mean['l1_drt']:>10.5f} "
                f"{mean['focus_paraxial_m']:>10.2f} {mean['focus_rms_m']:>10.2f} {mean['sensor_mm']:>10.4f}"
            )
        for claim in self.claims:
            yield f"{claim.answer:>11}: {claim.text}; {claim.figures}"
        if self.missing:
            yield f"not finished: {', '.join(f'{row} {seed}' for row, seed in self.missing)}"

    def parts(self) -> list[str]:
        """The page."""
        asked = ("claim", "here", "figures", "yes if")
        answers = [(one.text, f"**{one.answer}**", one.figures, one.criterion) for one in self.claims]
        return [
            "# Co-design: which PSF model chooses the better lens?",
            _command(self),
            _experiment(self),
            _progress(self),
            "## Loss and focus",
            _table(self),
            *(["## The paper's claims", grid(asked, answers)] if self.of_paper else []),
            *(picture(f"{self.folder}/{name}", CAPTIONS[name]) for name in self.figures),
            "## The best linear filter beside training",
            _closed_form(self),
            "## Time of a step",
            _times(self),
        ]


def _command(report: Report) -> str:
    models = list(dict.fromkeys([one.model for one in report.found] + [row for row, _ in report.missing]))
    seeds = sorted({one.seed for one in report.found} | {seed for _, seed in report.missing})
    page = [] if report.folder == "codesign" else [f"--page {report.folder}"]
    words = [f"--models {' '.join(models)}", f"--seeds {' '.join(map(str, seeds))}", *page, *report.settings.words()]
    return f"    raytrace codesign compare {report.lens} --data DIR -o FOLDER --docs docs {' '.join(words)}"


def _experiment(report: Report) -> str:
    s = report.settings
    aperture = "the file's aperture" if s.f_number is None else f"F/{s.f_number:g}"
    start = {
        "paraxial": f"the paraxial image of {s.focus_distance / 1e3:g} m",
        "rms": f"the least RMS spot of an object at {s.focus_distance / 1e3:g} m",
        "spectral": "the optimum of the closed form",
        GAUSSIAN: "the optimum of the closed form of Gaussian DRT",
    }.get(s.start, f"{s.start} mm")
    where = "the axis" if s.fields == (0.0,) else f"the fields {_listed(s.fields)}"
    weights = f" weighted {_listed(s.wavelength_weights)}" if len(s.wavelengths) > 1 else ""
    counts = {"Gaussian DRT in step 1" if s.drt_rays else "step 1": s.rays, "DRT in both steps": s.drt_rays}
    traced = [f"{count} rays ({s.sampling}) for {where}" for where, count in counts.items() if count is not None]
    rays = f", traced with {' and '.join(traced)}" if traced else ""
    rays += "; rays beyond the semi-diameters are vignetted" if s.vignetting == "semi-diameters" else ""
    spread = "" if s.spread == "uniform" else " in 1/z"
    falling = "" if s.decay == "none" else ", falling to 0 along half a cosine"
    light = {"window": "the window", "energy": "the light through the pupil"}[s.normalise]
    return (
        f"{report.lens} at {aperture}, {_listed(s.wavelengths)} µm{weights}, on {where}; objects at {s.near / 1e3:g} "
        f"to {s.far / 1e3:g} m, drawn evenly{spread}; windows of {s.size} × {s.size} pixels of {1e3 * s.pixel:g} µm, "
        f"PSFs normalised to {light}{rays}; noise of standard deviation {s.noise:g} on pictures in [0, 1]. Learned: "
        f"{s.vary}, from {start}. RED-Net of {s.depth} layers of {s.width} maps in {s.precision}, L¹ loss, Adam at "
        f"{s.rate_network:g} (network) and {s.rate_optics:g} (lens){falling}, {s.epochs} epochs of each step, batches "
        f"of {s.batch} patches of {s.patch} × {s.patch}. {report.pictures}."
    )


def _listed(numbers: Sequence[float]) -> str:
    return ", ".join(f"{one:g}" for one in numbers)


def _progress(report: Report) -> str:
    if not report.missing:
        return ""
    missing = ", ".join(f"{row} {seed}" for row, seed in report.missing)
    done = len(report.found)
    return f"**Unfinished: {done} of {done + len(report.missing)} runs.** Missing, by model and seed: {missing}."


def _table(report: Report) -> str:
    found, of_paper = report.found, report.of_paper
    if not found:
        return "No run is finished yet."
    header = (
        "model", "seeds", "L¹, step 1", "L¹, step 2 (DRT)", "change", "focus, paraxial (m)", "focus, RMS (m)",
        "sensor (mm)", "mean of the last two epochs (mm)",
        *(("paper: L¹, step 1", "paper: step 2", "paper: focus (m)") if of_paper else ()),
    )  # fmt: skip
    lines = [
        (
            NAMES[one.model],
            one.seeds,
            _spread(one, "l1_joint", 4),
            _spread(one, "l1_drt", 4),
            percent(penalty(one)),
            _spread(one, "focus_paraxial_m", 1),
            _spread(one, "focus_rms_m", 1),
            _spread(one, "sensor_mm", 4),
            _spread(one, "sensor_last_epochs_mm", 4),
            *(_paper(one.model) if of_paper else ()),
        )
        for one in summaries(found)
    ]
    return (
        f"{grid(header, lines)}\n\nMean ± standard deviation over seeds, of test pictures; every model of a seed sees "
        "the same crops, distances and noise. Focus is the object distance from vertex 1 whose image is on the sensor: "
        f"the paraxial one, or that of least RMS spot{_OF_PAPER if of_paper else ''}."
        f" Rows one by one, with the range of the sensor in the last two epochs of step 1: "
        f"[table2.csv]({report.folder}/table2.csv); by object distance: "
        f"[distance.csv]({report.folder}/distance.csv)."
    )


def _paper(model: str) -> tuple[str, ...]:
    if model not in PAPER:
        return ("–",) * 3
    first, second, focus = PAPER[model]
    return f"{first:.4f}", f"{second:.4f}", f"{focus:.1f}"


def _closed_form(report: Report) -> str:
    trained = {one.model: one for one in summaries(report.found)}
    header = (
        "model", "sensor (mm)", "trained (mm)", "focus, paraxial (m)", "focus, RMS (m)", "error, own PSFs",
        "error, DRT PSFs",
    )  # fmt: skip
    lines = [
        (
            NAMES[one.model],
            f"{one.sensor_mm:.4f}" + (" (no optimum)" if one.no_optimum else ""),
            _spread(trained[one.model], "sensor_mm", 4) if one.model in trained else "–",
            shown(one.focus_paraxial_m, 1),
            shown(one.focus_rms_m, 1),
            f"{one.error:.6f}",
            f"{one.error_drt:.6f}",
        )
        for one in report.optima
    ]
    scanned = (
        f"; over the sensor distance: [scan.csv]({report.folder}/scan.csv)" if "scan.png" in report.figures else ""
    )
    return (
        f"{grid(header, lines)}\n\nMean square error of a pixel behind the best linear filter that does not know the "
        f"object distance, for pictures of this power spectrum: [spectral.csv]({report.folder}/spectral.csv){scanned}."
        f"{f' {_SWEEP}' if report.sweep else ''}"
    )


def _times(report: Report) -> str:
    lines = [(NAMES[one.model], *(f"{ms:.1f}" for ms in (one.psf, one.image, one.network))) for one in report.times]
    about = ", ".join(f"{key} {value}" for key, value in report.machine.items())
    table = grid(("model", "PSFs (ms)", "image (ms)", "network (ms)"), lines)
    return f"{table}\n\nA batch, forward and backward, median of several, the models in turns: {about}."


def _spread(one: Summary, column: str, digits: int) -> str:
    mean, deviation = shown(one.mean[column], digits), shown(one.deviation[column], digits)
    return f"{mean} ± {deviation}" if one.seeds > 1 and math.isfinite(one.deviation[column]) else mean

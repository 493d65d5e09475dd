"""The hard cases: values, statuses, roots, gradients and OPD against 30-digit references.

Oracle: tests/oracles/hardcases.json.gz (mpmath at 220 digits; schema in its `meta`). RAYTRACE_HARDCASES=FILE runs the
same test on another file of that schema, plain or compressed. score = |error|/(u·cond), with u = 2⁻⁵³ (2⁻²⁴ in
float32), is 1 for what an exact algorithm loses by the rounding of its inputs.
"""

import gzip
import json
import math
import os
import warnings
from decimal import Decimal, getcontext
from pathlib import Path

import hardcases_gaussian
import hardcases_splat
import hardcases_wave
import pytest
import torch

from raytrace.glass import (
    AIR,
    MIRROR,
    InvalidIndex,
    OutOfRange,
    check_wavelengths,
    constant,
    refractive_index,
    sellmeier,
)
from raytrace.launch import rays_from_infinity, rays_from_point
from raytrace.numerics import dot, unit
from raytrace.rays import Rays
from raytrace.surface import Aperture, Surface
from raytrace.trace import axial_path, start, steps
from raytrace.wavefront import path_to_reference_sphere

getcontext().prec = 60

ROUNDING = {torch.float64: 2.0**-53, torch.float32: 2.0**-24}
SMALLEST = {torch.float64: 2.0**-1074, torch.float32: 2.0**-149}  # spacing of denormal numbers
VALUE_SCORE = 30.0  # for chains of up to 20 surfaces
LONG_CHAIN_SCORE = 100.0  # rounding accumulates over more than 20 surfaces
GRADIENT_SCORE = 100.0
OPD_WAVES = {torch.float64: 1e-11, torch.float32: 3e-3}
STATUS = {"tangent": "miss", "tir_critical": "tir"}  # limits of a miss and of total reflection

OUTPUTS = ("x", "y", "z", "L", "M", "N", "opl")


def load_cases() -> list[dict]:
    """Cases of the file named by RAYTRACE_HARDCASES, else of the oracle; an unreadable file is an error, no skip."""
    path = Path(os.environ.get("RAYTRACE_HARDCASES") or Path(__file__).parent / "oracles" / "hardcases.json.gz")
    content = path.read_bytes()
    return json.loads(gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content)["cases"]


CASES = load_cases()


def of_kind(kind: str) -> list:
    return [pytest.param(case, id=case["id"]) for case in CASES if case["kind"] == kind]


def error(value: float, expected: str) -> float:
    """|value - expected| with the expected decimal at its full length; inf for a value that is not finite."""
    return float(abs(Decimal(value) - Decimal(expected))) if math.isfinite(value) else math.inf


class Scene:
    """One case as surfaces, media and rays; every number of it is a leaf with one entry per ray."""

    def __init__(self, case: dict, dtype: torch.dtype, *, shared: bool = False, rays: list[int] | None = None):
        self.case, self.dtype = case, dtype
        self.rays = [case["rays"][i] for i in (range(len(case["rays"])) if rays is None else rays)]
        self.shared = shared
        self.parameters: dict[str, torch.Tensor] = {}
        self.surfaces = [self._surface(i, s) for i, s in enumerate(case["surfaces"])]
        self.indices = self._media()

    def leaf(self, name: str, value: float) -> torch.Tensor:
        if name not in self.parameters:
            shape = () if self.shared else (len(self.rays),)
            self.parameters[name] = torch.tensor(value, dtype=self.dtype).expand(shape).clone().requires_grad_()
        return self.parameters[name]

    def _surface(self, i: int, s: dict) -> Surface:
        asked = any(f"s{i}.c" in e.get("grad", {}).get("x", ()) for e in self.case["expected"])
        plane = s["type"] == "plane" and not asked
        coefficients = None
        if s["type"] == "even_asphere":
            terms = [self.leaf(f"s{i}.a{2 * j + 4}", a) for j, a in enumerate(s["a"])]
            coefficients = torch.stack([torch.zeros_like(terms[0]), *terms])
        rim = s["semi_diameter"]
        return Surface(
            thickness=self.leaf(f"s{i}.thickness", s["thickness"]),
            curvature=None if plane else self.leaf(f"s{i}.c", s["c"]),
            conic=None if plane else self.leaf(f"s{i}.k", s["k"]),
            coefficients=coefficients,
            glass=MIRROR if s["mode"] == "reflect" else constant(1.5) if s["mode"] == "refract" else AIR,
            semi_diameter=rim,
            apertures=() if rim is None else (Aperture("circular", (0.0, rim)),),
        )

    def _media(self) -> list[torch.Tensor]:
        media = [self.leaf("n0", self.case["media"][0])]
        for i, s in enumerate(self.case["surfaces"]):
            refracts = s["mode"] == "refract"
            media.append(self.leaf(f"n{i + 1}", self.case["media"][i + 1]) if refracts else media[-1])
        return media

    def _points(self, key: str) -> torch.Tensor:
        rows = []
        for j, axis in enumerate("xyz"):
            name = f"{key}.{axis}"
            values = [ray[key][j] for ray in self.rays]
            self.parameters[name] = torch.tensor(values, dtype=self.dtype, requires_grad=True)
            rows.append(self.parameters[name])
        return torch.stack(rows)

    def launch(self) -> tuple[Rays, torch.Tensor]:
        """The rays, and what turns their reduced path into the full one."""
        n0 = self.indices[0]
        origin = axial_path(self.surfaces, self.indices)
        form = set(self.rays[0])
        if form == {"o", "d"}:
            position = self._points("o")
            return start(position, self._points("d"), torch.zeros_like(position[0])), origin
        if form == {"field_dir", "aim"}:
            direction = self._points("field_dir")
            return rays_from_infinity(direction, self._points("aim"), index=n0), origin
        point = self._points("object")
        return rays_from_point(point, self._points("aim"), index=n0), origin + n0 * dot(point, unit(point))

    def run(self) -> dict:
        rays, origin = self.launch()
        status, fail_surface = ["ok"] * len(self.rays), [None] * len(self.rays)
        walk = list(steps(self.surfaces, rays, indices=self.indices))
        for k, crossing in enumerate(walk):
            reasons = ("miss", crossing.missed), ("tir", crossing.totally_reflected), ("vignetted", crossing.clipped)
            for reason, lost in reasons:
                for i in lost.nonzero().flatten().tolist():
                    if status[i] == "ok":
                        status[i], fail_surface[i] = reason, k
        last = walk[-1].rays
        values = (*last.position, *last.direction, last.opl + origin)
        return {
            "status": status,
            "fail_surface": fail_surface,
            "last": last,
            "walk": walk,
            **dict(zip(OUTPUTS, values, strict=True)),
        }


@pytest.mark.parametrize("case", of_kind("trace"))
def test_trace(case):
    check_float64(case)
    check_float32(case)
    check_gradients_of_shared_numbers(case)


def check_float64(case):
    scene = Scene(case, torch.float64)
    result = scene.run()
    for i, expected in enumerate(case["expected"]):
        assert result["status"][i] == STATUS.get(expected["status"], expected["status"]), f"ray {i}"
        assert result["fail_surface"][i] == expected["fail_surface"], f"ray {i}"
        if expected["status"] == "ok":
            check_values(case, result, i, [*expected["hits"][-1], *expected["dirs"][-1], expected["opl"]])
    check_gradients(case, scene, result)
    check_opd(case, result, scene, torch.float64)


def check_float32(case):
    """Values and statuses against the exact answers for inputs rounded to float32."""
    scene = Scene(case, torch.float32)
    result = scene.run()
    for i, expected in enumerate(case["expected"]):
        reference = expected.get("f32_inputs")
        if reference is None:
            continue
        assert result["status"][i] == STATUS.get(reference["status"], reference["status"]), f"ray {i}, float32"
        if reference["status"] == "ok":
            check_values(case, result, i, [*reference["hit"], *reference["dir"], reference["opl"]])
    check_opd(case, result, scene, torch.float32)


def check_gradients_of_shared_numbers(case):
    """One number of the lens seen by every ray of the batch: no lost neighbour may make its gradient NaN."""
    scene = Scene(case, torch.float64, shared=True)
    result = scene.run()
    total = sum(result[output].sum() for output in OUTPUTS)
    found = torch.autograd.grad(total, list(scene.parameters.values()), allow_unused=True)
    for name, gradient in zip(scene.parameters, found, strict=True):
        assert gradient is None or torch.isfinite(gradient).all(), name


def check_values(case, result, i, reference):
    """Score of every output of ray i; a case without `cond` is judged by status and root alone."""
    if case["expected"][i].get("cond") is not None:
        gate = LONG_CHAIN_SCORE if len(case["surfaces"]) > 20 else VALUE_SCORE
        assert score(case, result, i, reference) <= gate, f"ray {i}, {result['x'].dtype}"


def score(case, result, i, reference) -> float:
    """The largest |error|/(u·cond) over the outputs of ray i."""
    cond = case["expected"][i]["cond"]
    scores = []
    for output, value in zip(OUTPUTS, reference, strict=True):
        computed = result[output][i]
        unit_rounding = max(ROUNDING[computed.dtype] * cond[output], smallest(case, computed.dtype))
        scores.append(error(computed.item(), value) / unit_rounding)
    return max(scores)


def smallest(case, dtype):
    """Error that a direction rounded to the spacing of denormal numbers makes at the end of the system, mm."""
    return SMALLEST[dtype] * (1 + sum(abs(surface["thickness"]) for surface in case["surfaces"]))


def check_gradients(case, scene, result):
    for place, found in gradient_scores(case, scene, result).items():
        assert found <= GRADIENT_SCORE, place


def gradient_scores(case, scene, result) -> dict[tuple, float]:
    """Scores by (ray, output, parameter).

    A derivative may err by its own conditioning, and by what moves the output by less than its rounding:
    scale = grad_cond + |g| + cond/max(1, |p|). The last term only decides for derivatives too small to matter, such
    as d x/d k = 1e-34 of an almost flat surface.
    """
    unit_rounding, leaves, scores = ROUNDING[torch.float64], scene.parameters, {}
    for output in OUTPUTS:
        if not any(output in expected.get("grad", ()) for expected in case["expected"]):
            continue
        found = torch.autograd.grad(result[output].sum(), list(leaves.values()), retain_graph=True, allow_unused=True)
        gradients = dict(zip(leaves, found, strict=True))
        for i, expected in enumerate(case["expected"]):
            for name, value in expected.get("grad", {}).get(output, {}).items():
                if value is None:
                    continue
                gradient = 0.0 if gradients[name] is None else gradients[name][i].item()
                size = max(1.0, leaves[name][i].abs().item())
                scale = expected["grad_cond"][output][name] + abs(float(value)) + expected["cond"][output] / size
                scale = max(unit_rounding * scale, smallest(case, torch.float64))
                scores[i, output, name] = error(gradient, value) / scale
    return scores


def check_opd(case, result, scene, dtype):
    if "opd" in case:
        assert max(opd_errors(case, result, scene, dtype)) <= OPD_WAVES[dtype]


def opd_errors(case, result, scene, dtype) -> list[float]:
    """|error| in waves of the path to the reference sphere against the chief ray's, ray by ray."""
    opd = case["opd"]
    centre = torch.tensor(opd["center"], dtype=dtype)[:, None]
    radius = torch.tensor(opd["radius"], dtype=dtype)
    W = path_to_reference_sphere(result["last"], centre, radius, scene.indices[-1])
    W = (W - W[opd["chief"]]) / opd["wavelength_mm"]
    return [error(W[i].item(), expected) for i, expected in enumerate(opd["W_waves"]) if expected is not None]


@pytest.mark.parametrize("case", of_kind("index"))
def test_index(case):
    """Sellmeier index and its gradient inside and outside the range of the glass, next to poles, n² ≤ 0 and n < 1."""
    data, expected = case["data"], case["expected"]
    B = torch.tensor(data["B"], dtype=torch.float64, requires_grad=True)
    C = torch.tensor(data["C"], dtype=torch.float64, requires_grad=True)
    wavelength = torch.tensor(data["wavelength_um"], dtype=torch.float64, requires_grad=True)
    glass = sellmeier(B, C, data["glass"], wavelength_range=tuple(data["range_um"]))
    n = refractive_index(glass, wavelength)
    n.backward()
    gradients = {"wavelength": wavelength.grad.item()}
    gradients |= {f"B{j}": B.grad[j].item() for j in range(3)} | {f"C{j}": C.grad[j].item() for j in range(3)}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if expected["status"] == "invalid":
            with pytest.raises(InvalidIndex, match=data["glass"]):
                check_wavelengths(glass, wavelength)
            assert n.item() == 0.0
            assert all(gradient == 0.0 for gradient in gradients.values())
            return
        check_wavelengths(glass, wavelength)
    assert any(issubclass(entry.category, OutOfRange) for entry in caught) == (not expected["in_range"])
    assert error(n.item(), expected["n"]) <= VALUE_SCORE * ROUNDING[torch.float64] * float(expected["n"])
    for name, value in expected["grad"].items():
        allowed = GRADIENT_SCORE * ROUNDING[torch.float64] * abs(float(value))
        assert error(gradients[name], value) <= allowed, name


@pytest.mark.parametrize("case", of_kind("spot"))
def test_spot(case):
    hardcases_gaussian.check_spot(case)


@pytest.mark.parametrize("case", of_kind("gauss_pixel"))
def test_gauss_pixel(case):
    hardcases_gaussian.check_gauss_pixel(case)


@pytest.mark.parametrize("case", of_kind("splat"))
def test_splat(case):
    hardcases_splat.check_splat(case)


@pytest.mark.parametrize("case", of_kind("fft_psf"))
def test_fft_psf(case):
    hardcases_wave.check_fft_psf(case)


@pytest.mark.parametrize("case", of_kind("huygens"))
def test_huygens(case):
    hardcases_wave.check_huygens(case)


def table() -> str:
    """Markdown: per family the rays, and the worst value, gradient and OPD error of both dtypes."""
    families: dict[str, dict[str, float]] = {}
    for case in CASES:
        if case["kind"] != "trace":
            continue
        worst = families.setdefault(case["family"], dict.fromkeys(("rays", "right", "f64", "f32", "grad", "opd"), 0))
        double, single = Scene(case, torch.float64), Scene(case, torch.float32)
        result = double.run()
        result_32 = single.run()
        for i, expected in enumerate(case["expected"]):
            worst["rays"] += 1
            worst["right"] += result["status"][i] == STATUS.get(expected["status"], expected["status"])
            if expected["status"] != "ok" or "cond" not in expected:
                continue
            reference = [*expected["hits"][-1], *expected["dirs"][-1], expected["opl"]]
            worst["f64"] = max(worst["f64"], score(case, result, i, reference))
            rounded = expected.get("f32_inputs")
            if rounded is not None and rounded["status"] == "ok":
                reference = [*rounded["hit"], *rounded["dir"], rounded["opl"]]
                worst["f32"] = max(worst["f32"], score(case, result_32, i, reference))
        worst["grad"] = max([worst["grad"], *gradient_scores(case, double, result).values()])
        if "opd" in case:
            worst["opd"] = max([worst["opd"], *opd_errors(case, result, double, torch.float64)])
    lines = [
        "| family | rays | status right | value, float64 | value, float32 | gradient, float64 | OPD, float64, waves |",
        "|---|---|---|---|---|---|---|",
    ]
    for family, w in families.items():
        opd = f"{w['opd']:.1e}" if w["opd"] else ""
        lines.append(
            f"| {family} | {w['rays']} | {w['right']} | {w['f64']:.2g} | {w['f32']:.2g} | {w['grad']:.2g} | {opd} |"
        )
    total, right = (sum(w[key] for w in families.values()) for key in ("rays", "right"))
    return "\n".join([*lines, "", f"{right} of {total} rays right."])


if __name__ == "__main__":
    print(table())

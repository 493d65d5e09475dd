"""The file of hard cases, and one case of it as surfaces, media and rays.

RAYTRACE_HARDCASES=FILE takes another file of the same schema, plain or compressed, in place of the oracle.
"""

import gzip
import json
import os
from pathlib import Path

import pytest
import torch

from raytrace.materials.glass import AIR, MIRROR, constant
from raytrace.maths.numerics import dot, unit
from raytrace.system.rays import Rays, start
from raytrace.system.surface import Aperture, Surface
from raytrace.tracing.launch import rays_from_infinity, rays_from_point
from raytrace.tracing.trace import axial_path, steps

ORACLE = Path(__file__).parent / "oracles" / "hardcases.json.gz"
OUTPUTS = ("x", "y", "z", "L", "M", "N", "opl")


def load_cases(path: Path) -> list[dict]:
    """The cases of a file; one that cannot be read is an error, no skip."""
    content = path.read_bytes()
    return json.loads(gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content)["cases"]


CASES = load_cases(Path(os.environ.get("RAYTRACE_HARDCASES") or ORACLE))


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


def of_kind(kind: str) -> list:
    """Parameters of a test: the cases of a kind."""
    return [pytest.param(case, id=f"{kind}-{case['id']}") for case in CASES if case["kind"] == kind]

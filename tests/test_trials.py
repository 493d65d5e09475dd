"""Perturbed lenses as lens files: the same rays, glasses with errors in catalogs beside them, trials of a study."""

import dataclasses
import math
import warnings

import pytest
import torch
from problems import number, vector

import raytrace as rt
from raytrace.cli import main
from raytrace.io import LensFileError, LensFileWarning, write_lens
from raytrace.materials.catalogs import find_glass, load
from raytrace.materials.environment import index_in
from raytrace.materials.glass import (
    NoMelt,
    abbe_number,
    constant,
    index,
    melt,
    model_glass,
    nd,
    sellmeier,
    with_index_errors,
)
from raytrace.system.configurations import Operand, ScaledPath
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.phases import Grating
from raytrace.system.poses import Pose, decentred_first, rows_along, tilted_first
from raytrace.system.sag_terms import (
    FringeSag,
    PolynomialSag,
    PowerSag,
    ZernikeSag,
    about_vertex,
    as_fringe,
    relief,
    with_even_terms,
)
from raytrace.system.surface import sag_at
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_lens

PM = 1e-9  # mm
VISIBLE = torch.tensor([0.4861327, 0.5875618, 0.6562725], dtype=torch.float64)


def again(lens, folder, name="lens.zmx"):
    rt.write_lens(lens, folder / name)
    return rt.read_lens(folder / name)


def check_rays(lens, other, tolerance=PM):
    """Rays of both lenses, launched by each, meet the sensor at the same places, mm."""
    ends = []
    for one in (lens, other):
        rays = launch(one, rt.maths.gauss_rings(2, 5)[0], fields=None)
        end = trace_lens(one, rays, one.wavelengths[:, None])
        ends.append(torch.cat([end.position, end.direction, end.valid[None].double()]))
    assert ends[0][-1].any()
    torch.testing.assert_close(*ends, rtol=0, atol=tolerance)


def built(name, grade="commercial", trial=0, **conditions):
    lens = rt.read_lens(name).at(**conditions)
    rows = rt.tolerances(lens, grade=grade)
    return rt.tolerancing.perturbed(lens, rows, rt.tolerancing.draw_errors(rows, 1, 5, first=trial)[0])


# -- lenses -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "aiming"),
    [
        *((name, aiming) for name in ("cooke_triplet", "double_gauss") for aiming in ("off", "real")),
        *((name, "off") for name in ("cemented_achromat", "phone", "folded_relay")),
    ],
)
def test_a_perturbed_lens_is_read_back_with_the_same_rays(name, aiming, tmp_path):
    lens = built(name, "precision", ray_aiming=aiming)
    found = again(lens, tmp_path)
    check_rays(lens, found)
    assert found.ray_aiming == aiming
    check_rays(lens, again(found, tmp_path, "again.zmx"))


def test_a_group_inside_which_an_element_and_a_surface_move(tmp_path):
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="real")
    T = rt.system.Tolerance
    rows = [T("element_tilt_x", (1, 4), -2, 2), T("element_decenter_y", (1, 2), -1, 1, pivot=3.0)]
    rows += [T("element_tilt_y", (1, 2), -2, 2, pivot=1.5), T("surface_decenter_y", (1,), -1, 1)]
    made = rt.tolerancing.perturbed(lens, rows, [0.8, 0.3, -0.7, 0.2])
    assert made.surfaces[1].before.z is None
    check_rays(made, again(made, tmp_path))


def test_a_shift_of_an_element_is_that_of_the_thicknesses_before_and_behind():
    lens = rt.read_lens("cooke_triplet")
    shifted = rt.tolerancing.perturbed(lens, [rt.system.Tolerance("element_decenter_z", (3, 4), -1, 1)], [0.2])
    moved = rt.tolerancing.perturbed(lens, [rt.system.Tolerance("thickness", (2,), -1, 1, adjust=4)], [0.2])
    for one, other in zip(shifted.surfaces, moved.surfaces, strict=True):
        assert (one.before, one.after) == (None, None)
        assert float(one.thickness) == pytest.approx(float(other.thickness), abs=1e-14) or one.thickness.isinf()


# -- poses ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilts_first", [False, True])
def test_the_order_of_a_pose_changes_exactly(tilts_first):
    pose = Pose(*map(number, (0.3, -0.2, 1.7, 31.0, -24.0, 130.0)), tilts_first=tilts_first)
    for convert, order in ((decentred_first, False), (tilted_first, True)):
        found = convert(pose)
        assert found.tilts_first == order
        one, other = (torch.tensor([[float(n) for n in row] for row in rows_along([p])]) for p in (pose, found))
        torch.testing.assert_close(one, other, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", ["before", "after"])
@pytest.mark.parametrize("tilts_first", [False, True])
def test_decentres_along_z_are_written_as_thicknesses(name, tilts_first, tmp_path):
    pose = Pose(*map(number, (0.3, -0.2, 0.4, 1.0, -2.0, 3.0)), tilts_first=tilts_first)
    lens = rt.read_lens("singlet").at(object_distance=200.0, ray_aiming="real")
    lens = lens.replace(2, **{name: pose}).replace(1, before=Pose(z=number(-0.5)), after=Pose(z=number(0.2)))
    found = again(lens, tmp_path)
    ways = [
        rows_along([p for s in one.surfaces for p in (s.before, s.after, s.thickness) if p is not None])
        for one in (lens, found)
    ]
    one, other = (torch.tensor([[float(n) for n in row] for row in way], dtype=torch.float64) for way in ways)
    torch.testing.assert_close(one, other, rtol=0, atol=2e-13)
    assert (found.surfaces[1].before, found.surfaces[1].after) == (None, None)
    assert float(found.surfaces[0].thickness) == pytest.approx(199.5, abs=1e-12)


def test_a_right_angle_about_y_with_a_decentre_along_z_is_refused(tmp_path):
    pose = decentred_first(Pose(z=number(0.4), tilt_y=number(90.0), tilt_z=number(30.0), tilts_first=True))
    with pytest.raises(LensFileError, match=r"surface 2: .*90° about y.*coordinate break"):
        again(rt.read_lens("singlet").replace(2, after=pose), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_pose_behind_a_coordinate_break_joins_its_own(tmp_path):
    lens = rt.read_lens("singlet")
    behind = Pose(y=number(-0.1), z=number(0.2), tilt_x=number(-1.0))
    front = rt.system.Surface(number(1.0), before=Pose(tilt_x=number(1.0)), after=behind, is_break=True)
    lens = dataclasses.replace(lens, surfaces=(*lens.surfaces[:2], front, *lens.surfaces[2:]), ray_aiming="real")
    found = again(lens, tmp_path)
    assert found.surfaces[2].after is None
    check_rays(lens, found)


# -- sag terms --------------------------------------------------------------------------------------------------------

X, Y = torch.tensor([[0.0, 1.5, -2.0, 3.0], [0.0, -0.5, 2.5, 1.0]], dtype=torch.float64)


SAGS = {
    "powers": PowerSag(*map(number, (0.4, -0.3, 5.0, 0.01)), vector(1e-3, 2e-3, 0.0, -1e-3, 5e-4, 2e-4)),
    "zernike": ZernikeSag(vector(1e-3, 0, 2e-3, 1e-3, 0, 5e-4, 0, 2e-4, 0, 0, 1e-4), number(5.0)),
    "high": ZernikeSag(vector(*[0.0] * 21, 1e-4), number(5.0)),
    "fringe": FringeSag(vector(1e-3, 0, 2e-3, 1e-3, 0, 5e-4, 0, 2e-4), *map(number, (5.0, 0.4, -0.3))),
}


@pytest.mark.parametrize("name", SAGS)
def test_sag_terms_are_powers_about_the_vertex(name):
    polynomial, height = about_vertex(SAGS[name])
    one, other = (relief(part).sag(X, Y, highest=0).z for part in (SAGS[name], polynomial))
    torch.testing.assert_close(one, other + height, rtol=0, atol=1e-17)
    even = vector(2e-3, 0.0, -3e-6, 1e-7)
    expected = sum(a * (X * X + Y * Y) ** n for n, a in enumerate(even, 1))
    added = relief(with_even_terms(polynomial, even)).sag(X, Y, highest=0).z - other
    torch.testing.assert_close(added, expected, rtol=1e-13, atol=1e-16)


def test_powers_to_the_fifth_are_fringe_terms():
    for count in (1, 2, 4, 14, 20):
        terms = PolynomialSag(1e-3 * torch.cos(torch.arange(count, dtype=torch.float64)), number(4.0))
        one, other = (relief(part).sag(X, Y, highest=0).z for part in (terms, as_fringe(terms)))
        torch.testing.assert_close(one, other, rtol=0, atol=1e-17)
    assert as_fringe(dataclasses.replace(terms, coefficients=torch.ones(21, dtype=torch.float64))) is None


@pytest.mark.parametrize(("name", "kind"), [("powers", "FZERNSAG"), ("zernike", "FZERNSAG"), ("high", "XPOLYNOM")])
def test_sag_terms_on_an_asphere(name, kind, tmp_path):
    lens = rt.read_lens("singlet").at(ray_aiming="real")
    lens = lens.replace(2, sag_terms=SAGS[name], coefficients=[1e-4, 2e-6, 1e-9, 1e-12, 1e-14, 1e-16, 1e-18, 1e-20])
    found = again(lens, tmp_path)
    assert f"TYPE {kind}" in (tmp_path / "lens.zmx").read_text()
    check_rays(lens, found)
    one, other = (sag_at(part.surfaces[2], X, Y) for part in (lens, found))
    torch.testing.assert_close(one - one[0], other - other[0], rtol=0, atol=1e-15)
    # a height at the vertex belongs to the thickness before
    moved = found.surfaces[1].thickness - lens.surfaces[1].thickness
    assert float(moved) == pytest.approx(float(one[0] - other[0]), abs=1e-14)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "odd asphere", "coefficients": vector(0.0, 1e-6)}, "odd asphere, expected an even asphere"),
        ({"coefficients": torch.full((11,), 1e-30, dtype=torch.float64)}, "275 powers .* has 230"),
        ({"phase": Grating(number(0.1), number(1.0))}, "Grating with sag terms: a DGRATING surface has none"),
    ],
)
def test_sag_that_no_surface_of_a_file_has_is_refused(changes, message, tmp_path):
    lens = rt.read_lens("singlet").replace(2, sag_terms=SAGS["powers"], **changes)
    with pytest.raises(LensFileError, match=f"surface 2: .*{message}"):
        rt.write_lens(lens, tmp_path / "lens.zmx")
    assert list(tmp_path.iterdir()) == []


def test_a_batch_of_lenses_is_refused(tmp_path):
    lens = rt.read_lens("cooke_triplet")
    for limits in ("index=0.001", "irregularity=1", "radius=1%"):
        rows = rt.tolerances(lens, limits)
        with pytest.raises(LensFileError, match="a file holds one lens"):
            write_lens(rt.tolerancing.perturbed(lens, rows, rt.tolerancing.draw_errors(rows, 2)), tmp_path / "lens.zmx")


# -- glasses ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["N-SK16", "SF2", "S-FPL53", "N-LAK33B", "H-ZF52", "N-KZFS2", "SILICA"])
@pytest.mark.parametrize("waves", [VISIBLE, vector(0.4358, 0.5461, 0.5876, 0.6563, 0.7065), vector(0.5876)])
def test_a_melt_has_the_indices_of_the_glass_with_errors(name, waves):
    glass = with_index_errors(find_glass(name), number(8e-4), number(0.5))
    found = melt(glass, waves)
    torch.testing.assert_close(index(found, waves), index(glass, waves), rtol=0, atol=1e-14)
    between = torch.linspace(float(waves.min()), float(waves.max()), 50, dtype=torch.float64)
    torch.testing.assert_close(index(found, between), index(glass, between), rtol=0, atol=1e-8)
    assert float(nd(found)) == pytest.approx(float(nd(glass)), abs=1e-8)
    assert float(abbe_number(found)) == pytest.approx(float(abbe_number(glass)), abs=1e-4)
    assert (found.status, found.nd_listed) == ("melt", float(nd(found)))


def test_many_wavelengths_are_met_by_least_squares_and_nine_exactly():
    glass = with_index_errors(find_glass("N-SK16"), number(8e-4), number(0.5))
    for count, accuracy in ((9, 1e-13), (24, 1e-10)):
        waves = torch.linspace(0.42, 0.7, count, dtype=torch.float64)
        torch.testing.assert_close(index(melt(glass, waves), waves), index(glass, waves), rtol=0, atol=accuracy)


@pytest.mark.parametrize("formula", ["constant", "model", "conrady"])
def test_a_medium_of_few_numbers_keeps_its_formula(formula):
    media = {
        "constant": constant(1.6),
        "model": model_glass(1.6, 45.0, 0.01),
        "conrady": dataclasses.replace(model_glass(1.6, 45.0), formula="conrady", coefficients=vector(1.5, 0.01, 3e-3)),
    }
    glass = with_index_errors(media[formula], number(7e-4), None if formula == "constant" else number(-0.6))
    found = melt(glass, VISIBLE)
    waves = torch.linspace(0.4, 1.0, 30, dtype=torch.float64)
    assert found.formula == formula
    torch.testing.assert_close(index(found, waves), index(glass, waves), rtol=0, atol=5e-15)
    assert melt(found, VISIBLE) is found


def test_a_dispersion_that_no_formula_comes_near_is_refused(tmp_path):
    near = sellmeier([1.3, 0.002], [0.01, 0.15], "POLE")  # a resonance at 0.39 µm
    with pytest.raises(NoMelt, match=r"POLE .* no melt from 0.4 to 0.7 µm"):
        melt(with_index_errors(near, number(1e-3)), vector(0.4, 0.7))
    lens = rt.read_lens("singlet").replace(1, glass=near).at(wavelengths=[0.4, 0.7])
    lens = rt.tolerancing.perturbed(lens, [rt.system.Tolerance("index", (1,), -1, 1)], [1e-3])
    with pytest.raises(LensFileError, match=r"surface 1: POLE .* no melt"):
        rt.write_lens(lens, tmp_path / "lens.zmx")


INDEX = "index=0.0008 abbe=0.6%"


@pytest.mark.parametrize("name", ["worst one_3.zmx", "worst.csv"])
def test_melts_lie_in_a_catalog_beside_the_file(name, tmp_path):
    lens = rt.read_lens("double_gauss")
    rows = rt.tolerances(lens, INDEX)
    made = rt.tolerancing.perturbed(lens, rows, rt.tolerancing.draw_errors(rows, 1)[0])
    found = again(made, tmp_path, name)
    catalog = "WORST-ONE-3-MELTS" if " " in name else "WORST-MELTS"
    assert sorted(p.name for p in tmp_path.iterdir()) == [*sorted([f"{catalog.lower()}.agf", name])]
    assert found.catalogs == (*lens.catalogs, catalog)
    for one, other in zip(made.surfaces, found.surfaces, strict=True):
        if one.glass.name:
            assert other.glass.name.startswith(f"{one.glass.name}_M")
            assert (other.glass.catalog, other.glass.status) == (catalog, "melt")
            torch.testing.assert_close(
                index(one.glass, lens.wavelengths), index(other.glass, lens.wavelengths), rtol=0, atol=1e-12
            )
    check_rays(made, found)
    # the same glasses have the same names, in a file elsewhere too
    (tmp_path / "elsewhere").mkdir()
    third = again(found, tmp_path / "elsewhere", "other.zmx")
    assert third.catalogs == (*lens.catalogs, "OTHER-MELTS")
    assert [s.glass.name for s in third.surfaces] == [s.glass.name for s in found.surfaces]
    check_rays(made, third)


def test_melts_keep_their_indices_at_another_temperature(tmp_path):
    lens = rt.read_lens("double_gauss").at(temperature=60.0, pressure=0.5)
    rows = rt.tolerances(lens, INDEX)
    made = rt.tolerancing.perturbed(lens, rows, rt.tolerancing.draw_errors(rows, 1)[0])
    found = again(made, tmp_path)
    for one, other in zip(made.surfaces, found.surfaces, strict=True):
        indices = (index_in(s.glass, lens.wavelengths, lens.environment) for s in (one, other))
        torch.testing.assert_close(*indices, rtol=0, atol=1e-12)


def test_a_catalog_of_others_is_not_replaced(tmp_path):
    lens = rt.read_lens("double_gauss")
    rows = rt.tolerances(lens, INDEX)
    made = rt.tolerancing.perturbed(lens, rows, rt.tolerancing.draw_errors(rows, 1)[0])
    other = tmp_path / "lens-melts.agf"
    text = "CC my glasses\nNM MINE 2 500500 1.5 50 0 0 -1\nCD 1 0.01 0 0 0 0 0 0 0 0\nLD 0.3 2\n"
    other.write_text(text)
    with pytest.raises(LensFileError, match=r"lens-melts.agf .*give the lens another name"):
        rt.write_lens(made, tmp_path / "lens.zmx")
    assert [p.name for p in tmp_path.iterdir()] == ["lens-melts.agf"]
    assert other.read_text() == text
    other.unlink()
    rt.write_lens(made, tmp_path / "lens.zmx")
    names = set(load(other).glasses)
    rt.write_lens(made, tmp_path / "lens.zmx")
    assert set(load(other).glasses) == names


def test_a_sequence_of_code_v_refuses_index_errors(tmp_path):
    lens = rt.read_lens("double_gauss")
    made = rt.tolerancing.perturbed(lens, [rt.system.Tolerance("index", (1,), -1, 1)], [1e-3])
    with pytest.raises(LensFileError, match="not those of its catalog"):
        rt.write_lens(made, tmp_path / "lens.seq")


# -- what follows -----------------------------------------------------------------------------------------------------


def test_numbers_of_configurations_follow_a_shift(tmp_path):
    lens = rt.read_lens("cooke_triplet")
    gap = Operand("THIC", 2, paths=(ScaledPath(("surfaces", 2, "thickness")),), numbers=vector(8.0, 9.0))
    lens = dataclasses.replace(lens, operands=(gap,)).replace(2, thickness=8.0)
    made = rt.tolerancing.perturbed(lens, [rt.system.Tolerance("element_decenter_z", (3, 4), -1, 1)], [0.2])
    assert made.operands[0].numbers.tolist() == pytest.approx([8.2, 9.2], abs=1e-14)
    posed = lens.replace(3, before=Pose(z=number(0.2)), after=Pose(z=number(-0.2)))
    for one in (made, posed):
        found = again(one, tmp_path)
        assert [float(c.surfaces[2].thickness) for c in found.configurations] == pytest.approx([8.2, 9.2], abs=1e-14)


def test_rules_of_numbers_that_change_are_left_out_with_a_warning(tmp_path):
    lens = rt.read_lens("cooke_triplet").replace(3, sag_terms=SAGS["powers"], coefficients=vector(0.0, 1e-7))
    lens = lens.replace(4, after=Pose(z=number(0.1)))
    rules = OptimizationData(
        variables=(Vary(3, "curvature"), Vary(3, "a4")), solves=(Solve(4, "thickness", "pickup", source=2),)
    )
    with pytest.warns(LensFileWarning, match="the optimisation data"):
        found = again(dataclasses.replace(lens, optimization_data=rules), tmp_path)
    assert found.optimization_data.variables == (Vary(3, "curvature"),)
    assert found.optimization_data.solves == ()


# -- trials of a study ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study():
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="off", fields=[0, 8.4, -8.4, 11.9, -11.9])
    data = OptimizationData(variables=(Vary(1, "curvature"),), solves=(Solve(7, "curvature", "f_number", (3.5,)),))
    lens = dataclasses.replace(lens, optimization_data=data)
    return rt.tolerance(lens, grade="commercial", trials=40, rings=4)


def rms(lens):
    """RMS spot radius, µm, of all fields, by `rt.spot` with the pupil points of the study."""
    with warnings.catch_warnings(action="ignore"):
        return 1e3 * float(rt.spot(lens, rings=4).whole.mean_square_radius.mean().sqrt())


def test_a_trial_is_the_lens_whose_criterion_the_study_has(study):
    for k in (0, 7, study.worst_trial):
        lens = study.trial(k)
        assert rms(lens) == pytest.approx(float(study.trials[k]), abs=1e-8)
        assert lens.optimization_data.variables == lens.optimization_data.solves == ()
        assert lens.notes[-1] == f"As built: trial {k} of seed 0, RMS spot radius {float(study.trials[k]):.6g} µm"
    for k in (-1, 40):
        with pytest.raises(ValueError, match=f"trial {k}: expected 0 to 39"):
            study.trial(k)


def test_typical_and_worst_trials_leave_out_those_that_failed(study):
    ordered = study.trials.sort().values
    assert float(study.trials[study.worst_trial]) == float(ordered[-1])
    assert float(study.trials[study.best_trial]) == float(ordered[0])
    assert float(study.trials[study.typical]) == float(ordered[19])
    values = study.trials.clone()
    values[:3] = torch.nan
    failed = dataclasses.replace(study, trials=values)
    assert float(values[failed.worst_trial]) == float(values[3:].max())
    assert float(values[failed.best_trial]) == float(values[3:].min())
    assert float(values[failed.typical]) == float(values[3:].median())
    assert failed.trial(0).notes[-1].endswith("no light")
    for trials, reason in ((values * torch.nan, "no light arrives"), (values[:0], "give `trials` above 0")):
        with pytest.raises(ValueError, match=reason):
            _ = dataclasses.replace(study, trials=trials).typical


@pytest.mark.slow
def test_trials_are_saved_as_lens_files(study, tmp_path):
    folder = tmp_path / "built" / "here"
    for _ in range(2):  # the second time they replace those that are there
        study.save_trials(folder)
        names = ("best", "typical", "worst")
        assert sorted(p.name for p in folder.iterdir()) == sorted(
            [*(f"{n}.zmx" for n in names), *(f"{n}-melts.agf" for n in names)]
        )
    numbers = {"typical": study.typical, "worst": study.worst_trial, "best": study.best_trial}
    for name, k in numbers.items():
        found = rt.read_lens(folder / f"{name}.zmx")
        assert rms(found) == pytest.approx(float(study.trials[k]), abs=1e-8)
        assert found.notes[-1] == study.trial(k).notes[-1]
        check_rays(study.trial(k), found)


def test_the_command_saves_trials(tmp_path, capsys):
    words = ["tolerance", "cemented_achromat", "--grade", "precision", "--save-trials", str(tmp_path / "built")]
    assert main([*words, "--trials", "0"]) != 0
    assert "there are no trials" in capsys.readouterr().err
    assert not (tmp_path / "built").exists()
    assert main([*words, "--trials", "12", "--seed", "3"]) == 0
    printed = capsys.readouterr()
    assert "12 trials (seed 3)" in printed.out
    assert "typical.zmx, worst.zmx and best.zmx in" in printed.err
    found = rt.tolerance(rt.read_lens("cemented_achromat"), grade="precision", trials=12, seed=3)
    check_rays(found.trial(found.worst_trial), rt.read_lens(tmp_path / "built" / "worst.zmx"))
    assert math.isfinite(float(found.trials[found.typical]))


def test_the_command_stores_tightened_tolerances_in_a_lens(tmp_path, capsys):
    file = tmp_path / "toleranced.zmx"
    words = ["tolerance", "cemented_achromat", "--limits", "element_tilt_radial=0.2 thickness=0.1", "--trials", "0"]
    assert main([*words, "--increment", "0.01", "--workshop", "any", "--save-lens", str(file)]) == 0
    assert f"written: {file}" in capsys.readouterr().err
    lens = rt.read_lens("cemented_achromat")
    study = rt.tolerance(lens, limits=words[3], increment=0.01, workshop="any", trials=0)
    assert study.tightened()
    stored = rt.tolerances(rt.read_lens(file))
    assert {row.source for row in stored if row.kind == "element_tilt_x"} == {
        "tightened from limits element_tilt_radial=0.2"
    }
    assert dict(zip(stored.names, stored.ranges[1].tolist(), strict=True)) == pytest.approx(
        dict(zip(study.tolerances.names, study.tolerances.ranges[1].tolist(), strict=True)), rel=1e-12
    )
    assert main([*words, "--save-lens", str(tmp_path / "table.csv")]) != 0  # tables hold no tolerances

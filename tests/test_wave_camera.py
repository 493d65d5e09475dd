"""Extended depth of field: haze, closed form against restored pictures, learning, resuming, the order of the table."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scripts import script

from raytrace.cli.wave_run import learn
from raytrace.imaging.closed_form import camera_error
from raytrace.imaging.pictures import dead_leaves, digest
from raytrace.imaging.restoration import (
    depth_invariant_error,
    depth_invariant_wiener,
    errors,
    power_spectrum,
    psnr,
    restore,
    wiener,
)
from raytrace.imaging.training import SCHEDULES, OtherSettings
from raytrace.imaging.variables import PhaseVariables
from raytrace.imaging.wave_camera import WaveCameraConfig, best_gamma, mirrored, periodic, quality, transfer
from raytrace.imaging.wave_design import Design, radial_powers
from raytrace.materials.glass import index
from raytrace.maths.zernike import polynomials
from raytrace.settings import DesignSettings
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element, EvenPowers, height

edof_table = script("wave_edof")
STRENGTHS, Content, elements_of = edof_table.STRENGTHS, edof_table.Content, edof_table.elements_of
records, table_of = edof_table.records, edof_table.table_of
#: One colour, three depths, a window of 0.47 mm: a step takes milliseconds.
SMALL = WaveCameraConfig(depths=(500.0, 1000.0, math.inf), wavelengths=(0.55,), size=63, pixel=0.00738)
LEAVES = dead_leaves(8, size=64, seed=5, smallest=2.5)
PICTURES = periodic(LEAVES, 128)
S, OF_LEAVES = power_spectrum(PICTURES, window="none"), digest(LEAVES.samples)
QUICK = DesignSettings(kind="smooth", terms=4, starts=1, start_steps=5, steps=12, size=128, rate=0.05)


def test_light_beyond_the_window_is_added_as_haze():
    """A picture of one shade keeps it; without haze it would darken by what misses the window."""
    camera = WaveCameraConfig(size=31).camera(baseline("fresnel", aim()))
    H = transfer(camera, 64, [1000.0])
    assert torch.allclose(H[..., 0, 0].real, torch.ones(1, 3, dtype=torch.float64), atol=1e-12)
    flat = torch.full((1, 3, 64, 64), 0.3, dtype=torch.float64)
    torch.testing.assert_close(camera.image(flat, [1000.0]), flat, atol=1e-12, rtol=0)
    lost = WaveCameraConfig(size=31).camera(baseline("fresnel", aim()), normalise="energy")
    assert float(lost.image(flat, [1000.0]).max()) < 0.28
    detail = PICTURES[:1, None, :64, :64].expand(1, 3, 64, 64)
    image = torch.fft.ifft2(torch.fft.fft2(detail) * H[0]).real
    torch.testing.assert_close(camera.image(detail, [1000.0]), image, atol=1e-12, rtol=0)


def test_periodic_pictures_have_no_seam_and_their_spectrum_adds_up():
    picture = periodic(LEAVES, 128)[0]
    assert torch.equal(picture, picture.flip(0))
    assert torch.equal(picture[:, 0], picture[:, -1])
    assert float(S.mean()) == pytest.approx(float(PICTURES.square().mean()), rel=1e-12)
    with pytest.raises(ValueError, match="64 × 64 pixels, expected 100"):
        periodic(LEAVES, 200)


def test_the_closed_form_is_the_error_of_restored_pictures():
    """Within 1 %: pictures of just this spectrum, noise drawn for each."""
    camera = SMALL.camera(baseline("singlet", aim()))
    H = transfer(camera, 128, SMALL.depths)
    random = torch.Generator().manual_seed(0)
    noise = SMALL.noise * torch.randn(24, 1, 128, 128, generator=random, dtype=torch.float64)
    many = PICTURES.repeat(3, 1, 1)
    for G in (depth_invariant_wiener(H, S, SMALL.noise), wiener(H[1], 0.01)):
        expected = errors(H, S, SMALL.noise, filter=G)[:, 0]
        images = [camera.image(many[:, None], [depth]) + noise for depth in SMALL.depths]
        result = [(restore(image, G) - many[:, None]).square().mean() for image in images]
        torch.testing.assert_close(torch.stack(result), expected, rtol=0.01, atol=0)
    own = quality(camera, SMALL.depths, design=1000.0, train=PICTURES, test=PICTURES)
    predicted = psnr(errors(H, S, SMALL.noise).mean(1))
    np.testing.assert_allclose(own.by_depth["blind"], predicted.numpy(), atol=0.1)
    assert own.spread["blind"] == pytest.approx(max(own.by_depth["blind"]) - min(own.by_depth["blind"]))


def test_the_best_gamma_is_no_worse_than_its_neighbours():
    """For the kernel at 0.5 m, whose zeros must not be inverted."""
    H = transfer(SMALL.camera(baseline("singlet", aim())), 128, SMALL.depths)
    best = best_gamma(H, S, SMALL.noise, H[0])

    def error(gamma):
        return float(errors(H, S, SMALL.noise, filter=wiener(H[0], gamma)).mean())

    assert error(best) < min(error(0.8 * best), error(1.25 * best))


def error_of(elements):
    return depth_invariant_error(transfer(SMALL.camera(elements), 128, SMALL.depths), S, SMALL.noise).mean()


def test_learning_gains_two_decibels_over_the_lens_it_begins_with():
    """Thirty evaluations of the closed form, one colour (sharp lens at 1 m to extended depth of field)."""
    lens = baseline("singlet", aim())[0]
    powers = lens.profile.coefficients.new_zeros(5)
    powers[:1] = lens.profile.coefficients
    smooth = Element(EvenPowers(powers), lens.radius, lens.glass)
    before, watched = error_of([smooth]), []
    design = Design(dataclasses.replace(QUICK, starts=2, spread=0.3, start_steps=30), SMALL, S)
    best = design.best_of_starts(
        lambda: PhaseVariables(smooth, basis=radial_powers(smooth.radius, 5)),
        watch=lambda *report: watched.append(report),
    )
    after = error_of(best())
    assert float(psnr(after.detach()) - psnr(before.detach())) > 2
    for start in (1, 2):
        evaluations = [evaluation for number, evaluation, _ in watched if number == start]
        assert evaluations == [*range(1, len(evaluations) + 1)]
    assert min(error for *_, error in watched) == pytest.approx(float(after.detach()), rel=1e-6)  # of another sampling


@pytest.mark.parametrize(
    "change",
    [
        {},
        pytest.param(
            {"loss": "images", "restoration": "towards", "optimizer": "sgd", "rate": 0.5}, marks=pytest.mark.slow
        ),
        {"kind": "rings", "pitch": 0.02, "tolerance": 3e-5},
    ],
    ids=["smooth", "pictures", "tolerance"],
)
def test_a_run_that_is_broken_off_ends_as_if_it_had_not_been(tmp_path, change):
    settings = dataclasses.replace(QUICK, **change)
    ends = []
    for name, stop in (("whole", None), ("broken", 7)):
        for _ in range(1 if stop is None else 2):
            design = Design(settings, SMALL, S)
            camera, run = design.begin(tmp_path / name, pictures=OF_LEAVES)
            for step, _record in design.learn(camera, LEAVES, run, every=5):
                if step == stop:
                    stop = None
                    break
        ends.append([p.detach().clone() for p in camera.parameters()])
        assert [row["step"] for row in run.rows()] == list(range(settings.steps))
    assert all(torch.equal(a, b) for a, b in zip(*ends, strict=True))
    with pytest.raises(OtherSettings, match="rate was"):
        Design(dataclasses.replace(settings, rate=0.01), SMALL, S).begin(tmp_path / "whole", pictures=OF_LEAVES)


def test_a_run_is_that_of_its_pictures(tmp_path):
    """As many others are refused, whether it has finished or not."""
    settings, others = dataclasses.replace(QUICK, steps=1), dead_leaves(8, size=64, seed=6, smallest=2.5)
    _, initial, _ = learn(settings, SMALL, LEAVES, tmp_path, "finished")
    _, before, after = learn(settings, SMALL, LEAVES, tmp_path, "finished")
    assert torch.equal(before.elements()[0].numbers, initial.elements()[0].numbers)
    assert not torch.equal(after.elements()[0].numbers, initial.elements()[0].numbers)
    for _ in range(2):
        with pytest.raises(OtherSettings, match=f"pictures was '8, blake2 .*, now '{digest(others.samples)}'"):
            learn(settings, SMALL, others, tmp_path, "others")
        (tmp_path / "checkpoint.pt").unlink(missing_ok=True)
    learn(settings, SMALL, LEAVES, tmp_path, "begun")


@pytest.mark.slow
def test_pictures_teach_the_filter_of_the_original(tmp_path):
    """Weight and target depth move with the heights, and the loss of the same draws falls."""
    settings = dataclasses.replace(QUICK, loss="images", restoration="towards", steps=25, batch=4)
    design = Design(settings, SMALL, S)
    camera, run = design.begin(tmp_path / "run", pictures=OF_LEAVES)
    filter = camera.filter
    first = [float(filter.v), float(filter.t), camera.variables.change.detach().clone()]
    losses = [record["loss"] for _, record in design.learn(camera, LEAVES, run)]
    assert float(filter.v) != first[0]
    assert float(filter.t) != first[1]
    assert not torch.equal(camera.variables.change, first[2])
    assert np.mean(losses[-8:]) < np.mean(losses[:8])


@pytest.mark.slow
def test_a_network_learns_behind_the_filter(tmp_path):
    """It begins as nothing at all, and both it and the element move."""
    settings = dataclasses.replace(QUICK, loss="images", restoration="network", steps=4, batch=2)
    design = Design(settings, SMALL, S)
    camera, run = design.begin(tmp_path / "run", pictures=OF_LEAVES)
    with torch.no_grad():
        both = camera(PICTURES[:2], [500.0, math.inf], index=[0, 1])
        alone, network = SMALL.camera(camera.variables, filter=camera.filter), camera.network
        alone.plan(SMALL.depths)
        torch.testing.assert_close(both, alone(PICTURES[:2], [500.0, math.inf], index=[0, 1]), atol=1e-6, rtol=0)
    before = [p.detach().clone() for p in (network.decoder[-1].weight, camera.variables.change)]
    for _ in design.learn(camera, LEAVES, run):
        pass
    for old, new in zip(before, (network.decoder[-1].weight, camera.variables.change), strict=True):
        assert not torch.equal(old, new)


@pytest.mark.parametrize(("kind", "levels"), [("rings", 0), ("rings", 16), ("zernike", 0)])
def test_every_kind_of_element_is_learned(tmp_path, kind, levels):
    settings = dataclasses.replace(
        QUICK, kind=kind, levels=levels, terms=11 if kind == "zernike" else 4, pitch=0.02, steps=6, spread=0.05
    )
    design = Design(settings, SMALL, S)
    camera, run = design.begin(tmp_path / "run", pictures=OF_LEAVES)
    before = design.expected_error(camera)
    for _ in design.learn(camera, LEAVES, run):
        pass
    after = design.expected_error(camera)
    assert after < before
    (element, *_) = camera.variables()
    if levels:
        heights = torch.unique(torch.round(made_heights(element) / (float(element.period) / levels)).long())
        assert len(heights) <= levels


def made_heights(element):
    r = (torch.arange(len(element.profile.heights), dtype=torch.float64) + 0.5) * element.profile.pitch
    return height(element, r, torch.zeros_like(r)).detach()


def test_schedules_are_functions_of_the_step():
    assert SCHEDULES["cosine"](0) == 1
    assert SCHEDULES["cosine"](1) == pytest.approx(0)
    assert SCHEDULES["linear"](0.25) == 0.75
    assert SCHEDULES["constant"](0.9) == 1


def test_powers_are_zernike_polynomials():
    r = torch.linspace(0, 2.5, 9, dtype=torch.float64)
    powers = radial_powers(torch.tensor(2.5, dtype=torch.float64), 6)
    orders = [(2 * k, 0) for k in range(1, 7)]
    values = polynomials(orders, r / 2.5, torch.zeros_like(r))
    constant = polynomials(orders, torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    series = (r[:, None] ** (2 * torch.arange(1, 7))) @ powers
    torch.testing.assert_close(series, (values - constant).T, atol=1e-10, rtol=0)


def test_heights_err_within_their_tolerance():
    lens = baseline("fresnel", aim(), pitch=0.05)[0]
    variables = PhaseVariables(lens, tolerance=2e-5)
    draw = torch.Generator().manual_seed(1)
    error = variables(draw=draw)[0].profile.heights - variables()[0].profile.heights
    assert float(error.abs().max()) <= 2e-5
    assert float(error.std()) == pytest.approx(2e-5 / math.sqrt(3), rel=0.2)
    with pytest.raises(ValueError, match="a basis of"):
        PhaseVariables(lens, basis=torch.zeros(3, 2, dtype=torch.float64))


def test_errors_of_height_are_those_of_one_draw():
    """By the kernels, and by an octant of the frequencies, to the precision of rings."""
    lens = baseline("fresnel", aim(), pitch=0.05)[0]
    camera = SMALL.camera(PhaseVariables(lens, tolerance=1e-4))
    made = SMALL.camera(camera.elements(draw=torch.Generator().manual_seed(1)))
    wanted = camera_error(made, S, SMALL.depths)
    for tolerance in (1e-12, 1e-5):
        error = camera_error(camera, S, SMALL.depths, draw=torch.Generator().manual_seed(1))
        torch.testing.assert_close(error, wanted, rtol=tolerance, atol=0)
        camera.plan(SMALL.depths)


def test_errors_of_height_are_drawn_anew_at_every_step(tmp_path):
    """By the seed and the number of the step: the heights do not move, and the loss is another each time."""
    still = dataclasses.replace(QUICK, kind="rings", pitch=0.02, starts=0, steps=4, rate=1e-12, tolerance=1e-4)
    losses = {}
    for name, change in {"off": {"tolerance": 0.0}, "on": {}, "again": {}, "seed": {"seed": 1}}.items():
        settings = dataclasses.replace(still, **change)
        design = Design(settings, SMALL, S)
        camera, run = design.begin(tmp_path / name, pictures=OF_LEAVES)
        losses[name] = [record["loss"] for _, record in design.learn(camera, LEAVES, run)]
    assert np.ptp(losses["off"]) < 1e-9 * losses["off"][0]
    assert len(set(losses["on"])) == 4
    assert losses["again"] == losses["on"]
    assert not set(losses["seed"]) & set(losses["on"])
    with pytest.raises(ValueError, match="belongs to rings"):
        Design(dataclasses.replace(QUICK, tolerance=1e-4), SMALL, S).begin(tmp_path / "smooth", pictures=OF_LEAVES)


def test_mirrored():
    result = mirrored(np.array([[1, 2], [3, 4]]))
    assert result.tolist() == [[1, 2, 2, 1], [3, 4, 4, 3], [3, 4, 4, 3], [1, 2, 2, 1]]


def test_the_table_lists_known_values():
    content = Content("leaves", PICTURES[:6], PICTURES[6:])
    result = table_of([content], elements_of(["singlet", "fresnel"], SMALL, S, learned={}), SMALL)
    assert list(result["leaves"]) == ["fresnel", "singlet"]
    rows = {record["row"]: record for record in records(result)}
    assert rows["fresnel"]["gain_blind"] == 0
    assert rows["fresnel"]["published"] == 17.95
    assert rows["singlet"]["gain_blind"] == pytest.approx(rows["singlet"]["blind"] - rows["fresnel"]["blind"])


@pytest.mark.slow
def test_the_strength_of_cubic_plates_is_searched_once(monkeypatch):
    """Both plates have the one that is best on the PMMA lens; rows that are not learned yet are left out."""
    tried = []
    real = edof_table.camera_error
    monkeypatch.setattr(edof_table, "camera_error", lambda *given: tried.append(0) or real(*given))
    result = elements_of(["cubic-refractive", "learned", "cubic"], SMALL, S, learned={})
    assert list(result) == ["cubic", "cubic-refractive"]
    assert len(tried) == len(STRENGTHS)
    plates = [elements[1].profile.coefficients * (index(elements[1].glass, 0.55) - 1) for elements in result.values()]
    torch.testing.assert_close(*plates)


@pytest.mark.slow
def test_the_order_that_was_published(tmp_path):
    """Fresnel < multifocal < cubic < hybrid, achromat < learned, in three colours (facts: only those two may swap)."""
    config = WaveCameraConfig(size=127, pixel=0.00738)
    pictures = periodic(dead_leaves(12, size=128, seed=1, smallest=2.5), 256)
    content = Content("leaves", pictures[:8], pictures[8:])
    spectrum_ = power_spectrum(content.train, window="none")
    settings = DesignSettings(steps=60, starts=2)
    design = Design(settings, config, spectrum_)
    camera, run = design.begin(tmp_path / "run", pictures=OF_LEAVES)
    for _ in design.learn(camera, LEAVES, run):
        pass
    with torch.no_grad():
        learned = {"learned": camera.elements()}
    names = ["fresnel", "multifocal", "cubic", "hybrid", "achromat", "learned"]
    result = table_of([content], elements_of(names, config, spectrum_, learned=learned), config)["leaves"]
    blind = {name: result[name].mean["blind"] for name in names}
    assert blind["fresnel"] < blind["multifocal"] < blind["cubic"] < min(blind["hybrid"], blind["achromat"])
    assert max(blind["hybrid"], blind["achromat"]) + 2 < blind["learned"]

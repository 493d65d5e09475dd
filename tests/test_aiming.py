"""Ray aiming: rays fill the stop behind a folded axis, and a beam that misses the stop is reported."""

import math
import warnings

import pytest
import torch
from problems import fisheye, vector

import raytrace as rt
from raytrace.cli import build_parser
from raytrace.cli.commands import COMMANDS
from raytrace.io import FORMATS
from raytrace.io.source import Place, decode
from raytrace.system.lens import aligned
from raytrace.tracing import aiming, trace
from raytrace.tracing.launch import TOLERANCE, UnfilledStop, filling, launch, rays_of_field, warn_of_filling
from raytrace.tracing.trace import aiming_of, at_stop, trace_lens

RIM = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)


def pose(**numbers):
    return rt.system.Pose(**numbers)


def off_axis_parabola(**how):
    """The stop 50 mm off the axis of the mirror, in the plane of its focus."""
    return rt.lens(
        [
            dict(radius=math.inf, thickness=100, before=pose(y=50.0), after=pose(y=-50.0)),
            dict(radius=-200, conic=-1, thickness=-100, glass="MIRROR"),
        ],
        stop=1, entrance_pupil_diameter=20, fields=[0.3], **how,
    )  # fmt: skip


def test_every_verb_traces_the_beam_that_fills_a_decentred_stop():
    lens, real = off_axis_parabola(), off_axis_parabola(ray_aiming="real")
    assert lens.ray_aiming == "auto"
    assert torch.equal(launch(lens, RIM).position, launch(real, RIM).position)
    # 24.6 µm of coma and astigmatism; the beam about the axis of the mirror has 1.08 µm.
    assert float(rt.spot(lens).rms_radius) == pytest.approx(0.0245941, abs=1e-6)
    assert float(rt.spot(lens.at(ray_aiming="off")).rms_radius) == pytest.approx(0.0010765, abs=1e-6)
    for function in (rt.wavefront, rt.ray_fan):
        assert str(function(lens)) == str(function(real)), function
    assert "auto: real" in str(rt.info(lens))


@pytest.mark.parametrize(
    ("rows", "stop", "aiming"),
    [
        ([dict(thickness=5.0), dict(radius=50, thickness=50)], 1, "off"),
        ([dict(thickness=5.0, before=pose(tilt_x=3.0)), dict(radius=50, thickness=50)], 1, "real"),
        ([dict(radius=50, thickness=5, before=pose(y=1.0)), dict(thickness=50)], 2, "real"),
        ([dict(thickness=5.0, phase=rt.system.Grating(0.1, 1.0)), dict(thickness=50)], 2, "real"),
        ([dict(thickness=5.0), dict(thickness=50, before=pose(tilt_x=3.0))], 1, "off"),
    ],
    ids=["straight", "tilted stop", "decentred lens", "grating", "bent behind the stop"],
)
def test_rays_are_aimed_where_the_axis_bends_in_front_of_the_stop(rows, stop, aiming):
    lens = rt.lens(rows, stop=stop, entrance_pupil_diameter=2)
    assert aiming_of(lens) == aiming
    for mode in ("off", "paraxial", "real"):
        assert aiming_of(lens.at(ray_aiming=mode)) == mode


def test_the_miss_of_the_stop_is_that_of_traced_rays():
    lens, fields = fisheye(), vector(0.0, 20.0, 40.0)
    fields = torch.stack([0 * fields, fields])
    found = filling(lens, fields)
    aimed, plain = (launch(lens, RIM, fields=fields, ray_aiming=mode) for mode in ("real", "off"))
    (ought, _), (at, _) = (at_stop(lens, rays, lens.primary) for rays in (aimed, plain))
    missed = (at - ought).norm(dim=0)[:, 0] / found.radius
    assert found.radius == pytest.approx(float(ought[1, 0, 0, 1].abs()), rel=1e-9)
    assert torch.allclose(found.chief, missed[:, 0], atol=1e-9)
    assert (found.marginal >= missed[:, 1:].amax(1) - 1e-9).all()
    assert found.chief[0] < 1e-12 < TOLERANCE < found.chief[2]


@pytest.mark.parametrize("angle", [60.0, 80.0, 88.0, 89.5])
def test_rays_of_wide_angle_lenses_are_aimed(angle):
    """A meniscus that takes in nearly half of space, the stop close behind it."""
    rows = [dict(radius=20, thickness=0.8, glass=1.75), dict(radius=3, thickness=2.5), dict(thickness=8)]
    lens = rt.lens(rows, stop=3, entrance_pupil_diameter=0.4, fields=[angle], wavelengths=[0.55], ray_aiming="real")
    points = torch.cat([torch.zeros(2, 1, dtype=torch.float64), RIM, -RIM], 1)
    rays = launch(lens, points)
    (position, _), arrives = at_stop(lens, rays, lens.primary), rays.valid
    assert arrives.all()
    radius = filling(lens, torch.zeros(2, 1, dtype=torch.float64)).radius
    assert torch.allclose(position[:2].reshape(2, -1) / radius, points, atol=1e-9)


def test_a_beam_that_misses_the_stop_is_reported_once_with_figures_and_a_remedy(capsys):
    lens = fisheye()
    with pytest.warns(UnfilledStop, match=r"field 40 degrees: rays miss the stop, .* chief ray by .* % of it from the "
                      r"centre, marginal rays by .* \(1 of 2 fields .*`ray_aiming=real`") as warned:  # fmt: skip
        rt.spot(lens, fields=[0, 40])
    assert len(warned) == 1
    for function in (rt.layout, rt.ray_fan, rt.wavefront, rt.mtf, rt.psf, rt.trace, rt.focus, rt.relative_illumination):
        with pytest.warns(UnfilledStop, match="field 40 degrees"):
            function(lens, fields=[40])
    curvature = lens.surfaces[1].curvature.clone().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfilledStop)
        rt.spot(lens.at(ray_aiming="real"), fields=[0, 40])
        rt.spot(lens, fields=[0, 40], ray_aiming="paraxial")
        rt.spot(lens, fields=[0, 1])
        rt.spot(lens.replace(1, curvature=curvature), fields=[0, 40])  # as in a loop of optimisation
        rt.psf(lens, rt.psf_models.Gaussian(order=3), fields=[40])
        torch.func.vmap(lambda y: (warn_of_filling(lens, torch.stack([0 * y, y])[:, None]), y)[1])(vector(30.0, 40.0))
    from raytrace.cli import main

    assert main(["spot", "retrofocus", "--ray-aiming", "off"]) == 0
    messages = [line for line in capsys.readouterr().err.splitlines() if "miss the stop" in line]
    assert len(messages) == 1
    assert "--ray-aiming real aims them" in messages[0]


#: Commands that trace no rays of a lens whose aiming may be chosen.
WITHOUT = {"lenses", "check", "convert", "edit", "mcp", "glass", "glasses", "bench", "stock", "wave"}


@pytest.mark.parametrize("command", [command.name for command in COMMANDS])
def test_every_command_that_traces_takes_ray_aiming(command):
    parser = next(a for a in build_parser()._actions if a.dest == "command").choices[command]
    names = {option for action in parser._actions for option in action.option_strings}
    assert ("--ray-aiming" in names) == (command not in WITHOUT), command


def test_the_option_sets_the_lens(capsys):
    from raytrace.cli import main

    texts = []
    for words in ([], ["--ray-aiming", "real"]):
        assert main(["spot", "double_gauss", *words]) == 0
        texts.append(capsys.readouterr().out.rstrip("\n"))
    lens = rt.read_lens("double_gauss")
    assert texts == [str(rt.spot(lens)), str(rt.spot(lens.at(ray_aiming="real")))]


SEQUENCE = "RDM;LEN\nDIM M\nEPD 50\nWL 587.6;YAN 0\nSO 0 1e14\nS 60 20 700.500\nS -200 20\nS 0 60\nSTO\nSI 0 0\nGO\n"


def test_the_entrance_pupil_of_a_sequence_is_that_of_the_real_beam_on_the_axis():
    def read(text):
        return FORMATS[".seq"].read(decode(text.encode(), Place("a.seq")), "a.seq")

    lens, report = read(SEQUENCE)
    assert lens.ray_aiming == "real"
    rim = launch(lens, RIM).position[:2, 0, 0]
    assert rim[1, 1].item() == pytest.approx(25.0, abs=1e-6)
    assert launch(lens, RIM, ray_aiming="paraxial").position[1, 0, 0, 1].item() > 25.1  # of the paraxial stop
    assert any("EPD holds on the axis" in note for note in report.notes)
    lens, report = read(SEQUENCE.replace("GO\n", "!raytrace aiming paraxial\nGO\n"))
    assert lens.ray_aiming == "paraxial"
    assert not any("aiming" in note for note in report.notes)


def test_check_reports_ray_aiming_and_primary_wavelength(tmp_path):
    straight = rt.lens(
        [dict(radius=50, thickness=50)], stop=1, f_number=9, wavelengths=[0.5, 0.6], primary_wavelength=2
    )
    for name in ("a.csv", "a.zmx"):
        rt.write_lens(straight, tmp_path / name)
        said = str(rt.check(tmp_path / name))
        assert "primary wavelength: number 2 of 2, 0.6 µm" in said
        assert "ray aiming: auto (real where the axis bends in front of the stop" in said
    rt.write_lens(off_axis_parabola(), tmp_path / "b.zmx")  # so that OpticStudio traces the same beam
    assert rt.read_lens(tmp_path / "b.zmx").ray_aiming == "real"


def test_derivatives_of_an_aimed_beam_are_finite_for_an_object_at_infinity():
    """A stop that is tilted: the vergence of the object was 1/(inf · length), whose derivative was nan."""
    tilt = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    lens = rt.lens(
        [dict(thickness=5.0, before=pose(tilt_x=tilt)), dict(radius=50, thickness=100, glass="MIRROR")],
        stop=1, entrance_pupil_diameter=2, fields=[1.0],
    )  # fmt: skip
    (slope,) = torch.autograd.grad(launch(lens, RIM).position.sum(), tilt)
    assert slope.isfinite()


@pytest.mark.parametrize(
    ("name", "aiming"),
    [
        ("double_gauss", "real"),
        ("folded_relay", "paraxial"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("double_gauss", "paraxial"), ("folded_relay", "real"))
        ),
    ],
)
def test_aimed_rays_of_a_batch_of_lenses_are_those_of_each(name, aiming):
    """Launch and trace inside `torch.func.vmap`, and derivatives of each lens."""
    lens = rt.read_lens(name).at(ray_aiming=aiming)
    pupil, bend = rt.maths.gauss_rings(2)[0], lens.surfaces[2].curvature

    def hits(change):
        variant = lens.replace(2, curvature=bend + change)
        return trace_lens(variant, launch(variant, pupil), variant.wavelengths[:, None]).position

    def energy(change):
        return hits(change).square().sum()

    changes = vector(0.0, 3e-5, -2e-5)
    batch = torch.func.vmap(hits)(changes)
    assert torch.allclose(batch, torch.stack([hits(change) for change in changes]), rtol=0, atol=1e-12)
    slopes = torch.func.vmap(torch.func.grad(energy))(changes)
    expected = [torch.autograd.functional.jacobian(energy, change) for change in changes]
    assert torch.allclose(slopes, torch.stack(expected), rtol=1e-12, atol=0)


def test_many_rays_of_one_pupil_are_aimed_as_few_are():
    """A vignetted field at 20° of a retrofocus lens, whose pupil is far from the paraxial one; and half of it."""
    lens = rt.read_lens("retrofocus").at(fields=[20.0])
    points, _ = rt.maths.gauss_rings(20, 64)
    for many in (points, points[:, points[0] > 0]):
        together = launch(lens, many)
        apart = [launch(lens, few) for few in many.split(200, 1)]
        for part in ("position", "direction", "opl"):
            assert torch.allclose(
                getattr(together, part), torch.cat([getattr(few, part) for few in apart], -1), 0, 1e-10
            )
        assert bool(together.valid.all())


def test_few_rays_of_many_are_differentiated_in_aiming(monkeypatch):
    counts, plain = [], aiming._error_and_jacobian
    monkeypatch.setattr(aiming, "_error_and_jacobian", lambda r, p, f: counts.append(p.shape[-1]) or plain(r, p, f))
    launch(rt.read_lens("retrofocus"), rt.maths.gauss_rings(20, 64)[0])
    assert max(counts) < 300


@pytest.mark.parametrize("kind", ["paraxial", "real"])
def test_points_of_the_pupil_may_have_fewer_axes_than_the_lens(kind):
    """Those of a field each, and a lens with an axis of object distances before that."""
    lens = aligned(rt.read_lens("cooke_triplet").at(ray_aiming=kind), 3)
    field, points = torch.tensor([[0.0, 0.0], [0.0, 8.0]], dtype=torch.float64), rt.maths.gauss_rings(2, 6)[0]
    each = points[:, None, None] * torch.tensor([1.0, 0.9], dtype=torch.float64)[:, None, None]
    many = lens.replace(0, thickness=torch.tensor([1e3, 2e3, 4e3], dtype=torch.float64).reshape(3, 1, 1, 1))
    found = rays_of_field(many, field[:, :, None, None], each, wavelength=lens.wavelengths[:, None])
    assert bool(found.valid.all())
    for k, distance in enumerate((1e3, 2e3, 4e3)):
        alone = lens.replace(0, thickness=torch.tensor(distance, dtype=torch.float64))
        rays = rays_of_field(alone, field[:, :, None, None], each, wavelength=lens.wavelengths[:, None])
        torch.testing.assert_close(found.position[:, k].expand_as(rays.position), rays.position, atol=1e-9, rtol=0)


def test_a_search_prepares_the_media_once(monkeypatch):
    counts, plain = [], trace.media
    monkeypatch.setattr(trace, "media", lambda lens, wavelength: counts.append(1) or plain(lens, wavelength))
    launch(rt.read_lens("double_gauss").at(ray_aiming="real"), rt.maths.hexapolar(2)[0])
    assert len(counts) == 2  # for the radius of the stop, and for the search

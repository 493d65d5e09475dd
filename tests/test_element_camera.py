"""Phase elements in pictures and cameras: at the stop of a lens, and alone in front of a sensor."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import double_gauss, scalar
from torch.func import functional_call

import raytrace as rt
from raytrace.imaging.closed_form import camera_error
from raytrace.imaging.field_kernels import ElementKernels, FieldKernels
from raytrace.imaging.image import blur, blur_layers, depth_masks
from raytrace.imaging.octant import octant_error
from raytrace.imaging.render import optics, patch_kernels, render_patches
from raytrace.system.lens import with_sensor_distance
from raytrace.wave_optics.hybrid import is_stop_alone, stop_alone

SENSOR = rt.Sensor(size=(0.6, 0.4), pixels=(60, 40))  # 10 µm
RGB = dataclasses.replace(SENSOR, response="rgb")
BARE = {"distortion": False, "illumination": False}


def slow_gauss():
    """A double Gauss at f/16.6, whose waves need few rays."""
    return with_sensor_distance(double_gauss(aperture=("entrance_pupil_diameter", 6.0)), scalar(57.475))


def smooth(*coefficients, aperture=24.0):
    """Height in mm of even powers of the radius in mm, of index 1.5."""
    return rt.wave_optics.phase_element([0.0, *coefficients], profile="powers", aperture=aperture, glass=1.5)


def light(*shape):
    """A picture of random light."""
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(7))


class Same(torch.nn.Module):
    """A network that restores nothing."""

    def forward(self, image):
        return image


# -- at the stop of a lens


def test_an_element_without_height_leaves_the_pictures_of_the_lens():
    lens, picture = slow_gauss(), light(1, 40, 60)
    how = {"nodes": (2, 2), "size": 9, "order": 0, **BARE}
    alone = optics(lens, SENSOR, model="wave", **how)
    with_element = optics(lens, SENSOR, elements=smooth(0.0), **how)
    assert float((alone.kernels - with_element.kernels).abs().sum((-2, -1)).max()) < 1e-6
    assert float((alone(picture) - with_element(picture)).abs().max()) < 1e-6


@pytest.mark.parametrize("profile", ["round", "tilted"])
def test_kernels_of_a_lens_with_an_element_are_those_of_hybrid_psf(profile):
    """At places of every octant; a kernel's columns grow towards -x of the sensor."""
    lens = slow_gauss()
    if profile == "round":
        element = smooth(2e-6)
    else:
        numbers = torch.tensor([0.0, 2e-4, 1e-4, 2e-4], dtype=torch.float64)
        element = rt.wave_optics.phase_element(numbers, profile="zernike", aperture=24.0, glass=1.5)
    points = torch.tensor([[0.0, 0.2, -0.2, 0.1], [0.0, 0.1, -0.1, -0.2]], dtype=torch.float64)
    found = patch_kernels(lens, points, sensor=SENSOR, size=11, order=0, elements=element)
    fields = SENSOR.fields(lens, points)
    wanted = rt.wave_optics.hybrid_psf(lens, element, fields=fields, pixel=0.01, size=11).kernel[0, :, 0].flip(-1)
    wanted = wanted / wanted.sum((-2, -1), keepdim=True)
    assert float((found[:, 0] - wanted).abs().sum((-2, -1)).max()) < 1e-6


def test_an_element_at_the_stop_moves_the_best_focus():
    """A thin lens of 1/f at the stop of an otherwise focused lens blurs as the sensor out of focus does, not less."""
    lens = slow_gauss()
    how = {"nodes": (1, 1), "size": 21, "order": 0, **BARE}
    sharp, blurred = (
        optics(lens, SENSOR, elements=smooth_power(power), **how).kernels[..., 10, 10] for power in (0.0, 2e-4)
    )
    assert float(blurred.max()) < 0.5 * float(sharp.max())


def smooth_power(power):
    """A thin lens of so many 1/mm, of index 1.5: h = -r² power/(2·0.5)."""
    return rt.wave_optics.phase_element([-power], profile="powers", aperture=24.0, glass=1.5)


@pytest.mark.parametrize("model", ["gaussian", "drt", "fourier"])
def test_a_model_of_rays_is_refused_with_elements(model):
    with pytest.raises(ValueError, match=f"'{model}' .*expected model 'wave'"):
        rt.render(slow_gauss(), light(1, 40, 60), sensor=SENSOR, elements=smooth(0.0), model=model)
    with pytest.raises(ValueError, match=f"model '{model}' with phase elements"):
        FieldKernels(slow_gauss(), SENSOR, model, 0, 9, torch.ones(1), torch.ones(1, 1), elements=(smooth(0.0),))


@pytest.mark.slow
def test_the_window_and_the_order_hold_the_light_of_the_element():
    lens, element = slow_gauss(), smooth_power(3e-3)
    chosen = optics(lens, SENSOR, elements=element, nodes=(1, 1), **BARE)
    plain = optics(lens, SENSOR, model="wave", nodes=(1, 1), **BARE)
    assert chosen.kernels.shape[-1] > plain.kernels.shape[-1]
    size, how = chosen.kernels.shape[-1], {"fields": [0.0], "pixel": 0.01, "order": chosen.order}
    inner, larger = (rt.wave_optics.hybrid_psf(lens, element, size=one, **how) for one in (size, 2 * size + 1))
    assert float(inner.kernel.sum() / larger.kernel.sum()) > 0.98


# -- alone


def singlet():
    return rt.wave_optics.phase_elements("singlet")


def test_kernels_of_an_element_alone_are_those_of_wave_psf():
    lens = stop_alone(singlet(), sensor_distance=35.5, wavelengths=(0.46, 0.55, 0.64))
    assert is_stop_alone(lens)
    assert lens.wavelengths.tolist() == [0.46, 0.55, 0.64]  # to the last digit
    assert not is_stop_alone(slow_gauss())
    points = torch.tensor([[0.0, 0.2], [0.0, -0.1]], dtype=torch.float64)
    depths = torch.tensor([500.0, 1000.0, math.inf], dtype=torch.float64)
    weights = RGB.weights(lens.wavelengths)
    kernels = ElementKernels(lens, singlet(), RGB, 15, depths, weights)
    psf = rt.wave_optics.wave_psf(singlet(), sensor=35.5, depths=depths.tolist(), pixel=0.01, size=15).kernel
    wanted = torch.einsum("cw,dwij->dcij", weights, psf).flip(-1)
    torch.testing.assert_close(kernels.share(kernels.light()), wanted.sum((-2, -1)))
    wanted = wanted / wanted.sum((-2, -1), keepdim=True)
    torch.testing.assert_close(kernels.at(points), wanted.expand(2, -1, -1, -1, -1), rtol=0, atol=1e-6)
    pairs = dataclasses.replace(kernels, object_distances=depths[[2, 0]]).paired(points)
    torch.testing.assert_close(pairs, wanted[[2, 0]], rtol=0, atol=1e-6)


@pytest.mark.parametrize("depth", [None, 1000.0])
def test_light_of_an_element_alone_is_kept(depth):
    """That beyond the window returns as haze: a white scene stays white."""
    white = torch.ones(3, 40, 60, dtype=torch.float64)
    depth = None if depth is None else torch.full((40, 60), depth)
    rendering = rt.render(singlet(), white, sensor=RGB, sensor_distance=35.5, depth=depth, size=9, illumination=False)
    assert float(rendering.optics.haze.max()) > 0.01
    torch.testing.assert_close(rendering.image, white, rtol=0, atol=1e-6)
    torch.testing.assert_close(rendering.optics.kernels.sum((-2, -1)), torch.ones(1, 1, 1, 3, dtype=torch.float64))


def test_layers_of_an_element_alone_are_those_of_blur_layers():
    picture, half = light(3, 40, 60), 7
    depth = torch.where(torch.arange(60) < 30, 500.0, 2000.0).double().expand(40, 60)
    how = {"sensor": RGB, "sensor_distance": 35.5, "size": 2 * half + 1, "illumination": False, "boundary": "zero"}
    rendering = rt.render(singlet(), picture, depth=depth, softness=0.1, **how)
    ready = rendering.optics
    step = float(ready.planes.diff())
    masks = depth_masks(1 / depth, ready.planes, softness=0.1 * step)
    dimmed = ready.kernels[0, 0] * (1 - ready.haze)[..., None, None]
    wanted = blur_layers(picture, masks, dimmed) + (ready.haze.mean(0) * picture.mean((-2, -1)))[:, None, None]
    inner = rendering.image[:, half:-half, half:-half]
    torch.testing.assert_close(inner, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensor_distance": 35.5}, "give sensor=rt.Sensor"),
        ({"sensor": SENSOR}, "sensor_distance=…"),
        ({"sensor": SENSOR, "sensor_distance": 35.5, "elements": smooth(0.0)}, "leave out elements"),
    ],
)
def test_missing_numbers_of_an_element_alone_are_one_clear_error(options, message):
    with pytest.raises(ValueError, match=message):
        rt.render(singlet(), light(1, 40, 60), **options)


def test_a_lens_has_its_own_sensor_distance():
    with pytest.raises(ValueError, match="applies to elements without a lens"):
        rt.render(slow_gauss(), light(1, 40, 60), sensor=SENSOR, sensor_distance=35.5)


# -- cameras


def hybrid_camera(**options):
    numbers = torch.tensor([0.0, 0.0, 0.0, 1e-4, 5e-5], dtype=torch.float64)
    element = rt.wave_optics.phase_element(numbers, profile="zernike", aperture=24.0, glass=1.5)
    return rt.Camera(
        rt.Variables(slow_gauss(), "sensor curvature:2"), Same(), element=rt.imaging.PhaseVariables(element),
        sensor=SENSOR, pixels=11, object_distances=(4e4, 1e5), **options,
    )  # fmt: skip


def element_camera(**options):
    powers = singlet()[0]
    basis = torch.eye(len(powers.numbers), dtype=torch.float64)[:, :1] / 6.25  # 1/R²
    variables = rt.imaging.PhaseVariables(powers, basis=basis)
    return rt.Camera(
        variables, Same(), sensor=RGB, sensor_distance=35.5, pixels=11, object_distances=(500.0, 2000.0), **options
    )


def periodic_camera(**options):
    """Of pictures of 24 × 24 pixels that are periods of endless ones, and the best filter for three depths."""
    spectrum = rt.imaging.power_spectrum(light(4, 24, 24), window="none")
    filter = rt.imaging.DepthInvariantFilter(spectrum, (500.0, 1000.0, math.inf))
    return element_camera(boundary="circular", normalise="haze", filter=filter, **options)


def test_pictures_of_a_periodic_camera_keep_their_light():
    camera, pictures = periodic_camera(), light(2, 3, 24, 24)
    image = camera.image(pictures, [500.0, 2000.0])
    assert image.shape == camera.target(pictures).shape == pictures.shape
    torch.testing.assert_close(image.mean((-2, -1)), pictures.mean((-2, -1)))
    kernels = camera.kernels([500.0, 2000.0])
    assert float(kernels.detach().sum((-2, -1)).max()) < 0.99
    H = camera.transfer(kernels, 24)
    torch.testing.assert_close(H[..., 0, 0].real, torch.ones(2, 3, dtype=torch.float64))
    torch.testing.assert_close(image, torch.fft.ifft2(torch.fft.fft2(pictures) * H).real)
    dimmed = element_camera(boundary="circular", normalise="energy").image(pictures, [500.0, 2000.0])
    torch.testing.assert_close(dimmed, blur(pictures, kernels, boundary="circular"))


@pytest.mark.parametrize("planned", [False, True])
def test_the_closed_form_of_an_element_is_the_error_of_its_filtered_pictures(planned):
    """With a sampling of each call, and with a fixed one."""
    camera, pictures = periodic_camera(), light(4, 24, 24)
    if planned:
        camera.plan(camera.filter.distances)
    camera.sensor = dataclasses.replace(RGB, read_noise=0.05, saturation=math.inf)
    expected = camera_error(camera, camera.filter.spectrum, camera.filter.distances)
    errors = []
    for depth in camera.filter.distances:
        for picture in pictures[:, None].expand(4, 3, 24, 24):
            many = camera.demosaiced(camera.image(picture[None], depth).expand(40, -1, -1, -1), index=range(40))
            errors.append((camera.restore(many) - picture).square().mean())
    assert torch.stack(errors).mean().item() == pytest.approx(expected.item(), rel=0.01)


@pytest.mark.parametrize("mirrored", [False, True])
def test_derivatives_of_the_closed_form_of_an_element(mirrored):
    """First and second order against differences, of the kernels and of the octant (pictures equal to their mirror
    images)."""
    camera = periodic_camera()
    camera.plan(camera.filter.distances)
    S = camera.filter.spectrum
    if mirrored:
        S = S + torch.roll(S.flip(-1), 1, -1)
        S = S + torch.roll(S.flip(-2), 1, -2)
    kernels = camera.element_kernels(camera.filter.distances)
    assert (octant_error(kernels, S, torch.tensor(0.05)) is None) != mirrored

    def error(change):
        return functional_call(camera, {"variables.change": change}, (S,))

    camera.forward = lambda spectrum: camera_error(camera, spectrum, camera.filter.distances)
    change = torch.tensor([0.7], dtype=torch.float64, requires_grad=True)
    gradcheck(error, change, eps=1e-5, rtol=1e-4)
    gradgradcheck(error, change, eps=1e-5, rtol=1e-4)


def loss_of(camera, channels):
    points = torch.tensor([[0.0, 0.15], [0.05, -0.1]], dtype=torch.float64)
    distances = torch.tensor(camera.range, dtype=torch.float64)
    picture = light(2, channels, 24, 24)
    return (camera(picture, distances, points=points, index=[0, 1]) - camera.target(picture)).square().mean()


@pytest.mark.parametrize(("made", "channels"), [(hybrid_camera, 1), (element_camera, 3)])
def test_derivatives_through_the_whole_camera_are_those_of_differences(made, channels):
    """By the heights, and by the numbers of the lens."""
    camera = made()
    camera.plan()
    loss_of(camera, channels).backward()
    parameters = [p for p in camera.parameters() if p.requires_grad]
    assert len(parameters) == (3 if made is hybrid_camera else 1)
    for parameter in parameters:
        found, step = parameter.grad.flatten(), 1e-6
        values = []
        for sign in (-1, 1):
            with torch.no_grad():
                parameter.view(-1)[-1] += sign * step
                values.append(loss_of(camera, channels).item())
                parameter.view(-1)[-1] -= sign * step
        wanted = (values[1] - values[0]) / (2 * step)
        assert abs(wanted) > 1e-5
        assert float(found[-1]) == pytest.approx(wanted, rel=1e-3)


def test_heights_have_a_rate_of_their_own():
    camera = hybrid_camera()
    groups = camera.rates(optics=1e-3, network=1e-4, element=1e-2)
    assert [group["lr"] for group in groups] == [1e-3, 1e-4, 1e-2]
    assert groups[2]["params"] == [camera.element.change]


def test_learned_heights_reduce_the_loss():
    camera = element_camera()
    optimizer = torch.optim.SGD(camera.variables.parameters(), 1.0)
    before = loss_of(camera, 3)
    before.backward()
    optimizer.step()
    assert loss_of(camera, 3).item() < before.item()


@pytest.mark.parametrize(
    ("made", "channels"),
    [pytest.param(hybrid_camera, 1, marks=pytest.mark.slow), (element_camera, 3)],
)
def test_cameras_render_whole_pictures_and_restore(made, channels):
    camera = made()
    rendering = camera.render(light(channels, 40, 60), **BARE)
    assert rendering.image.shape == (channels, 40, 60)
    assert rendering.image.requires_grad
    torch.testing.assert_close(camera.restore(rendering.image[None]), rendering.image[None])
    if made is element_camera:
        assert rendering.optics.kernels.shape[-1] == 11


def test_states_are_of_their_element():
    camera, other = element_camera(), rt.imaging.PhaseVariables(smooth(1e-6))
    state = camera.state_dict()
    element_camera().load_state_dict(state)
    with pytest.raises(ValueError, match="the state is of"):
        rt.Camera(other, Same(), sensor=RGB, sensor_distance=35.5, pixels=11).load_state_dict(state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"center": "centroid"}, "not supported with a phase element"),
        ({"normalise": "energy"}, "whose PSFs have sum 1: leave normalise out"),
        ({"normalise": "haze"}, "whose PSFs have sum 1: leave normalise out"),
        ({"exact": True}, "exact applies only to a phase element without a lens"),
        ({"boundary": "open"}, "boundary 'open': expected valid or circular"),
        ({"model": "gaussian"}, "model 'gaussian' with phase elements"),
        ({"sensor_distance": 35.5}, "a lens defines the sensor distance: leave sensor_distance out"),
        ({"wavelengths": (0.5,)}, "lens.at"),
    ],
)
def test_cameras_with_elements_refuse_what_they_do_not_simulate(options, message):
    how = {"element": rt.imaging.PhaseVariables(smooth(0.0)), "sensor": SENSOR, **options}
    with pytest.raises(ValueError, match=message):
        rt.Camera(rt.Variables(slow_gauss(), "sensor"), Same(), **how)


def test_patches_take_elements():
    points, patches = torch.zeros(2, 1, dtype=torch.float64), light(1, 1, 20, 20)
    how = {"sensor": SENSOR, "size": 9, "order": 0}
    wanted = render_patches(slow_gauss(), patches, points, model="wave", **how)
    torch.testing.assert_close(render_patches(slow_gauss(), patches, points, elements=smooth(0.0), **how), wanted)

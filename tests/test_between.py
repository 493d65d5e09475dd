"""Spots between the fields, wavelengths and rays of a merit function."""

import pytest
import torch

import raytrace as rt
from raytrace.optimization.between import Between, WorseBetween, between, worse_between

TRIPLET = rt.read_lens("cooke_triplet")


def by_samples(lens):
    return {gap.samples: gap for gap in between(lens)}


def test_the_spot_between_two_fields_is_that_of_the_field_halfway():
    lens = TRIPLET.at(fields=[0, 10])  # without the vignetting factors of the file
    gap = by_samples(lens)["fields"]
    radii = rt.spot(lens, fields=[0, 5, 10]).whole.rms_radius
    assert gap.place == "at 5°"
    assert gap.radius == pytest.approx(float(radii[1]), rel=1e-12)
    assert gap.nearest == pytest.approx(float(radii[[0, 2]].max()), rel=1e-12)


def test_the_spot_of_a_wavelength_between_counts_its_displacement():
    lens = TRIPLET.at(fields=[11.9], wavelengths=[0.45, 0.7])
    gap = by_samples(lens)["wavelengths"]
    each = rt.spot(lens, wavelengths=[float(lens.primary), 0.575]).arrivals
    about = rt.spot(lens).whole.centroid
    apart = (each.rays.position[:2, 0, 1] - about).square().sum(0)
    weight = each.weight[1]
    expected = (weight * apart).sum().div(weight.sum()).sqrt()
    assert "0.575 µm" in gap.place
    assert gap.radius == pytest.approx(float(expected), rel=1e-9)


def test_an_optimised_lens_says_where_its_spots_are_worse():
    lens = TRIPLET.at(fields=[0, 20])
    with pytest.warns(WorseBetween, match="between the fields, at 10°.*add fields"):
        result = rt.optimize(lens, merit="spot", vary="curvature thickness:2,4 sensor", cycles=20)
    radii = rt.spot(result.lens, fields=[0, 10, 20]).whole.rms_radius
    (gap,) = (gap for gap in result.between if gap.is_worse)
    assert gap.ratio == pytest.approx(float(radii[1] / radii[[0, 2]].max()), rel=1e-9)
    assert gap.ratio > 1.5
    assert str(gap) in str(result)
    assert result.document()["between"][0]["radius"] == gap.radius
    others = [gap for gap in result.between if not gap.is_worse]
    assert others
    assert f"{max(gap.ratio for gap in others if gap.samples == 'rays'):.3g} over the whole pupil" in str(result)


def test_a_lens_that_is_even_over_its_field_says_nothing():
    assert worse_between(TRIPLET) == ()


def test_every_configuration_is_looked_at():
    zoom = TRIPLET.at(fields=[0, 20]).with_configurations(thickness={4: [2.0, 3.0]})
    assert {gap.configuration for gap in between(zoom)} == {1, 2}


def test_spots_without_light_are_left_out():
    assert all(torch.isfinite(torch.tensor(gap.ratio)) for gap in between(TRIPLET.at(fields=[0, 60])))


def test_a_spot_of_no_size_is_not_worse():
    assert not Between("fields", "at 1°", 1e-9, 1e-13).is_worse

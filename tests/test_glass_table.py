"""Glass from a table of indices."""

import pytest
import torch
from differences import gradcheck

from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import from_table, index

LINES = torch.tensor([0.4358, 0.4861, 0.5461, 0.5876, 0.6563, 0.7065, 0.8521], dtype=torch.float64)


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_a_few_indices_are_met_exactly(count):
    n = index(find_glass("PMMA"), LINES[:count])
    torch.testing.assert_close(index(from_table(LINES[:count], n), LINES[:count]), n, rtol=1e-11, atol=0)


def test_between_them_it_is_a_glass():
    """Three lines of fused silica foretell those between to 2e-5, six to 1e-7."""
    silica = find_glass("F_SILICA")
    between = torch.linspace(0.46, 0.64, 19, dtype=torch.float64)
    three = torch.tensor([0.46, 0.55, 0.64], dtype=torch.float64)
    for lines, error in ((three, 2e-5), (LINES[:6], 1e-7)):
        found = index(from_table(lines, index(silica, lines)), between)
        torch.testing.assert_close(found, index(silica, between), rtol=0, atol=error)


def test_more_indices_than_terms_are_fitted():
    n = index(find_glass("N-BK7"), LINES)
    torch.testing.assert_close(index(from_table(LINES, n), LINES), n, rtol=1e-7, atol=0)


def test_indices_have_derivatives():
    n = torch.tensor([1.499, 1.493, 1.488], dtype=torch.float64, requires_grad=True)
    at = torch.tensor([0.46, 0.5, 0.64], dtype=torch.float64)
    assert gradcheck(lambda n: index(from_table([0.46, 0.55, 0.64], n), at), (n,))


@pytest.mark.parametrize(
    ("wavelengths", "indices", "message"),
    [
        ([0.46, 0.55], [1.5], "1 indices at 2 wavelengths"),
        ([0.46, 0.46], [1.5, 1.5], "occurs twice"),
        ([0.46, 0.0], [1.5, 1.5], "expected finite, positive"),
        ([], [], "0 indices"),
    ],
)
def test_malformed_tables_are_refused(wavelengths, indices, message):
    with pytest.raises(ValueError, match=message):
        from_table(wavelengths, indices)

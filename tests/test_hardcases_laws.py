"""Laws of a batch on systems of which no hard case asks them."""

import pytest
from hardcases_property import LAWS
from hardcases_scene import ORACLE, load_cases

SYSTEMS = {case["id"]: case for case in load_cases(ORACLE)}


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        pytest.param(name, engine, marks=pytest.mark.slow if engine == "eager" and name != "F17-d2-mixed" else ())
        for name in ("F16-d0-phone", "F17-d2-mixed", "F07-d4-e=0", "F20-d9-lens-field=0")
        for engine in ("eager", "compiled")
    ],
    indirect=["engine"],
)
@pytest.mark.parametrize("law", [law for law in LAWS if law not in ("reverse", "gradcheck")])
def test_law_on_the_other_systems(law, name, engine):
    """All but the two that hold only where every ray arrives, on every system that a property case names."""
    LAWS[law](SYSTEMS[name])

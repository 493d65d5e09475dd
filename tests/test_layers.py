"""The floors of the package: a file imports only files on lower floors, and nothing inside functions."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "raytrace"

#: Floor of every file of the package, by module name without "raytrace."; __init__ of a folder bears the folder's name.
FLOORS = {
    # below all: memory
    "budget": -1,
    # 0: mathematics, knows no optics
    "value": 0,
    "numerics": -1,  # what the others compute with
    "dispersion": 0,
    "shards": 0,
    "pupil": 0,
    "zernike": 0,
    "files": 0,
    "arrays": 0,
    "pictures": 1,
    # 1: the nouns
    "image": 1,
    "grid": 1,
    "glass": 1,
    "rays": 1,
    "asphere": 1,
    "roots": 1,
    "departure": 1,
    # 2
    "agf": 2,
    "glass_table": 2,
    "deconvolve": 2,
    "superresolution": 2,
    "surface": 2,
    # 3
    "catalog": 3,
    "lens": 3,
    # 4: verbs
    "trace": 4,
    # 5
    "paraxial": 5,
    "jacobian": 5,
    "aiming": 5,
    "vignetting": 5,
    # 6
    "launch": 6,
    "spot": 6,
    # 7
    "focus": 7,
    "losses": 7,
    "reuse": 7,
    # 8
    "f_number": 8,
    "scene": 8,
    "streaming": 8,
    # 9
    "wavefront": 9,
    "stream_gradient": 9,
    # lens files: a family of its own between the lens and the plots
    "formats.source": 4,
    "formats.zemax_keywords": 4,
    "formats.report": 5,
    "formats.finite": 5,
    "formats.media": 6,
    "formats.writing": 6,
    "formats.table_columns": 6,
    "formats.texts": 4,
    "formats.zemax_records": 6,
    "formats.table_system": 7,
    "formats.zemax_system": 7,
    "formats.table_text": 8,
    "formats.table_media": 8,
    "formats.table_rows": 9,
    "formats.zemax_surface": 8,
    "formats.table_surface": 9,
    "formats.table": 10,
    "formats.zemax": 10,
    "formats.table_write": 10,
    "formats.zemax_write": 10,
    "formats.frame": 11,
    "formats": 12,
    # a command's modules are loaded when it runs
    "__init__": 17,
    "__main__": 17,
}

#: Folders that stand on one floor as a whole; inside them imports only have to run one way (no cycle).
FAMILIES = {"fused": 3, "psf": 10, "analysis": 11, "wave": 12, "design": 13, "plot": 14, "bench": 15, "cli": 16}

#: What only these files may import.
RESERVED = {
    "matplotlib": ("plot",),
    "pandas": ("formats.frame", "analysis.frame", "cli", "bench"),
    "tqdm": ("cli", "bench"),
    "optiland": ("bench",),
}


def modules() -> dict[str, Path]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)
        found[name] = path
    return found


MODULES = modules()


def floor(name: str) -> int:
    """The floor of a module, by name or by the family it belongs to."""
    found = FLOORS.get(name, FAMILIES.get(name.split(".")[0]))
    if found is None:
        pytest.fail(f"raytrace/{name.replace('.', '/')}.py stands on no floor: add it to FLOORS in {__file__}")
    return found


def family(name: str) -> str | None:
    first = name.split(".")[0]
    return first if first in FAMILIES else None


def imported(node: ast.AST) -> list[str]:
    """Names of the modules that an import statement loads; those of the package without "raytrace."."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        if node.level:
            return ["<relative>"]
        inside = [f"{node.module}.{alias.name}" for alias in node.names]
        known = [name for name in inside if name.removeprefix("raytrace.") in MODULES]
        names = known if len(known) == len(inside) else [node.module, *known]
    else:
        return []
    return [name.removeprefix("raytrace.") if name.startswith("raytrace.") else name for name in names]


def imports(path: Path) -> list[str]:
    return [name for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) for name in imported(node)]


def folder_of(name: str) -> str | None:
    """The folder whose __init__ runs before the module does."""
    folder = name.rpartition(".")[0]
    return folder if folder in MODULES else None


@pytest.mark.parametrize("name", MODULES)
def test_imports_only_from_lower_floors(name):
    for other in imports(MODULES[name]):
        assert other != "<relative>", "relative imports hide the floor: write from raytrace.x import y"
        if other in MODULES and other != name and not (family(name) and family(name) == family(other)):
            assert floor(other) < floor(name), f"{name} (floor {floor(name)}) imports {other} (floor {floor(other)})"


@pytest.mark.parametrize("name", MODULES)
def test_folders_of_imports_stand_on_lower_floors(name):
    """Importing psf.scene first runs psf/__init__.py with all it imports: below that, it would go round in a circle."""
    for other in imports(MODULES[name]):
        folder = folder_of(other) if other in MODULES else None
        if folder and folder != name and not name.startswith(f"{folder}."):
            assert floor(folder) < floor(name), f"{name} ({floor(name)}) imports {other}, and with it all of {folder}"


@pytest.mark.parametrize("folder", FAMILIES)
def test_imports_inside_a_folder_run_one_way(folder):
    members = {name: [o for o in imports(path) if family(o) == folder and o != name] for name, path in MODULES.items()}
    remaining = {name: others for name, others in members.items() if family(name) == folder}
    while remaining:
        free = [name for name, others in remaining.items() if not any(other in remaining for other in others)]
        assert free, f"these import each other: {sorted(remaining)}"
        for name in free:
            del remaining[name]


@pytest.mark.parametrize("name", [name for name in MODULES if name.split(".")[0] != "cli"])
def test_imports_stand_at_the_top_of_the_file(name):
    """An import inside a function, a condition or a class hides a dependency; `cli` alone defers them, for speed."""
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    at_top = {id(node) for node in tree.body}
    hidden = [node.lineno for node in ast.walk(tree) if imported(node) and id(node) not in at_top]
    assert not hidden, f"{MODULES[name]}: imports on lines {hidden}"


@pytest.mark.parametrize("library", RESERVED)
def test_library_is_imported_only_where_it_belongs(library):
    allowed = RESERVED[library]
    for name, path in MODULES.items():
        if not any(name == home or name.startswith(f"{home}.") for home in allowed):
            assert library not in {other.split(".")[0] for other in imports(path)}, name


def test_every_entry_of_the_table_of_floors_is_a_number_and_no_module_is_unnamed():
    for name in MODULES:
        assert isinstance(floor(name), int)


@pytest.mark.parametrize("library", ["matplotlib", "pandas", "scipy", "tqdm"])
def test_importing_the_package_loads_no(library):
    code = f"import raytrace, sys; sys.exit({library!r} in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, timeout=120)
    assert done.returncode == 0, f"import raytrace loads {library}"


#: What may not stand in a physics file, and why (docstrings and comments are not code and are not read).
FORBIDDEN_CALLS = {"item": "synchronises with the host", "numpy": "leaves the graph", "set_default_dtype": "global"}
PHYSICS = [
    "numerics",
    "roots",
    "surface",
    "asphere",
    "trace",
    "paraxial",
    "aiming",
    "launch",
    "spot",
    "focus",
    "f_number",
    "wavefront",
]


@pytest.mark.parametrize("name", PHYSICS)
def test_physics_stays_in_torch(name):
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            called = node.func.attr
            assert called not in FORBIDDEN_CALLS, f"{name}:{node.lineno}: .{called}() {FORBIDDEN_CALLS.get(called)}"
    assert not {"math", "numpy"} & {other.split(".")[0] for other in imports(MODULES[name])}


@pytest.mark.parametrize("name", MODULES)
def test_file_is_short(name):
    lines = len(MODULES[name].read_text(encoding="utf-8").splitlines())
    assert lines <= 400, f"{name}: {lines} lines; a file of more than 400 holds more than one noun or verb"

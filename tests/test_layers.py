"""The floors of the package: a file imports only files on lower floors, and nothing inside functions."""

import ast
import functools
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from layers import FLOORS, MODULES, PACKAGE, package_of, parsed, statements

#: Commands, whose imports may wait until they run.
COMMANDS = re.compile(r"cli(\.|$)")

#: The value of a lower layer is shown by a higher one, a lens at another temperature has edges where rays reach, and a
#: lens stores conditions and tolerances: the only imports against the layers, inside methods.
SHOWN_BY = {
    "system.lens": (
        *("tracing.lens_report", "tracing.geometry", "tracing.paraxial", "analysis.layout"),
        *("optimization.conditions", "tolerancing.files"),
    ),
    "tracing.lens_report": ("optimization.attained",),
    "psf_models.result": ("psf_models.figures", "psf_models.cross_section"),
    "optimization.optimized": ("optimization.optimized_figure",),
}

#: Libraries that are imported when they are first needed, inside functions.
DEFERRED = (
    "matplotlib",
    "mpl_toolkits",
    "pandas",
    "anywidget",
    "starlette",
    "uvicorn",
    "mcp",
    "mcp_types",
    "anyio",
    "colour",
    "ezdxf",
    "OCP",
)

#: Modules that alone may import a library at their top.
RESERVED = {
    "matplotlib": (r"bench\.result",),
    "pandas": (r"io\.frames", r"cli"),
    "tqdm": (r"cli", r"bench"),
}


def floor(name: str) -> int:
    """The layer of the package of a module."""
    if package_of(name) not in FLOORS:
        pytest.fail(f"raytrace/{package_of(name)} has no layer: add it to FLOORS in {__file__}")
    return FLOORS[package_of(name)]


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
    # The standard library's `io` is called `_io` here, so that it is not taken for the package's.
    return [
        name.removeprefix("raytrace.") if name.startswith("raytrace.") else re.sub(r"^io\b", "_io", name)
        for name in names
    ]


@functools.cache
def imports(path: Path, *, top: bool = False) -> list[str]:
    """Modules that a file imports, or imports at its top, without those that show its values."""
    names = [name for node in (parsed(path).body if top else statements(parsed(path))) for name in imported(node)]
    module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    return [name for name in names if name not in SHOWN_BY.get(module, ())]


def folder_of(name: str) -> str | None:
    """The folder whose __init__ runs before the module does."""
    folder = name.rpartition(".")[0]
    return folder if folder in MODULES else None


def modules_of(package: str) -> dict[str, Path]:
    return {name: path for name, path in MODULES.items() if package_of(name) == package}


@pytest.mark.parametrize("package", sorted({*map(package_of, MODULES)}))
def test_imports_only_from_lower_floors(package):
    for name, path in modules_of(package).items():
        for other in imports(path):
            assert other != "<relative>", f"{name}: relative imports hide the floor: write from raytrace.x import y"
            if other in MODULES and package_of(other) != package:
                assert floor(other) < floor(name), f"{name} (floor {floor(name)}) imports {other}, floor {floor(other)}"


@pytest.mark.parametrize("folder", sorted({package_of(name) for name in MODULES if "." in name}))
def test_imports_within_a_package_have_no_cycles(folder):
    inside = modules_of(folder)
    remaining = {
        name: [o for o in (*imports(path), *_folders(name, imports(path))) if o in inside and o != name]
        for name, path in inside.items()
    }
    while remaining:
        free = [name for name, others in remaining.items() if not any(other in remaining for other in others)]
        assert free, f"these import each other: {sorted(remaining)}"
        for name in free:
            del remaining[name]


def _folders(name: str, others: list[str]) -> list[str]:
    """Folders whose __init__ an import runs, except the folders of the module itself."""
    found = [folder_of(other) for other in others if other in MODULES]
    return [folder for folder in found if folder and not name.startswith(f"{folder}.")]


@pytest.mark.parametrize("package", sorted({package_of(name) for name in MODULES if not COMMANDS.match(name)}))
def test_imports_are_at_the_top_of_the_file(package):
    """An import inside a function, a condition or a class hides a dependency; commands alone defer them, for speed."""
    hidden = [
        f"{path}:{node.lineno}"
        for name, path in modules_of(package).items()
        if not COMMANDS.match(name)
        for at_top in parsed(path).body
        for node in statements(at_top)
        for other in imported(node)
        if other.split(".")[0] not in DEFERRED and other not in SHOWN_BY.get(name, ())
    ]
    assert not hidden, f"imports on lines {hidden}"


@pytest.mark.parametrize("library", RESERVED)
def test_library_is_imported_only_where_it_belongs(library):
    allowed = RESERVED[library]
    for name, path in MODULES.items():
        if not any(re.fullmatch(rf"{home}(\..+)?", name) for home in allowed):
            assert library not in {other.split(".")[0] for other in imports(path, top=True)}, name


def test_every_entry_of_the_table_of_floors_is_a_number_and_no_module_is_unnamed():
    for name in MODULES:
        assert isinstance(floor(name), int)


def test_importing_the_package_loads_no_other():
    code = "import raytrace, sys; print({'torch', 'matplotlib', 'pandas', 'scipy', 'tqdm'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, timeout=120, capture_output=True, text=True)
    assert done.stdout == "set()\n", done


#: What may not stand in a physics file, and why (docstrings and comments are not code and are not read).
FORBIDDEN_CALLS = {"item": "synchronises with the host", "numpy": "leaves the graph", "set_default_dtype": "global"}
PHYSICS = [
    "maths.numerics",
    "system.surface",
    "system.apertures",
    "system.intersection",
    "system.shapes",
    "system.sag_terms",
    "tracing.refraction",
    "tracing.trace",
    "tracing.paraxial",
    "tracing.aiming",
    "tracing.launch",
    "tracing.spot",
    "tracing.focus",
    "tracing.wavefront",
]


@pytest.mark.parametrize("name", PHYSICS)
def test_physics_stays_in_torch(name):
    tree = parsed(MODULES[name])
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            called = node.func.attr
            assert called not in FORBIDDEN_CALLS, f"{name}:{node.lineno}: .{called}() {FORBIDDEN_CALLS.get(called)}"
    if name != "maths.numerics":  # its dual numbers are arrays of numpy
        assert not {"math", "numpy"} & {other.split(".")[0] for other in imports(MODULES[name])}


#: Distributions by the module that they install, where the names differ.
DISTRIBUTIONS = {
    "mcp_types": "mcp",
    "anyio": "mcp",
    "PIL": "pillow",
    "OCP": "cadquery-ocp-novtk",
    "colour": "colour-science",
    "mpl_toolkits": "matplotlib",
}


def test_every_package_that_is_imported_is_declared():
    """Viewer, measured cameras, DXF and STEP files, and the server of agents have extras."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [name for extra in ("view", "colour", "cad", "mcp") for name in project["optional-dependencies"][extra]]
    declared = {re.match(r"[\w-]+", name)[0] for name in (*project["dependencies"], *extras)}
    library = MODULES.values()
    roots = {name.split(".")[0] for path in library for name in imports(path)}
    others = roots - set(sys.stdlib_module_names) - {package_of(name) for name in MODULES} - {"raytrace"}
    assert {DISTRIBUTIONS.get(name, name) for name in others} <= declared


def test_no_figure_is_left_at_the_top():
    """What a command writes there is named in the manual, and ignored by git."""
    listed = subprocess.run(["git", "ls-files", "*.*"], cwd=PACKAGE.parent, capture_output=True, text=True).stdout
    assert not [name for name in listed.split() if name.endswith((".png", ".pdf", ".svg")) and "/" not in name]

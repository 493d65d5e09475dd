"""README.md: its commands and examples run, its links and pictures exist."""

import operator
import re
import shlex
from pathlib import Path

import pytest

from raytrace.cli import codesign_run, main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
OVERVIEW = (ROOT / "docs" / "reference" / "overview.md").read_text(encoding="utf-8")
#: Pages whose Python runs, each in one namespace of its own; `lens` and `torch` are those of the README's example.
PYTHON = [
    ROOT / "README.md",
    ROOT / "docs" / "index.md",
    *(
        ROOT / "docs" / "reference" / f"{name}.md"
        for name in (
            *("lens_files", "rays", "psf", "learning", "rendering", "jacobian", "tolerances", "merit", "opticstudio"),
        )
    ),
]
#: Pages of every public name with an example each.
API = sorted((ROOT / "docs" / "reference").glob("api_*.md"))
STEM = operator.attrgetter("stem")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def first_block(heading: str) -> list[str]:
    """The lines of the first ```sh block under a heading."""
    section = re.split(r"^## ", README, flags=re.M)
    (text,) = [part for part in section if part.startswith(heading + "\n")]
    return re.search(r"^```sh\n(.*?)^```", text, re.M | re.S)[1].strip().splitlines()


def examples() -> list[str]:
    """Every `raytrace …` in shell blocks of the README and the overview, without comments and the installation."""
    found = []
    for block in re.findall(r"^```(?:sh|bash|console)\n(.*?)^```", README + OVERVIEW, re.M | re.S):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"&&|;|\|", line.split(" #")[0].removeprefix("$ ")):
                words = shlex.split(part)
                if words and Path(words[0]).name == "raytrace":
                    found.append(shlex.join(words[1:]))
    return list(dict.fromkeys(found))


def test_command_one_installs_and_focuses():
    (line,) = first_block("Install and run")
    parts = [shlex.split(part) for part in line.split("&&")]
    assert any(words[1:3] == ["install", "."] for words in parts)
    assert Path(parts[-1][0]).name == "raytrace"
    wanted = ["focus", "lenses/double_gauss.zmx", "--object-distance", "25000", "--plot", "focus.png"]
    assert parts[-1][1:] == wanted


def test_command_two_installs_and_tests():
    text = "\n".join(first_block("Install and test"))
    assert ".[test]" in text
    assert re.search(r"(^|[/\s])pytest -n 2$", text)


def test_continuous_integration_runs_command_two_then_ruff():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    lines = [line.strip() for line in script.splitlines()]
    command_two = first_block("Install and test")
    start = lines.index(command_two[0])
    assert lines[start : start + len(command_two)] == command_two
    after = "\n".join(lines[start + len(command_two) :])
    assert "ruff check" in after
    assert "ruff format --check" in after
    assert sum("pytest" in line and not line.startswith("#") for line in lines) == 1
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111


def test_extras_that_the_readme_installs_exist():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extras = set(re.findall(r"\.\[(\w+)\]", README))
    assert "test" in extras
    for extra in extras:
        assert re.search(rf"^{extra} = \[", project, re.M)
    assert 'raytrace = "raytrace.cli:script"' in project


#: Examples and pages of seconds; by default the commands are only read, and run in the tests of their own.
DEAR = ("compare double_gauss", "psf double_gauss --model drt", "api_analysis", "psf")


def quick_and_slow(listed: list, name) -> list:
    """Parameters of a test, those of DEAR in the slow suite."""
    dear = [name(one) in DEAR or name(one).startswith(DEAR[:2]) for one in listed]
    return [pytest.param(one, marks=pytest.mark.slow if slow else ()) for one, slow in zip(listed, dear, strict=True)]


@pytest.mark.parametrize("line", quick_and_slow(examples(), str))
def test_examples_run(line, tmp_path, monkeypatch, capsys):
    (tmp_path / "lenses").symlink_to(ROOT / "lenses")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(codesign_run, "_LEAVES", 16)  # pictures: a hundred take 8 s to draw
    assert main(shlex.split(line)) == 0, capsys.readouterr().err
    words = shlex.split(line)
    for option in ("-o", "--plot"):
        if option in words:
            assert Path(words[words.index(option) + 1]).stat().st_size > 0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", quick_and_slow(PYTHON, STEM), ids=STEM)
def test_python_runs(page, tmp_path, monkeypatch, capsys):
    """The blocks of a page, one after another, without other names."""
    (tmp_path / "lenses").symlink_to(ROOT / "lenses")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    assert blocks
    for block in blocks:
        exec(compile(block, page.name, "exec"), names)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", quick_and_slow(API, STEM), ids=STEM)
def test_examples_of_public_names_run(page, tmp_path, monkeypatch):
    """The blocks of a page, one after another, without other names."""
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S):
        exec(compile(block, page.name, "exec"), names)


def test_every_public_name_has_an_example():
    import raytrace as rt

    blocks = re.findall(r"^```python\n(.*?)^```", "".join(page.read_text("utf-8") for page in API), re.M | re.S)
    packages = "|".join(rt.NAMESPACES)
    assert {*rt.PUBLIC} <= {*re.findall(rf"\brt\.(?:(?:{packages})\.)?(\w+)", "".join(blocks))}


def test_every_command_is_shown():
    """As an example, or by its name in the table of the overview."""
    from raytrace.cli.commands import COMMANDS

    shown = {line.split()[0] for line in examples()} | set(re.findall(r"`([\w-]+)`", OVERVIEW))
    assert {command.name for command in COMMANDS} <= shown


def without_blocks(page: Path) -> str:
    """The text of a page without its code blocks."""
    return re.sub(r"^(`{3,}).*?^\1$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def anchors(page: Path) -> set[str]:
    """The anchors of the headings of a page, as web hosts of repositories and the book make them."""
    headings = re.findall(r"^#+ (.*)$", without_blocks(page), re.M)
    return {re.sub(r"[^\w -]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_pictures_exist(page):
    text = without_blocks(page)
    targets = re.findall(r"\]\(<?([^)>\s]+)", text) + re.findall(r"(?:src|href)=\"([^\"]+)\"", text)
    for target in targets:
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        file = page.parent / path if path else page
        assert file.exists() or file.parent.name == "generated", f"{page.name}: {target}"
        if anchor and file.exists():
            assert anchor in anchors(file), f"{page.name}: {target}"

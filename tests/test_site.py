"""Site of docs/conf.py, without building it.

Tests here, or the test of the page (`TESTED`), execute the code that pages show;
`test_shell_blocks.py` finds the shell commands.
"""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path

import click
import pytest
from docutils.nodes import make_id
from shown import shell_blocks
from sphinx.domains.python import ObjectEntry, PythonDomain

import drake_teleop
from drake_teleop.cli.main import cli
from drake_teleop.lab.studies.study import LoadStudy
from drake_teleop.station.scenario import LoadScenario

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
# The build downloads it.
COPIED = {"benchmarks.md", "changelog.md", "contributing.md", "evidence.md"}
TESTED = {
    "README.md": "tests/test_readme.py",
    "analysis.md": "tests/test_analysis_doc.py",
    "browser.md": "tests/robots/test_browser_kernel.py",
    "blocks.md": "tests/blocks/test_plain_blocks.py",
    "cluster.md": "tests/studies/test_study.py",
    "controllers.md": "tests/test_sides.py",
    "delay.md": "tests/test_delay_doc.py",
    "delay-figures.md": "tests/test_delay_doc.py",
    "detection.md": "tests/test_detection_doc.py",
    "extend.md": "tests/test_recipes.py",
    "log-description.md": "tests/logs/test_log_description.py",
    "logs.md": "tests/logs/test_log_description.py",
    "station.md": "tests/test_sides.py",
    "studies.md": "tests/studies/test_study.py",
}
BLOCKS = [
    (page.name, language, text)
    for page in PAGES
    if page.name not in COPIED
    for language, text in re.findall(
        r"^```([^\n]*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S
    )
    if not language.startswith("{")
]
loaded_from_elsewhere = runpy.run_path(str(DOCS / "_ext" / "offline.py"))["loaded_from_elsewhere"]
KnownNames = runpy.run_path(str(DOCS / "_ext" / "known_names.py"))["KnownNames"]
KEYWORDS = runpy.run_path(str(DOCS / "_ext" / "keywords.py"))["KEYWORDS"]
links = runpy.run_path(str(DOCS / "_ext" / "formulas.py"))["links"]


@pytest.mark.parametrize(
    "foreign",
    [
        '<script src="https://code.example/a.js"></script>',
        "<script async src='//code.example/a.js'></script>",
        '<link href="https://code.example/a.css" rel="stylesheet" />',
        '<link rel="preload" as="font" href="https://code.example/a.woff2">',
        '<img alt="x" src="http://code.example/a.png">',
        '@import "https://code.example/a.css";',
        "@font-face { src: url(https://code.example/a.woff2) }",
    ],
)
def test_what_is_loaded_from_elsewhere_is_found(foreign):
    """The build then ends with an error."""
    assert len(loaded_from_elsewhere(f"<p>before</p>{foreign}<p>after</p>")) == 1


def test_links_and_own_files_are_not():
    own = """<a href="https://example.org/paper">the paper</a> <script src="_static/a.js"></script>
    <link rel="canonical" href="https://example.org"> <img src="figures/a.png"> url(../a.woff2)"""
    assert loaded_from_elsewhere(own) == []


def test_numbers_of_formulas_are_links():
    said = "The floor (T12), as Eqs. (7)-(8) have it, not Eq. (99) nor (3) of them nor (T999)."
    found = [(piece, name) for piece, name in links(said) if name]
    assert found == [("(T12)", "eq-t12"), ("(7)", "eq-7"), ("(8)", "eq-8")]
    assert "".join(piece for piece, _ in links(said)) == said


def test_words_to_look_for_lead_to_sections_that_exist():
    for page, sections in KEYWORDS.items():
        text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
        assert sections.keys() <= set(map(make_id, re.findall(r"^#+ (.+)$", text, re.M))), page


def test_a_name_is_found_as_sphinx_finds_it():
    known = KnownNames.__new__(KnownNames)
    names = ("a.b.Scenario", "a.Scenario.check", "a.b", "c.check")
    known.data = {"objects": {}, "modules": {}}
    known.object_types, known._type2role, known._role2type = {}, {}, {"class": ["class"]}
    known.objtypes_for_role = lambda role: ["class"]
    for name in names:
        known.objects[name] = ObjectEntry("page", name, "class", False)
        for asked in ("Scenario", "check", "check()", "b.Scenario", "float", "c.check", "Scen", ""):
            for how in (("class", 0), ("class", 1)):
                place = (None, "a.b", None, asked, *how)
                assert known.find_obj(*place) == PythonDomain.find_obj(known, *place)


def test_a_script_of_the_gallery_is_short_and_says_what_it_shows():
    scripts = sorted((DOCS / "gallery").glob("*.py"))
    assert scripts
    for path in scripts:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 40, path.name
        assert text.startswith('"""\n'), path.name
        assert f'"{path.stem}"' in (DOCS / "_ext" / "gallery_style.py").read_text(), path.name


def test_every_block_says_what_it_is():
    """Code in one of these languages is executed; "text" is a drawing, a file or output."""
    assert len(BLOCKS) > 40
    assert {language for _, language, _ in BLOCKS} == {"sh", "python", "yaml", "text"}


def test_commands_that_cannot_be_typed_here_have_the_arguments_that_are_shown():
    shown = [
        line.partition("drake-teleop ")[2]
        for block in shell_blocks()
        if block.left_out
        for line in block.commands
        if "drake-teleop " in line
    ]
    assert len(shown) > 5
    for line in shown:
        name, *arguments = shlex.split(line)
        command = cli.commands[name]
        parsed, _, _ = command.make_parser(click.Context(command)).parse_args(arguments)
        assert set(parsed) <= {parameter.name for parameter in command.params}, line


@pytest.mark.parametrize(
    ("page", "text"),
    [
        pytest.param(page, text, id=f"{page}-{k}")
        for k, (page, language, text) in enumerate(BLOCKS)
        if language == "yaml" and page not in TESTED.keys() - {"station.md", "studies.md"}
    ],
)
def test_a_file_that_is_shown_can_be_read(page, text, tmp_path):
    file = tmp_path / "shown.yaml"
    file.write_text(text)
    if page == "studies.md":
        assert len(LoadStudy(file).factors) == 3
    else:
        LoadScenario(file).check()


def test_code_that_no_other_test_runs(capsys):
    shown = [text for page, language, text in BLOCKS if language == "python" and page not in TESTED]
    (code,) = shown
    (parts,) = re.findall(r"# (calibration, .*)", code)
    exec(compile(code, "sensor.md", "exec"), {})
    assert capsys.readouterr().out.strip() == parts


def test_who_is_said_to_run_it_reads_the_page():
    for page, test in TESTED.items():
        assert page in (ROOT / test).read_text(encoding="utf-8")


def test_every_package_is_in_the_reference():
    """The build of the site lists the public names of each package."""
    package = Path(drake_teleop.__file__).parent
    entries = {path.stem for path in package.iterdir() if path.suffix in ("", ".py")}
    public = {name for name in entries if not name.startswith("_")}
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^   ([a-zA-Z_]+)$", text, re.M))
    assert (public | set(drake_teleop.__all__) - {"__version__"}) ^ listed == set(), (
        "one more, or one less, in docs/reference.md"
    )

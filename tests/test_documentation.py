"""README and docs/: their Python runs, their commands have the options that they use, and the site builds strictly."""

import dataclasses
import functools
import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests import tiny
from warpgs.cli import COMMANDS
from warpgs.command_line.parsing import flags, parse
from warpgs.config import builtin, presets
from warpgs.runs.run import Run
from warpgs.training import command as training

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OWN_TESTS = {"extending.md"}
"""Pages whose Python has tests of its own."""

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(python train\.py|warpgs [a-z]+)( |$)")


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def snippets() -> list[tuple[str, str]]:
    """Each page with Python, and all of its Python as one program."""
    pages = [page for page in PAGES if page.name not in OWN_TESTS]
    programs = [
        (name(page), [code for kind, code in BLOCK.findall(page.read_text()) if kind == "python"]) for page in pages
    ]
    return [(page, "\n".join(parts)) for page, parts in programs if parts]


@pytest.fixture
def folder_with_a_run(finished_run, tmp_path, monkeypatch):
    """A current folder as the pages assume it, with a run and a capture, and a short preset."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "builtin-quick").symlink_to(finished_run)
    (tmp_path / "capture").symlink_to(Run.open(finished_run).config.data, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    quick = dataclasses.replace(tiny.CONFIG, data=tmp_path / "capture")
    monkeypatch.setitem(presets.PRESETS, "quick", quick)
    return tmp_path


@pytest.mark.parametrize(("page", "program"), snippets(), ids=[page for page, _ in snippets()])
@pytest.mark.usefixtures("folder_with_a_run")
def test_python_of_a_page_runs(page, program, capsys):
    with tiny.in_haste():
        exec(compile(program.replace("iterations=300", "iterations=8"), page, "exec"), {})


def command_lines(text: str) -> list[str]:
    """The commands in lines of text, without comments and what other programs do with them."""
    lines = [re.split(r"\s+#|\s+&&|\s+>>?\s|;", line)[0].strip().removeprefix("exec ") for line in text.splitlines()]
    return [line.replace("python train.py", "warpgs train") for line in lines if COMMAND.match(line)]


def in_blocks(page: Path) -> list[str]:
    """Complete command lines of a page."""
    return [
        line for kind, code in BLOCK.findall(page.read_text()) if kind in ("sh", "") for line in command_lines(code)
    ]


def in_sentences(page: Path) -> list[str]:
    """Commands, often without all arguments, that sentences and tables of a page name."""
    return command_lines("\n".join(re.findall(r"`([^`\n]*)`", BLOCK.sub("", page.read_text()))))


@functools.cache
def known(command: str) -> set[str]:
    """All options of a command."""
    return {*flags(COMMANDS[command].load()), "--help", "--help-all", "--version"}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_of_a_page_have_the_options_that_it_names(page):
    for line in in_blocks(page) + in_sentences(page):
        _, command, *rest = line.split()
        assert command in COMMANDS, line
        assert {part.split("=")[0] for part in rest if re.match("--[a-z]", part)} <= known(command), line


@pytest.mark.parametrize("page", [page for page in PAGES if in_blocks(page)], ids=name)
def test_complete_commands_of_a_page_are_accepted(page):
    for line in in_blocks(page):
        if "--help" in line or "--version" in line:
            continue
        plain = re.sub(r"\[[A-Z]+ \.\.\.\]", "", line)
        _, command, *rest = ["3" if part == "N" else part for part in shlex.split(plain)]
        if command == "train":
            training.parse(rest)
        else:
            parse(COMMANDS[command].load(), rest, f"warpgs {command}")


def test_the_command_of_the_job_for_slurm_is_accepted():
    (line,) = command_lines((ROOT / "examples" / "sweep_on_slurm.sh").read_text())
    _, command, *rest = shlex.split(line)
    parse(COMMANDS[command].load(), rest, f"warpgs {command}")


def test_there_are_commands_and_snippets():
    assert sum(len(in_blocks(page)) for page in PAGES) > 30
    assert sum(len(in_sentences(page)) for page in PAGES) > 30
    assert len(snippets()) >= 6


@pytest.fixture
def pages(monkeypatch):
    """The module that makes the pages of the site."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module("site_pages")


@pytest.mark.parametrize("name", ["options.md", "api.md"])
def test_the_site_has_no_notes_on_how_it_is_made(pages, name):
    text = pages.on_page_markdown((ROOT / "docs" / name).read_text())
    assert text.startswith("# ")
    for note in ("<!--", "mkdocs", "site_pages", "entries that begin"):
        assert note not in text


def test_every_option_is_on_the_page_of_options(pages):
    text = pages.on_page_markdown((ROOT / "docs" / "options.md").read_text())
    assert pages.MARKER not in text
    assert "mkdocs serve" not in text  # which is for readers of the file
    for command in COMMANDS:
        for option in pages.options_of(command):
            name, default, meaning = pages.row(option)
            assert meaning, option.name
            assert f"| {name} | {default} | {meaning} |" in text
    assert "| `--exposure`, `--no-exposure` | yes |" in text
    assert "| `--model.half`, `--model.no-half` | yes |" in text
    assert "| `--assume` | `masks` | `auto` | `auto` | `masks` |" in text
    assert "| `--quiet`, `--no-quiet` | no |" in text
    assert "| `--densify.max-gaussians INT` | `3000000` |" in text
    assert "| `--schedule.joint-from` | none | `0` | `0` | `0` |" in text


def test_the_page_of_options_has_the_defaults_of_the_command_line(pages):
    config = training.parse(["--data", "capture"])
    options = [option for option in pages.options_of("train") if option.name != "--data"]
    assert len(options) > 60
    for option in options:
        assert option.default == pages.value(config, option.name), option.name
    defaults = {option.name: option.default for option in pages.options_of("render")}
    assert (defaults["RUN"], defaults["--supersample"]) == (dataclasses.MISSING, 1)


def test_pipes_in_the_code_of_tables_are_shown_without_the_backslash_that_github_needs(pages):
    text = "| `--a b\\|c` | either \\| or |\n\nnot `d\\|e`"
    assert pages.on_page_markdown(text) == "| `--a b|c` | either \\| or |\n\nnot `d\\|e`"


def test_choices_of_an_option_and_long_cells_of_a_table_have_space(pages):
    (layers,) = (option for option in pages.options_of("export") if option.name == "--layers")
    assert pages.row(layers)[0] == "`--layers {all`, `static`, `dynamic`, `apart}`"
    long = "a <b>word</b> " * 9
    phrase, number = "a <b>word</b> and a few more", "<td><strong>41.34</strong></td>"
    cells = f'<td>a</td><td class="long">{long}</td><td class="phrase">{phrase}</td>'
    assert pages.on_page_content(f"<td>a</td><td>{long}</td><td>{phrase}</td>") == cells
    assert pages.on_page_content(number) == number


def test_code_breaks_between_words_and_folders_and_not_inside_of_options(pages):
    text = pages.on_page_content("<p><code>train --model.sh-degree 0</code> of the-rest</p>")
    assert text == '<p><code>train <span class="option">--model.sh-degree</span> 0</code> of the-rest</p>'
    path = "warpgs/data/loaders/posed.py"
    assert pages.on_page_content(f"<code>{path}</code>") == f"<code>{path.replace('/', '/<wbr>')}</code>"
    for kept in ("<code>viewer/</code>", f"<pre><span></span><code>{path}</code></pre>"):
        assert pages.on_page_content(kept) == kept
    assert pages.on_page_content(f"<code>{'word ' * 9}</code>") == f'<code class="long">{"word " * 9}</code>'


def test_placeholders_in_the_help_of_options_are_shown(pages):
    (out,) = (option for option in pages.options_of("train") if option.name == "--out")
    assert "runs/<capture>-<preset>" in out.text
    assert "runs/&lt;capture&gt;-&lt;preset&gt;" in pages.row(out)[2]


def test_images_link_to_their_files(pages):
    image = '<img alt="A scene" src="../images/a.jpg" />'
    assert pages.on_page_content(f"<p>{image}</p>") == f'<p><a href="../images/a.jpg">{image}</a></p>'


def test_every_page_is_in_the_navigation_of_the_site():
    listed = re.findall(r"\S+\.md$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(str(page.relative_to(ROOT / "docs")) for page in PAGES[1:])


def test_design_notes_have_at_most_40_lines():
    notes = sorted((ROOT / "docs" / "design").glob("*.md"))
    assert notes
    assert [name(note) for note in notes if len(note.read_text().splitlines()) > 40] == []


SITE = ("mkdocs", "material", "mkdocstrings")


@pytest.mark.skipif(
    any(importlib.util.find_spec(package) is None for package in SITE), reason="the extra docs is not installed"
)
def test_the_site_builds_without_a_warning(tmp_path):
    """Pages, links and anchors inside of them, and every name of the API."""
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    arguments = ["build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", *arguments], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    api = (tmp_path / "site" / "api" / "index.html").read_text()
    for public in ("warpgs.open_run", "warpgs.load_capture", "warpgs.train", "warpgs.render"):
        assert f'id="{public}"' in api
    assert not re.search(r"<code>\w+,</code>", api)  # two names in one line of a docstring are not parsed
    pages = "".join(path.read_text() for path in (tmp_path / "site").rglob("*.html"))
    for paragraph in re.findall(r"<p>(.*?)</p>", pages, re.DOTALL):
        assert not re.search(r"\n(?:[-*]|\d+\.) ", paragraph), paragraph  # a list that Python's Markdown does not see
    assert not re.search(r"@@\w+@@", pages)  # a placeholder that nobody has filled in
    assert not re.search(r"<h\d[^>]*>[^<]*\\", pages)  # an escape that only GitHub understands
    assert not re.search(r'(?:src|href)="https?://[^"]*\.(?:js|css|woff2?)"', pages)  # loads nothing from elsewhere


@pytest.mark.parametrize("capture", builtin.QUERIES)
def test_every_option_of_a_built_in_capture_is_explained(capture):
    _, _, rows = (ROOT / "docs" / "cluster.md").read_text().partition(f"| `builtin:{capture}` |")
    options = re.findall(r"\| `\?(\w+)=", rows.partition("| `builtin:")[0])
    assert sorted(options) == sorted(builtin.QUERIES[capture])

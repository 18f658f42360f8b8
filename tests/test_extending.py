"""docs/extending.md: each of its examples works as it stands, in one new file and one line."""

import importlib
import importlib.util
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "extending.md").read_text()
EXAMPLES = re.findall(
    r"```python\n# (?P<file>warpgs/\S+)\.py\n(?P<source>.*?)```\s+"
    r"```python\n# one line in (?P<dict>\w+), (?P<home>warpgs/\S+)\.py\n(?P<line>.*?)```\s+"
    r"```python\n# tests/\S+\n(?P<test>.*?)```",
    TEXT,
    re.DOTALL,
)


def module_name(path):
    return path.removesuffix("/__init__").replace("/", ".")


def test_every_dict_has_an_example():
    table = set(re.findall(r"`([A-Z]+)` in `warpgs/", TEXT))
    assert table == {example[2] for example in EXAMPLES}
    assert len(table) == 10


def with_example(source, example):
    """The source of the dictionary's module after the example's import and line."""
    file, _, dictionary, _, line, _ = example
    (name,) = re.findall(r": (\w+)", line)
    start = re.search(rf"^{dictionary}\b.* = {{\n", source, re.MULTILINE).end()
    source = source[:start] + f"    {line}" + source[start:]
    first = re.search(r"^(from|import) ", source, re.MULTILINE).start()
    return source[:first] + f"from {module_name(file)} import {name}\n" + source[first:]


def test_all_examples_can_be_added_to_the_files(tmp_path):
    """In a new process, because imports that are circular work in a process that has them already."""
    shutil.copytree(ROOT / "warpgs", tmp_path / "warpgs", ignore=shutil.ignore_patterns("kernels"))
    shutil.copytree(ROOT / "kernels", tmp_path / "warpgs" / "kernels")
    for example in EXAMPLES:
        file, source, _, home, _, _ = example
        (tmp_path / f"{file}.py").write_text(source)
        path = tmp_path / f"{home}.py"
        path.write_text(with_example(path.read_text(), example))
    code = [
        f"import {module_name(home)} as home; assert {line.split(':')[0]} in home.{dictionary}"
        for _, _, dictionary, home, line, _ in EXAMPLES
    ]
    subprocess.run([sys.executable, "-c", "\n".join(code)], cwd=tmp_path, check=True)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example[2])
def test_an_example_works(example, monkeypatch, request):
    file, source, dictionary, home, line, test = example
    pytest.importorskip("viser") if "viewer" in file else None
    spec = importlib.util.spec_from_loader(module_name(file), loader=None)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(source, module.__dict__)
    added = eval("{" + line + "}", module.__dict__)
    target = getattr(importlib.import_module(module_name(home)), dictionary)
    assert len(added) == 1
    assert not set(added) & set(target)
    # In front, because the first loader that recognizes a folder reads it.
    everything = {**added, **target}
    monkeypatch.setattr(importlib.import_module(module_name(home)), dictionary, target)
    before = dict(target)
    target.clear()
    target.update(everything)
    try:
        names = {}
        exec(test, names)
        (function,) = (value for name, value in names.items() if name.startswith("test_"))
        function(**{name: request.getfixturevalue(name) for name in inspect.signature(function).parameters})
    finally:
        target.clear()
        target.update(before)

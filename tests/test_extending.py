"""docs/extending.md: each of its examples works as it stands, in one new file and one line."""

import importlib
import importlib.util
import inspect
import re
import sys
from pathlib import Path

import pytest

TEXT = (Path(__file__).parents[1] / "docs" / "extending.md").read_text()
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
    assert len(table) == 7


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

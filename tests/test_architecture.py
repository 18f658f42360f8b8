"""Rules of the architecture, checked on the sources."""

import ast
import functools
import re
from collections.abc import Collection, Mapping
from pathlib import Path

import pytest
import torch
from beartype.roar import BeartypeCallHintViolation

from warpgs.ops.ssim import ssim

ROOT = Path(__file__).parent.parent
ORDER = [
    "errors command_line config parsed files locks cache posix",
    "kernels",
    "runtime",
    "ops",
    "distortion shutter cameras least_squares",
    "model",
    "rendering",
    "visualize",
    "data formats",
    "download",
    "views",
    "synthetic",
    "captures",
    "runs",
    "video editing meshing",
    "evaluation",
    "initialization",
    "training prepare",
    "bench export viewer report",
    "sweep demo",
    "cli",
]
"""The layers of the package: each may import from its own line and from those above it."""

PREPARE_ORDER = [
    "options weights networks contact_sheet",
    "frames",
    "cameras",
    "masks",
    "scene",
    "depth",
    "doubts checks journal steps add pipeline command",
]
"""The layers of ``warpgs/prepare/``, its four subjects among them."""

MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 40
"""Kernels apart."""

FILES = sorted([*(ROOT / "kernels").rglob("*.py"), *(ROOT / "warpgs").rglob("*.py")])
PATHS = pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))


def module_name(path: Path) -> list[str]:
    """['warpgs', 'ops', 'tape'] of a source file; kernels are installed inside the package."""
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    return parts if parts[0] == "warpgs" else ["warpgs", *parts]


@functools.cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text())


@functools.cache
def imports(path: Path) -> list[str]:
    """Absolute names of everything that a file imports."""
    package = module_name(path)[:-1]
    names = []
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*start, *([node.module] if node.module else [])])
            names += [f"{origin}.{alias.name}" for alias in node.names]
    return names


ORDERS = {"warpgs": ORDER, "warpgs.prepare": PREPARE_ORDER}
PACKAGES = pytest.mark.parametrize("package", ORDERS)


def layer(package: str, name: str) -> int | None:
    """The line of the package's order that a name in it belongs to."""
    inside = name.removeprefix(f"{package}.").split(".")[0]
    return next((k for k, names in enumerate(ORDERS[package]) if inside in names.split()), None)


def names_in(package: str) -> dict[str, Path]:
    """The modules in a package, by their names."""
    files = [p for p in FILES if p.name not in ("__init__.py", "__main__.py")]
    named = {".".join(module_name(p)): p for p in files}
    return {name: p for name, p in named.items() if name.startswith(f"{package}.")}


@PACKAGES
def test_every_module_belongs_to_a_layer(package):
    names = names_in(package)
    assert names
    assert [name for name in names if layer(package, name) is None] == []


@PACKAGES
def test_a_module_imports_only_from_its_layer_and_lower_ones(package):
    for name, path in names_in(package).items():
        for other in imports(path):
            if f"{other}.".startswith(f"{package}."):
                found = layer(package, other)
                assert found is not None, (name, other)
                assert found <= layer(package, name), (name, other)


MODULES = {".".join(module_name(path)).removesuffix(".__init__"): path for path in FILES}


def imported_modules(path: Path) -> set[str]:
    """The modules of the package that a file imports, also inside functions."""
    found = set()
    for name in imports(path):
        while name and name not in MODULES:
            name = name.rpartition(".")[0]
        found.add(name)
    return found - {""}


def circles(graph: Mapping[str, Collection[str]]) -> list[list[str]]:
    """The groups of nodes that reach each other."""
    reached = {start: reachable(graph, start) for start in graph}
    groups = {tuple(sorted(b for b in reached[a] if a in reached[b])) for a in graph}
    return sorted(list(group) for group in groups if group)


def reachable(graph: Mapping[str, Collection[str]], start: str) -> set[str]:
    """The nodes at the ends of all paths from a node."""
    found: set[str] = set()
    ahead = [*graph[start]]
    while ahead:
        if (node := ahead.pop()) not in found:
            found.add(node)
            ahead += graph[node]
    return found


def test_circles_are_found_and_chains_are_none():
    assert circles({"a": ["b"], "b": ["c"], "c": ["a", "d"], "d": [], "e": ["a"]}) == [["a", "b", "c"]]


def test_no_modules_import_each_other_in_a_circle_also_not_inside_functions():
    assert circles({name: imported_modules(path) for name, path in MODULES.items()}) == []


@PATHS
def test_only_kernels_runtime_and_ops_know_warp(path):
    if module_name(path)[1] not in ("kernels", "runtime", "ops"):
        assert not [name for name in imports(path) if name.split(".")[0] == "warp"]


@PATHS
def test_the_package_imports_no_test(path):
    assert not [name for name in imports(path) if name.split(".")[0] == "tests"]


@PATHS
def test_no_file_is_long(path):
    assert len(path.read_text().splitlines()) <= MAX_FILE_LINES


@pytest.mark.parametrize("path", [p for p in FILES if "kernels" not in p.parts], ids=lambda p: str(p.relative_to(ROOT)))
def test_no_function_is_long(path):
    functions = [n for n in ast.walk(parsed(path)) if isinstance(n, ast.FunctionDef)]
    assert [f.name for f in functions if f.end_lineno - f.lineno + 1 > MAX_FUNCTION_LINES] == []


def test_annotated_shapes_are_checked_while_tests_run():
    with pytest.raises(BeartypeCallHintViolation):
        ssim(torch.ones(5, 6, 3), torch.ones(5, 7, 3))


def defines_kernels(path: Path) -> bool:
    decorators = [
        ast.unparse(decorator)
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.FunctionDef)
        for decorator in node.decorator_list
    ]
    return any(name.startswith("wp.kernel") for name in decorators)


KERNEL_FILES = [p for p in (ROOT / "kernels").glob("*.py") if defines_kernels(p)]
OPS = sorted({re.sub("_(fwd|bwd|cpu)$", "", p.stem) for p in KERNEL_FILES})


def test_there_are_kernels():
    assert len(OPS) > 5


@pytest.mark.parametrize("name", OPS)
def test_every_file_of_kernels_has_an_op_a_reference_and_a_test(name):
    room = "synthetic" if name == "raytrace" else "ops"
    for path in (f"warpgs/{room}/{name}.py", f"tests/reference/{name}.py", f"tests/{room}/test_{name}.py"):
        assert (ROOT / path).is_file(), path


@pytest.mark.parametrize("path", [p for p in FILES if "warpgs" in p.relative_to(ROOT).parts], ids=lambda p: p.stem)
def test_public_names_have_docstrings(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), node.name

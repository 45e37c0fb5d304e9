"""House rules that a syntax tree shows: one assignment per line, unique names in a package."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"


def parallel_assignments(text):
    """Lines of assignments of several values to several names, such as ``a, b = 1, 2``.

    Swaps and updates, where a value reads a target, are no fault. Neither is unpacking one value, nor writing several
    items of arrays.
    """
    found = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple) or len(node.targets) > 1:
            continue
        targets = node.targets[0]
        if not isinstance(targets, ast.Tuple) or len(targets.elts) != len(node.value.elts):
            continue
        written = {ast.unparse(target) for target in targets.elts}
        read = {
            ast.unparse(part) for part in ast.walk(node.value) if isinstance(part, (ast.Name, ast.Attribute))
        }
        items = any(isinstance(target, (ast.Subscript, ast.Starred)) for target in targets.elts)
        if not items and not written & read:
            found.append(node.lineno)
    return found


def test_each_assignment_has_a_line_of_its_own():
    faults = {
        path.relative_to(SOURCE).as_posix(): lines
        for path in sorted(SOURCE.rglob("*.py"))
        if (lines := parallel_assignments(path.read_text(encoding="utf-8")))
    }
    assert faults == {}


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("a, b = 1, 2", [1]),
        ("def f(self):\n    self.a, self.b = x, y()", [2]),
        ("(a, b), c = f(), 3", [1]),
        ("a, b = b, a", []),
        ("a, b = b, a + b", []),
        ("a, b = f()", []),
        ("a = b = 3", []),
        ("rows[0], rows[1] = x, y", []),
        ("first, *rest = 1, 2", []),
    ],
)
def test_parallel_assignments_are_found(text, lines):
    assert parallel_assignments(text) == lines


def repeated_names(package):
    """Return the names of classes and public functions that several modules of a package define."""
    modules = defaultdict(list)
    for path in sorted(package.rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            public = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and not node.name.startswith(
                "_"
            )
            if public or isinstance(node, ast.ClassDef):
                modules[node.name].append(path.relative_to(package).as_posix())
    return {name: paths for name, paths in modules.items() if len(paths) > 1}


@pytest.mark.parametrize("package", sorted(path.name for path in SOURCE.iterdir() if path.is_dir()))
def test_names_are_unique_within_a_package(package):
    assert repeated_names(SOURCE / package) == {}


def test_repeated_names_are_found(tmp_path):
    (tmp_path / "a.py").write_text("class _Same: ...\ndef one(): ...\ndef _private(): ...\n")
    (tmp_path / "b.py").write_text("class _Same: ...\ndef two(): ...\ndef _private(): ...\n")
    assert repeated_names(tmp_path) == {"_Same": ["a.py", "b.py"]}

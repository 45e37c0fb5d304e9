"""House rules that a syntax tree shows: one assignment per line."""

import ast
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

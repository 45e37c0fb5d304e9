"""Data flows one way: every module imports only from rooms above its own, and openly."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = "polarguide"
FOLDERS = ("src", "benchmarks", "examples", "tests")
SOURCE = Path(__file__).resolve().parents[1] / "src" / PACKAGE

# From the top down. A room may import from itself and from every room before it. A folder in a room may have a place of
# its own, named with the room's.
ROOMS = (
    "core",
    "geometry",
    "_native",
    "optics",
    "capture",
    "preparation",
    "gaussians",
    "raster",
    "shading",
    "visualization",
    "shots.calibration",
    "shots",
    "shots.measurement",
    "training",
    "training.angles",
    "fields",
    "recipes",
    "runs",
    "results.rendering",
    "results.evaluation",
    "results.export",
    "inspection",
    "viewer",
    "synth",
    "experiments",
    "api",
    "cli",
    "__main__",
)
# What ``polarguide/__init__.py`` defines itself (its version) is for everyone. It names what others define for type
# checkers, and loads it by name when it is asked for.
ROOT = ""


def room_of(parts):
    """The room of a module's path below the package, ROOT for the package itself."""
    inner = ".".join(parts[:2])
    return inner if inner in ROOMS else parts[0] if parts and parts[0] != "__init__" else ROOT


def imported_rooms(node, parts, rooms):
    """The rooms that one import statement of the module at ``parts`` reaches; [] where it is not ours."""
    if isinstance(node, ast.Import):
        names = [alias.name.split(".") for alias in node.names]
        return [room_of(name[1:]) for name in names if name[0] == PACKAGE]
    if node.level:
        base = list(parts[: len(parts) - node.level])
        path = base + (node.module.split(".") if node.module else [])
    else:
        path = (node.module or "").split(".")
        if path[0] != PACKAGE:
            return []
        path = path[1:]
    if path:  # what is imported may be a room in a room
        return sorted({room_of([*path, alias.name]) for alias in node.names})
    # ``from polarguide import x``: a room, or something the package itself defines.
    known = {room.partition(".")[0] for room in rooms}
    return [alias.name if alias.name in known else ROOT for alias in node.names]


def imports(node, deferred=False, typing=False):
    """Import statements below a node: each, whether a function has it, and whether it is for type checkers alone."""
    deferred |= isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    typing |= isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, (ast.Import, ast.ImportFrom)):
            yield inner, deferred, typing
        elif not isinstance(inner, ast.expr):  # expressions have no statements in them
            yield from imports(inner, deferred, typing)


def faults(source, rooms=ROOMS):
    """What breaks the order in the package at ``source``, one line each."""
    found = []
    for path in sorted(source.rglob("*.py")):
        parts = path.relative_to(source).with_suffix("").parts
        room = room_of(parts)
        where = path.relative_to(source).as_posix()
        gathers = parts[1:] == ("__init__",) and any(each.startswith(f"{room}.") for each in rooms)
        if room != ROOT and room not in rooms and not gathers:
            found.append(f"{where}: the room {room} has no place in the order")
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
        for node, deferred, typing in imports(tree):
            line = f"{where}:{node.lineno}"
            if any(alias.name == "*" for alias in node.names):
                found.append(f"{line}: star import")
            targets = imported_rooms(node, parts, rooms)
            if room == ROOT and typing:
                continue
            if targets and deferred:
                found.append(f"{line}: project import inside a function")
            for target in targets:
                if target in (ROOT, room):
                    continue
                if target not in rooms:
                    found.append(f"{line}: imports {target}, which has no place in the order")
                elif room == ROOT or rooms.index(target) > rooms.index(room):
                    found.append(f"{line}: {room or PACKAGE} imports {target}, which is further down")
    return found


def test_the_package_keeps_its_order():
    assert len(list(SOURCE.rglob("*.py"))) > 10
    assert faults(SOURCE) == []


def test_the_package_itself_imports_nothing_heavy():
    code = (
        "import sys, polarguide; dir(polarguide); polarguide.TrainSettings; "
        "print('torch' in sys.modules, callable(polarguide.compare), 'torch' in sys.modules); "
        "print('distributed' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True", "True", "False"]


def clients_of_the_command_line(root):
    """Files that import ``polarguide.cli`` and are no part of it, below the folders of a checkout."""
    allowed = ("src/polarguide/cli/", "src/polarguide/__main__.py", "tests/cli/", "tests/robustness/")
    found = []
    for path in sorted(p for folder in FOLDERS for p in (root / folder).rglob("*.py")):
        name, text = path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")
        if "cli" not in text:  # most, and parsing them takes long
            continue
        tree = ast.parse(text, name)
        modules = {alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names}
        for node in (n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)):
            module = ("polarguide." if node.level else "") + (node.module or "")
            modules |= {f"{module}.{alias.name}" for alias in node.names}
        # A module may also be loaded by its name.
        modules |= {
            n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)
        }
        if not name.startswith(allowed) and any(f"{m}.".startswith(f"{PACKAGE}.cli.") for m in modules):
            found.append(name)
    return sorted(found)


def test_nothing_but_itself_imports_the_command_line():
    assert clients_of_the_command_line(SOURCE.parents[1]) == []


@pytest.mark.parametrize(
    "text",
    [
        "from polarguide.cli.app import run",
        "from polarguide import cli",
        "import polarguide.cli.app as app",
        "import importlib\nimportlib.import_module('polarguide.cli.app')",
    ],
)
def test_a_client_of_the_command_line_is_found(package, text):
    files = {"src/polarguide/runs/a.py": text, "benchmarks/b.py": text, "tests/cli/c.py": text}
    root = package({**files, "examples/d.py": "import polarguide"})
    assert clients_of_the_command_line(root) == ["benchmarks/b.py", "src/polarguide/runs/a.py"]


@pytest.fixture
def package(tmp_path):
    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write


def test_upward_and_outside_imports_are_fine(package):
    cli = [
        "import polarguide",
        "from polarguide import __version__, _native",
        "from ..optics.stokes import s",
    ]
    stokes = ["def f():", "    import scipy", "from ..core.errors import E", "from . import frames"]
    frames = [
        "import torch",
        "from polarguide.geometry.camera import Camera",
        "import polarguide.optics.stokes",
    ]
    source = package(
        {
            "__init__.py": "__version__ = '1'",
            "cli/run.py": "\n".join(cli),
            "optics/stokes.py": "\n".join(stokes),
            "optics/frames.py": "\n".join(frames),
        }
    )
    assert faults(source) == []


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        (
            "__init__.py",
            "from polarguide.api import load",
            "__init__.py:1: polarguide imports api, which is further down",
        ),
        (
            "optics/a.py",
            "from polarguide.training import loop",
            "optics/a.py:1: optics imports training, which is",
        ),
        (
            "optics/a.py",
            "from polarguide import cli",
            "optics/a.py:1: optics imports cli, which is further down",
        ),
        (
            "optics/a.py",
            "import polarguide.raster.cpu as c",
            "optics/a.py:1: optics imports raster, which is",
        ),
        (
            "optics/a.py",
            "from ..raster import x",
            "optics/a.py:1: optics imports raster, which is further down",
        ),
        (
            "optics/__init__.py",
            "from .. import raster",
            "optics/__init__.py:1: optics imports raster, which is",
        ),
        ("core/a.py", "from ..optics import x", "core/a.py:1: core imports optics, which is further down"),
        (
            "results/export/a.py",
            "from polarguide.viewer import x",
            "results/export/a.py:1: results.export imports viewer, which is further down",
        ),
        (
            "results/rendering/a.py",
            "from polarguide.results import export",
            "results/rendering/a.py:1: results.rendering imports results.export, which is further down",
        ),
        (
            "__init__.py",
            "from .core.errors import E",
            "__init__.py:1: polarguide imports core, which is further down",
        ),
        (
            "cli/a.py",
            "def f():\n    from polarguide.optics import x",
            "cli/a.py:2: project import inside a function",
        ),
        (
            "cli/a.py",
            "class A:\n  def f(self):\n    from . import b",
            "cli/a.py:3: project import inside a function",
        ),
        ("cli/a.py", "from math import *", "cli/a.py:1: star import"),
        ("cli/a.py", "from polarguide.nowhere import x", "cli/a.py:1: imports nowhere, which has no place"),
        ("attic/a.py", "", "attic/a.py: the room attic has no place in the order"),
        (
            "optics/a.py",
            "if TYPE_CHECKING:\n    from ..cli import x",
            "optics/a.py:2: optics imports cli, which is",
        ),
    ],
)
def test_what_breaks_the_order_is_found(package, name, text, fault):
    found = faults(package({name: text + "\n"}))
    assert len(found) == 1
    assert found[0].startswith(fault)

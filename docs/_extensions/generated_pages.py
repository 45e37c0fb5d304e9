"""Pages generated from the program, so that they are always current.

reference/api/*.md           a page for each room of the product and for each neighbor, with all public modules
generated/command-line.md    every verb and option, as the program's own help states them
generated/python.md          the names of ``import polarguide``
"""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path

from sphinx.application import Sphinx

PACKAGE = "polarguide"
# Rooms without an interface for Python: the command line has a page of its own.
NOT_LIBRARY = tuple(f"{PACKAGE}.{room}" for room in ("_native", "api", "cli", "__main__"))


def rooms(docs: Path) -> tuple[str, ...]:
    """Return the names of the rooms in import order, from the tuple ROOMS of tests/test_imports.py."""
    tree = ast.parse((docs.parent / "tests" / "test_imports.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "ROOMS":
            return tuple(ast.literal_eval(node.value))
    raise ValueError("tests/test_imports.py: expected the tuple ROOMS, found none")


def source_of(name: str) -> Path:
    """Return the file of a module without importing it."""
    package = find_spec(name.partition(".")[0])
    assert package is not None
    assert package.submodule_search_locations
    path = Path(package.submodule_search_locations[0]).joinpath(*name.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def exists(name: str) -> bool:
    """Return True if the module or package exists."""
    path = source_of(name)
    return path.exists() or path.name == "__init__.py"


def summary(name: str) -> str:
    """Return the first sentence of a module's docstring without its full stop, or an empty text."""
    path = source_of(name)
    path = path if path.exists() else path.with_suffix(".pyi")  # a compiled module
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) if path.exists() else None
    return " ".join((text or "").split("\n\n")[0].split()).rstrip(".")


def public_modules(name: str) -> Iterator[str]:
    """Yield a module and its public submodules."""
    yield name
    path = source_of(name)
    if path.name == "__init__.py":
        for module in pkgutil.iter_modules([str(path.parent)]):
            if not module.name.startswith("_"):
                yield from public_modules(f"{name}.{module.name}")


def module_section(name: str, level: int) -> str:
    """Return a heading and the directives for the public names that a module defines."""
    is_package = source_of(name).name == "__init__.py"
    members = "" if is_package else "\n   :members:\n   :ignore-module-all:"
    title = name if level == 1 else name.partition(".")[2]
    return f"{'#' * level} `{title}`\n\n```{{eval-rst}}\n.. automodule:: {name}{members}\n```\n"


def page_of(room: str) -> str:
    """Return the name of the page that documents a room: its top-level room in the product, or its package."""
    package, _, rest = room.partition(".")
    return f"{package}.{rest.partition('.')[0]}" if package == PACKAGE else package


def api_pages(docs: Path) -> dict[str, str]:
    """Return the texts of the pages below reference/api by name."""
    pages = {}
    for name in dict.fromkeys(page_of(room) for room in rooms(docs)):
        if name in NOT_LIBRARY or not exists(name):
            continue
        first, *others = public_modules(name)
        parts = [module_section(first, 1), *(module_section(other, 2) for other in others)]
        pages[name] = "\n".join(parts)
    lines = [f"| [`{name}`]({name}.md) | {escaped(summary(name))} |" for name in pages]
    contents = ["```{toctree}", ":hidden:", "", *pages, "```"]
    index = [
        "# The library, room by room",
        "",
        "| room | content |",
        "|---|---|",
        *lines,
        "",
        *contents,
    ]
    pages["index"] = "\n".join(index) + "\n"
    return pages


def escaped(text: str) -> str:
    """Escape Markdown in a text and turn ``code`` into `code`."""
    parts = re.split(r"(``.+?``)", text)
    parts[::2] = [re.sub(r"([\\`*_{}\[\]<>|$#~])", r"\\\1", part) for part in parts[::2]]
    parts[1::2] = [part[1:-1] for part in parts[1::2]]
    return "".join(parts)


def public_names() -> str:
    """Return the page of the public names of ``polarguide``: functions, the run, and all others."""
    package = importlib.import_module(PACKAGE)
    found = {name: getattr(package, name) for name in package.__all__ if not name.startswith("_")}
    directives = []
    for name in sorted(found, key=lambda name: (inspect.isclass(found[name]), name != "Run", name.lower())):
        value, place = found[name], f"{PACKAGE}.{name}"
        if inspect.isclass(value):
            inherits = any(base.__module__.startswith(PACKAGE) for base in value.__mro__[1:])
            more = "   :inherited-members:\n" if inherits else ""
            directives.append(f".. autoclass:: {place}\n   :members:\n{more}")
        elif callable(value):
            directives.append(f".. autofunction:: {place}\n")
        elif not inspect.ismodule(value):
            directives.append(f".. autodata:: {place}\n")
    return "```{eval-rst}\n" + "\n".join(directives) + "```\n"


def help_of(*verb: str) -> str:
    """Return the help text of a verb without colors and line breaks."""
    command = [sys.executable, "-m", PACKAGE, *verb, "--help"]
    environment = {**os.environ, "COLUMNS": "2000", "NO_COLOR": "1", "TERM": "dumb"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with status {done.returncode}:\n{done.stderr}")
    return re.sub(r"\x1b\[[0-9;]*m", "", done.stdout)


def boxes(text: str) -> tuple[str, list[tuple[str, list[str]]]]:
    """Split a help text into the text above the first box, and the title and lines of each box."""
    above: list[str] = []
    found: list[tuple[str, list[str]]] = []
    for line in text.splitlines():
        if line.startswith("╭"):
            found.append((line.strip("╭─╮ "), []))
        elif line.startswith("│"):
            found[-1][1].append(line[1:-1].rstrip()[1:])
        elif not found:
            above.append(line)
    return "\n".join(above), found


def entries(lines: list[str]) -> tuple[str, list[tuple[str, str]]]:
    """Return the introduction of a box, which ends at a rule, and its options with their descriptions.

    Option names start at the left edge, and descriptions are indented.
    """
    rule = next((number for number, line in enumerate(lines) if line.strip() and not line.strip("─ ")), -1)
    above = lines[: max(rule, 0)]
    about = " ".join(line.strip() for line in takewhile(str.strip, above))
    found: list[tuple[str, str]] = []
    for line in lines[rule + 1 :]:
        if line[:1].strip():
            name, *text = re.split(r"\s{2,}", line.rstrip(), maxsplit=1)
            found.append((name, "".join(text)))
        elif found and line.strip():
            name, what = found[-1]
            found[-1] = name, f"{what} {line.strip()}".strip()
    return about, found


def plain(text: str) -> str:
    """Escape reStructuredText in a text."""
    return re.sub(r"([\\*|`_])", r"\\\1", text)


def verb_section(verb: str, text: str) -> str:
    """Return the section of a verb: usage, description, and its options as ``option`` directives of Sphinx."""
    above, found = boxes(text)
    usage, _, about = above.strip().partition("\n\n")
    usage = re.sub(r"^usage: ", "", usage)
    lines = [f"## `{verb}`", "", "```text", usage, "```", "", escaped(about), "", "```{eval-rst}"]
    lines += [f".. program:: {PACKAGE} {verb}", ""]
    for _, box in found:
        heading, options = entries(box)
        lines += [f"*{plain(heading)}*", ""] if heading else []
        for name, what in options:
            if name != "-h, --help":
                lines += [f".. option:: {name}", "", f"   {plain(what)}", ""]
    return "\n".join([*lines, "```", ""])


def command_line() -> str:
    """Return the page of all verbs, in the order of ``polarguide --help``."""
    top = help_of()
    braces = re.search(r"\{([a-z,\-]+)\}", top)
    if braces is None:
        raise ValueError(f"polarguide --help: expected the verbs in braces, found\n{top}")
    verbs = braces.group(1).split(",")
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        texts = list(pool.map(help_of, verbs))
    return "\n".join(verb_section(verb, text) for verb, text in zip(verbs, texts, strict=True))


def write(path: Path, text: str) -> None:
    """Write a page if its text has changed, so that Sphinx builds no page in vain."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def generate(app: Sphinx) -> None:
    """Write all pages and remove pages of deleted rooms."""
    docs = Path(app.srcdir)
    pages = api_pages(docs)
    api = docs / "reference" / "api"
    for stale in api.glob("*.md"):
        if stale.stem not in pages:
            stale.unlink()
    for name, text in pages.items():
        write(api / f"{name}.md", text)
    write(docs / "generated" / "python.md", public_names())
    write(docs / "generated" / "command-line.md", command_line())


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

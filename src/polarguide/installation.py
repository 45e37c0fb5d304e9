"""How this copy of polarguide was installed, and so which command adds a package that it lacks.

polarguide is not on a package index: a command that names an extra has to name the source folder, too.
"""

from __future__ import annotations

import importlib
import json
import re
import shlex
import shutil
import sys
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

DISTRIBUTIONS = {"skimage": "scikit-image", "websockets": "viser"}
"""What to install for a module of another name: viser works with some versions of websockets only, and brings one."""
_NAME = re.compile(r"[A-Za-z0-9._-]+")
_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


def install_extra(extra: str) -> str:
    """The command that adds an extra to this installation.

    Where there is no source folder, as after the installation of a wheel, the packages of the extra are named.
    """
    source = _source_folder()
    packages = [text for text, of in _requirements() if of == extra]
    if source is None and packages:
        return _pip(*packages)
    return _pip(f"{'.' if source in (None, Path.cwd()) else source}[{extra}]")


def install_package(module: str) -> str:
    """The command that adds the package of a module, in a version that polarguide works with."""
    module = module.partition(".")[0]
    package = _plain(DISTRIBUTIONS.get(module, module))
    known = (
        text for text, _ in _requirements() if (name := _NAME.match(text)) and _plain(name[0]) == package
    )
    return _pip(next(known, package))


def _plain(name: str) -> str:
    """The name of a distribution as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _pip(*packages: str) -> str:
    """A command line of the pip that installs where this program runs: not always the one on the shell's path."""
    found = shutil.which("pip")
    ours = found is not None and Path(found).parent == Path(sys.executable).parent
    return shlex.join([*(["pip"] if ours else [sys.executable, "-m", "pip"]), "install", *packages])


def _source_folder() -> Path | None:
    """The folder of sources that this copy runs or was installed from (PEP 610); None where there is no such folder."""
    metadata = importlib.import_module("importlib.metadata")
    here = Path(__file__).resolve().parents[2]
    if _holds_project(here):
        return here
    try:
        record = metadata.distribution("polarguide").read_text("direct_url.json")
        url = json.loads(record or "{}").get("url", "")
    except (metadata.PackageNotFoundError, ValueError):
        return None
    folder = Path(url2pathname(urlsplit(url).path))
    return folder if url.startswith("file:") and _holds_project(folder) else None


def _holds_project(folder: Path) -> bool:
    """Whether a folder is polarguide's own checkout or source archive."""
    return (folder / "src" / "polarguide").is_dir() and (folder / "pyproject.toml").is_file()


def _requirements() -> list[tuple[str, str]]:
    """What the installed metadata requires: (such as ``viser==1.1.*``, the extra or empty); [] without metadata."""
    metadata = importlib.import_module("importlib.metadata")
    try:
        lines = metadata.requires("polarguide") or []
    except metadata.PackageNotFoundError:
        return []
    found = []
    for line in lines:
        text, _, condition = line.partition(";")
        extra = _EXTRA.search(condition)
        found.append((text.strip(), extra[1] if extra else ""))
    return found

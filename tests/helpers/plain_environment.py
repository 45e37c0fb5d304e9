"""What ``pip install .`` gives in a new environment, without downloading anything again.

Files of the distributions that polarguide declares, and of those that these declare, are linked into an environment of
their own: no extra, and nothing of what the tests use, can be imported there. The demo scene has few of its views.
"""

import csv
import shutil
import venv
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from reduced_demo import write_reduced_demo

import polarguide


def declared() -> dict[str, metadata.Distribution]:
    """The distributions that an installation of polarguide without extras brings, by canonical name.

    Raises:
        PackageNotFoundError: one of them is not installed here.
    """
    found: dict[str, metadata.Distribution] = {}
    seen: set[tuple[str, str]] = set()
    todo = [Requirement("polarguide")]
    while todo:
        wanted = todo.pop()
        name = canonicalize_name(wanted.name)
        found[name] = metadata.distribution(wanted.name)
        for extra in {"", *wanted.extras}:
            if (name, extra) not in seen:
                seen.add((name, extra))
                needs = map(Requirement, found[name].requires or [])
                todo += [
                    need for need in needs if need.marker is None or need.marker.evaluate({"extra": extra})
                ]
    return found


def recorded(distribution: metadata.Distribution) -> list[str]:
    """The files of a distribution, as its record has them: ``distribution.files`` looks for each on the disk."""
    return [row[0] for row in csv.reader((distribution.read_text("RECORD") or "").splitlines())]


def _top(file: str) -> str:
    return file.partition("/")[0]


def make_plain_environment(folder: Path) -> Path:
    """Make the environment; returns the folder of its programs, ``python`` and ``polarguide`` among them."""
    venv.create(folder, symlinks=True)
    site = next(folder.glob("lib/python*/site-packages"))
    wanted = declared()
    others = [d for d in metadata.distributions() if canonicalize_name(d.metadata["Name"]) not in wanted]
    shared = {_top(file) for other in others for file in recorded(other)}
    for distribution in wanted.values():
        files = [file for file in recorded(distribution) if _top(file) not in ("..", "polarguide")]
        # A folder at once where it is of the wanted distributions alone: PyTorch has ten thousand files.
        for name in {file if _top(file) in shared else _top(file) for file in files}:
            link = site / name
            if not link.exists():
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(str(distribution.locate_file(name)))
    # The files that the tests import, compiled ones too. What the demo does takes as long as it has views.
    package = Path(polarguide.__file__).parent
    shutil.copytree(package, site / "polarguide", ignore=shutil.ignore_patterns("demo"))
    write_reduced_demo(site / "polarguide" / "data" / "demo")
    program = folder / "bin" / "polarguide"
    program.write_text(
        f"#!{folder / 'bin' / 'python'}\nimport sys\nfrom polarguide.__main__ import main\nsys.exit(main())\n"
    )
    program.chmod(0o755)
    return folder / "bin"

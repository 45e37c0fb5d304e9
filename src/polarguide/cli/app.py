"""The command line: verbs by name, loaded when they are called, and the one place where errors are printed."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any, get_type_hints

import tyro
from rich.console import Console

from polarguide import __version__
from polarguide.cli.console import printable, warnings_printed
from polarguide.errors import PolarguideError

VERBS = {
    "demo": "demo",
    "calibrate": "calibrate",
    "prepare": "prepare",
    "inspect": "inspect",
    "train": "train",
    "eval": "evaluate",
    "render": "render",
    "view": "view",
    "present": "present",
    "share": "share",
    "export": "export",
    "priors": "priors",
    "measure": "measure",
    "compare": "compare",
    "ablate": "ablate",
    "synth": "synth",
    "bench": "bench",
    "tables": "tables",
}
"""The module of each verb, whose function has the module's name. None of them imports torch before it is called."""
DESCRIPTION = (
    "Photographs through a linear polarizer to a 3D Gaussian splatting scene with separated reflections, surface "
    "normals and diffuse color."
)


def function_of(verb: str) -> Callable[..., Any]:
    """What a verb calls; its signature and docstring are the verb's options and help."""
    module = importlib.import_module(f"polarguide.cli.{VERBS[verb]}")
    function: Callable[..., Any] = getattr(module, VERBS[verb])
    # Options that several verbs share are the fields of dataclasses, and are called as these are.
    return tyro.conf.configure(tyro.conf.OmitArgPrefixes)(function)


def options_of(function: Callable[..., Any]) -> list[str]:
    """Names of all parameters, those in dataclasses included."""
    names = []
    for name, kind in get_type_hints(function).items():
        names += (
            [field.name for field in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else [name]
        )
    return names


def run(arguments: Sequence[str]) -> int:
    """Run a command line; returns the exit status (0 done, 1 stopped, 2 wrong input, or what the verb says)."""
    errors = Console(stderr=True, highlight=False, soft_wrap=True)
    if list(arguments) == ["--version"]:
        print(f"polarguide {__version__}")
        return 0
    verb = arguments[0] if arguments and arguments[0] in VERBS else None
    try:
        with warnings_printed():
            status = _call(verb, arguments)
    except PolarguideError as error:
        errors.print("[bold red]error:[/] ", end="")
        errors.print(printable(_as_flag(error, verb)), markup=False)
        return 2
    except KeyboardInterrupt:
        errors.print("stopped.")
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except OSError as error:  # missing rights, a full disk, a file where a folder should be
        errors.print("[bold red]error:[/] ", end="")
        said = (
            f"{error.filename or 'files'}: expected to read or write there, found {error.strerror or error}."
        )
        errors.print(printable(f"{said} Check the name, the rights, and the room on the disk."), markup=False)
        return 2
    return status


def _call(verb: str | None, arguments: Sequence[str]) -> int:
    """Call a verb; returns the exit status that it gives, 0 where it gives none."""
    if verb is not None:
        found = tyro.cli(function_of(verb), prog=f"polarguide {verb}", args=arguments[1:])
        return found if isinstance(found, int) else 0
    if arguments and not arguments[0].startswith("-"):
        raise PolarguideError(
            arguments[0],
            expected=f"a verb: {', '.join(VERBS)}",
            found="none of them",
            remedy=_near(arguments[0]) or "polarguide --help says what they do.",
        )
    verbs = {name: function_of(name) for name in VERBS}
    tyro.extras.subcommand_cli_from_dict(
        verbs, prog="polarguide", description=DESCRIPTION, args=arguments, sort_subcommands=False
    )
    return 0


def _near(word: str) -> str:
    """A hint for a word that is nearly a verb; also for what other programs call it."""
    others = {
        "evaluate": "eval",
        "test": "eval",
        "viewer": "view",
        "web": "share",
        "new": "demo",
        "check": "inspect",
        "calibration": "calibrate",
    }
    near = difflib.get_close_matches(word.lower(), VERBS, 1, 0.6)
    verb = others.get(word.lower()) or (near[0] if near else "")
    return f"Perhaps polarguide {verb} is meant." if verb else ""


def _as_flag(error: PolarguideError, verb: str | None) -> str:
    """The message; a parameter that is at fault is called as on the command line."""
    text = str(error)
    if verb is not None and error.where in options_of(function_of(verb)):
        return f"--{error.where.replace('_', '-')}{text.removeprefix(error.where)}"
    return text

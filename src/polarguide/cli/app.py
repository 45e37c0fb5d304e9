"""The command line: one verb a file, and the one place where errors are printed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro
from rich.console import Console

from polarguide import __version__
from polarguide.cli.ablate import ablate
from polarguide.cli.compare import compare
from polarguide.cli.demo import demo
from polarguide.cli.evaluate import evaluate
from polarguide.cli.export import export
from polarguide.cli.inspect import inspect
from polarguide.cli.prepare import prepare
from polarguide.cli.priors import priors
from polarguide.cli.render import render_views
from polarguide.cli.share import share
from polarguide.cli.synth import synth
from polarguide.cli.train import train
from polarguide.cli.view import view
from polarguide.errors import PolarguideError

VERBS: dict[str, Callable[..., Any]] = {
    "demo": demo,
    "prepare": prepare,
    "inspect": inspect,
    "train": train,
    "eval": evaluate,
    "render": render_views,
    "view": view,
    "share": share,
    "export": export,
    "priors": priors,
    "compare": compare,
    "ablate": ablate,
    "synth": synth,
}
DESCRIPTION = (
    "Photographs through a linear polarizer to a 3D Gaussian splatting scene with separated reflections, surface "
    "normals and diffuse color."
)


def run(arguments: Sequence[str]) -> int:
    """Run a command line; returns the exit status (0 done, 1 stopped, 2 wrong input)."""
    errors = Console(stderr=True, highlight=False, soft_wrap=True)
    if list(arguments) == ["--version"]:
        print(f"polarguide {__version__}")
        return 0
    try:
        tyro.extras.subcommand_cli_from_dict(
            VERBS, prog="polarguide", description=DESCRIPTION, args=arguments, sort_subcommands=False
        )
    except PolarguideError as error:
        errors.print("[bold red]error:[/] ", end="")
        errors.print(str(error), markup=False)
        return 2
    except KeyboardInterrupt:
        errors.print("stopped.")
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except OSError as error:  # missing rights, a full disk, a file where a folder should be
        errors.print("[bold red]error:[/] ", end="")
        errors.print(f"{error.filename or 'files'}: {error.strerror or error}.", markup=False)
        return 2
    return 0

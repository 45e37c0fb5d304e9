"""The command line: a table of verbs, loaded on demand, and the printing of all errors."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import importlib.util
import io
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import tyro

import polarguide
from polarguide.cli.console import print_error, warnings_printed
from polarguide.core.errors import PolarguideError, import_part
from polarguide.core.system import check_variables, interrupts


class Verb(NamedTuple):
    """A verb of the command line: the location of its function, and the first paragraph of its docstring.

    The list of all verbs shows these summaries without loading a module.
    """

    module: str
    function: str
    summary: str


VERBS = {
    "demo": Verb(
        "polarguide.cli.runs",
        "demo",
        "Train, evaluate and render the small scene that ships with the program.",
    ),
    "run": Verb(
        "polarguide.cli.runs",
        "run_folder",
        "Go from a folder of pictures to a scene in a browser: prepare, inspect, train, eval and view.",
    ),
    "calibrate": Verb(
        "polarguide_shots.verbs",
        "calibrate",
        "Calibrate the polarizers of a polarization camera, from shots of a polarizer in front of the lens.",
    ),
    "scale": Verb(
        "polarguide_shots.verbs",
        "scale",
        "Print a scale of angles for the ring of a polarizing filter: an SVG file in exact millimeters.",
    ),
    "prepare": Verb(
        "polarguide.cli.captures",
        "prepare_capture",
        "Convert camera files to a scene folder: raw mosaics, shots through a rotating filter, "
        "published datasets.",
    ),
    "inspect": Verb(
        "polarguide.cli.captures",
        "inspect_capture",
        "Check a capture and its polarizer angles, and write a page and a JSON file.",
    ),
    "train": Verb(
        "polarguide.cli.runs",
        "train_scene",
        "Train a recipe on a scene.",
    ),
    "eval": Verb(
        "polarguide.cli.runs",
        "evaluate_run",
        "Score a run on its test views and write RUN/metrics.json, and RUN/errors.png with maps of the "
        "errors.",
    ),
    "render": Verb(
        "polarguide.cli.runs",
        "render_run",
        "Render a run's layers to PNG, with a contact sheet next to the ground truth; or along a path, as a "
        "video.",
    ),
    "view": Verb(
        "polarguide.cli.runs",
        "view_in_browser",
        "Show a run in a browser: its layers from any side, next to the photographs. Ctrl-C ends it.",
    ),
    "present": Verb(
        "polarguide.cli.captures",
        "present_folder",
        "Set how a scene or a run is shown and exported: color, up, scale, crop box, credit. Data "
        "and scores stay.",
    ),
    "share": Verb(
        "polarguide.cli.runs",
        "share_run",
        "Write a run as one self-contained web page that renders it with its reflections.",
    ),
    "export": Verb(
        "polarguide.cli.runs",
        "export_run",
        "Export a run to the file formats of other programs.",
    ),
    "priors": Verb(
        "polarguide_shots.verbs",
        "run_priors",
        "Write polarization maps of a shot, many shots or a scene: pictures, numbers and a page.",
    ),
    "measure": Verb(
        "polarguide_shots.verbs",
        "measure",
        "Measure many shots for inspection lines: S0, DoLP and AoLP by region, limits, a golden part.",
    ),
    "compare": Verb(
        "polarguide_bench.verbs",
        "compare_recipes",
        "Train and score several recipes on several scenes, and write tables and a report.",
    ),
    "ablate": Verb(
        "polarguide_bench.verbs",
        "ablate_recipe",
        "Compare a recipe with its ablations. Each ablation changes one thing.",
    ),
    "batch": Verb(
        "polarguide_bench.verbs",
        "batch",
        "Prepare, inspect, train, score, share and export every capture of a collection, with one "
        "overview page.",
    ),
    "synth": Verb(
        "polarguide_synth.verbs",
        "synth",
        "Render a polarized scene with ground truth: a preset (figure, kit, car, cup, water, proof, "
        "...) or a scene file.",
    ),
    "bench": Verb(
        "polarguide_bench.verbs",
        "bench",
        "Render the scenes of the benchmark that are missing, then train and score every recipe on "
        "each scene.",
    ),
    "tables": Verb(
        "polarguide_bench.verbs",
        "tables",
        "Join the records of several comparisons, and write their tables.",
    ),
    "doctor": Verb(
        "polarguide.cli.doctor",
        "doctor",
        "Print what is installed, what computes here, and what is missing, with the command that "
        "installs it.",
    ),
}
"""All verbs by name. No module imports torch before a verb is called."""
DESCRIPTION = (
    "Photographs through a linear polarizer to a 3D Gaussian splatting scene with separated reflections, surface "
    "normals and diffuse color."
)


def function_of(verb: str) -> Callable[..., Any]:
    """Return the function of a verb. Its signature and docstring define the options and the help."""
    function: Callable[..., Any] = getattr(import_part(VERBS[verb].module, verb), VERBS[verb].function)
    # Shared options are fields of dataclasses; their flags have no prefix.
    return tyro.conf.configure(tyro.conf.OmitArgPrefixes)(function)


def summary_of(verb: str) -> Callable[[], None]:
    """Return a function without options whose docstring is the summary of a verb."""

    def listed() -> None: ...

    installed = importlib.util.find_spec(VERBS[verb].module.partition(".")[0])
    listed.__doc__ = VERBS[verb].summary if installed else "(not installed)"
    return listed


def options_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the types of all parameters by name, with the fields of dataclasses."""
    types: dict[str, Any] = {}
    for name, kind in get_type_hints(function).items():
        types |= get_type_hints(kind) if dataclasses.is_dataclass(kind) else {name: kind}
    return types


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return the exit status: 0 done, 1 stopped, 2 wrong input, or the status of the verb."""
    verb = arguments[0] if arguments and arguments[0] in VERBS else None
    before = interrupts()
    for stream in (sys.stdout, sys.stderr):
        # File names may contain bytes that are not text or that the encoding lacks.
        if isinstance(stream, io.TextIOWrapper):
            # In the C locale Python decodes names of files as ASCII, although terminals show UTF-8.
            stream.reconfigure(
                encoding="utf-8" if sys.getfilesystemencoding() == "ascii" else None,
                errors="backslashreplace",
            )
    try:
        with warnings_printed():
            status = call(verb, arguments)
    except PolarguideError as error:
        return _failed(_as_flag(error, verb))
    except KeyboardInterrupt:
        return _stopped()
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except OSError as error:  # missing rights, a full disk, a file where a folder should be
        message = (
            f"{error.filename or 'files'}: expected to read or write there, found {error.strerror or error}."
        )
        return _failed(f"{message} Check the name, the rights, and the room on the disk.")
    except Exception as error:
        if _from_a_signal(error) or interrupts() > before:
            return _stopped()
        message = _system_error_message(error)
        if not message:
            raise
        traceback.clear_frames(error.__traceback__)  # they keep the memory that printing needs
        return _failed(message)
    return status


def _stopped() -> int:
    """Print that a signal ended the command, if stderr is writable, and return the exit status."""
    with contextlib.suppress(OSError):
        print("stopped.", file=sys.stderr)
    return 130


def _from_a_signal(error: BaseException | None) -> bool:
    """Return whether a KeyboardInterrupt caused an error, such as an interrupted import in a package."""
    for _ in range(20):
        if error is None or isinstance(error, KeyboardInterrupt):
            break
        error = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt)


def _failed(text: str) -> int:
    """Print an error, if stderr is writable, and return the exit status."""
    with contextlib.suppress(OSError):
        print_error(text)
    return 2


def _system_error_message(error: Exception) -> str:
    """Return the message for exhausted memory or threads and for packages that cannot be loaded, else an empty text."""
    if isinstance(error, MemoryError) or any(phrase in str(error) for phrase in _RUN_OUT):
        reason = (str(error).splitlines() or ["none is left"])[0]
        return f"memory: expected enough of it, and of threads, found {reason[:200]}. {_MORE_ROOM}"
    if isinstance(error, ModuleNotFoundError):
        return ""
    if isinstance(error, ImportError):
        return f"packages: expected installed ones that can be loaded, found {str(error)[:200]}. {_MORE_ROOM}"
    if _while_loading(error):
        return f"packages: expected installed ones that can be loaded, found {str(error)[:200]}. {_SETTINGS}"
    return ""


def _while_loading(error: Exception) -> bool:
    """Return whether an installed package failed during its import, such as PyTorch with invalid variables."""
    frames = [frame.f_code.co_filename for frame, _ in traceback.walk_tb(error.__traceback__)]
    ours = [number for number, name in enumerate(frames) if name.startswith(_HOME)]
    return any(name.startswith("<frozen importlib") for name in frames[ours[-1] + 1 :]) if ours else False


_RUN_OUT = ("can't start new thread", "can't allocate memory", "not enough memory")
_HOME = str(Path(__file__).parents[1])  # also the prefix of the neighbors' paths
_SETTINGS = "Check the environment's variables for it (env), such as PYTORCH_JIT and TORCH_LOGS."
_MORE_ROOM = "Check this shell's limits (ulimit -a) and what else runs; --threads 1 takes less."


def call(verb: str | None, arguments: Sequence[str]) -> int:
    """Call a verb and return its exit status, by default 0.

    Args:
        verb: name of the verb, or None if the command line begins with another word.
        arguments: words of the command line after the program's name.
    """
    if list(arguments) == ["--version"]:
        print(f"polarguide {polarguide.__version__}", flush=True)
        return 0
    if verb is not None:
        _require_place()
        check_variables()
        _refuse_paths(verb, arguments[1:])
        parsed = tyro.cli(function_of(verb), prog=f"polarguide {verb}", args=arguments[1:])
        return parsed if isinstance(parsed, int) else 0
    if arguments and not arguments[0].startswith("-"):
        raise PolarguideError(
            arguments[0],
            expected=f"a verb: {', '.join(VERBS)}",
            found="none of them",
            remedy=_near(arguments[0]) or "polarguide --help says what they do.",
        )
    verbs = {name: summary_of(name) for name in VERBS}
    tyro.extras.subcommand_cli_from_dict(
        verbs, prog="polarguide", description=DESCRIPTION, args=arguments, sort_subcommands=False
    )
    return 0


def _require_place() -> None:
    """Refuse a current folder that no longer exists. Some packages would end the process without a message."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise PolarguideError(
            "the current folder",
            expected="an existing folder",
            found="that it was removed or renamed",
            remedy="Change to another folder (cd), and repeat the command.",
        ) from None


def _refuse_paths(verb: str, line: Sequence[str]) -> None:
    """Refuse empty paths and null bytes. An unset variable of a shell gives an empty path, which would mean "here".

    Raises:
        PolarguideError: a path is empty or contains a null byte.
    """
    paths = {
        _flag(name) for name, kind in options_of(function_of(verb)).items() if Path in (kind, *get_args(kind))
    }
    for before, word in pairwise(["", *line]):
        option, assigned, value = word.partition("=")
        if not word.startswith("--"):
            option = before if before.startswith("--") else ""
            value = word
        elif not assigned:
            continue
        if (not value or "\0" in value) and (option in paths or not option):
            raise PolarguideError(
                option or "the command line",
                expected="the name of a file or folder",
                found="a null byte" if value else "an empty one",
                remedy="Name it; . is the current folder.",
            )


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _near(word: str) -> str:
    """Return a hint for a misspelled verb, or for its name in other programs."""
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
    """Return the message of an error, with a parameter named as on the command line."""
    text = str(error)
    if verb in (None, error.where) or error.is_path:  # the package of the verb is missing
        return text
    if error.where in options_of(function_of(verb)):
        return f"{_flag(error.where)}{text.removeprefix(error.where)}"
    return text

"""The command line: verbs by name, loaded when they are called, and the one place where errors are printed."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import difflib
import functools
import importlib.util
import io
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

import tyro

import polarguide
from polarguide.cli.console import print_error, warnings_printed
from polarguide.core.errors import PolarguideError, import_part
from polarguide.core.options import gibibytes
from polarguide.core.system import check_variables, interrupts

VERBS = {
    "demo": ("polarguide.cli.runs", "demo"),
    "calibrate": ("polarguide_shots.verbs", "calibrate"),
    "scale": ("polarguide_shots.verbs", "scale"),
    "prepare": ("polarguide.cli.captures", "prepare"),
    "inspect": ("polarguide.cli.captures", "inspect"),
    "train": ("polarguide.cli.runs", "train"),
    "eval": ("polarguide.cli.runs", "evaluate"),
    "render": ("polarguide.cli.runs", "render"),
    "view": ("polarguide.cli.runs", "view"),
    "present": ("polarguide.cli.captures", "present"),
    "share": ("polarguide.cli.runs", "share"),
    "export": ("polarguide.cli.runs", "export"),
    "priors": ("polarguide_shots.verbs", "run_priors"),
    "measure": ("polarguide_shots.verbs", "measure"),
    "compare": ("polarguide_bench.verbs.compare", "compare"),
    "ablate": ("polarguide_bench.verbs.compare", "ablate"),
    "batch": ("polarguide_bench.verbs.batch", "batch"),
    "synth": ("polarguide_synth.verbs", "synth"),
    "bench": ("polarguide_bench.verbs.compare", "bench"),
    "tables": ("polarguide_bench.verbs.compare", "tables"),
    "doctor": ("polarguide.cli.doctor", "doctor"),
}
"""The module and the function of each verb. No module imports torch before a verb is called."""
DESCRIPTION = (
    "Photographs through a linear polarizer to a 3D Gaussian splatting scene with separated reflections, surface "
    "normals and diffuse color."
)


def function_of(verb: str) -> Callable[..., Any]:
    """The function behind a verb; its signature and docstring are the verb's options and help."""
    module, name = VERBS[verb]
    function: Callable[..., Any] = getattr(import_part(module, verb), name)
    # Options that several verbs share are the fields of dataclasses, and are called as these are.
    return tyro.conf.configure(tyro.conf.OmitArgPrefixes)(function)


def summary_of(verb: str) -> Callable[[], None]:
    """A function without options that has the first paragraph of a verb's docstring.

    The list of all verbs shows nothing else: their modules are read, and not loaded.
    """
    module, name = VERBS[verb]

    def listed() -> None: ...

    listed.__doc__ = _summaries(module).get(name, "(not installed)")
    return listed


@functools.cache
def _summaries(module: str) -> dict[str, str]:
    """First paragraphs of docstrings by function, of a module of verbs."""
    package, _, _ = module.partition(".")
    spec = importlib.util.find_spec(module) if importlib.util.find_spec(package) else None
    source = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
    functions = [node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)]
    return {node.name: (ast.get_docstring(node) or "").partition("\n\n")[0] for node in functions}


def options_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Types of all parameters by name, those in dataclasses included."""
    types: dict[str, Any] = {}
    for name, kind in get_type_hints(function).items():
        types |= get_type_hints(kind) if dataclasses.is_dataclass(kind) else {name: kind}
    return types


def run(arguments: Sequence[str]) -> int:
    """Run a command line; returns the exit status (0 done, 1 stopped, 2 wrong input, or what the verb says)."""
    verb = arguments[0] if arguments and arguments[0] in VERBS else None
    before = interrupts()
    for stream in (
        sys.stdout,
        sys.stderr,
    ):  # names of files may have bytes that are no text, or that it cannot say
        if isinstance(stream, io.TextIOWrapper):
            # In the C locale Python takes names of files for ASCII, and terminals show UTF-8 all the same.
            encoding = "utf-8" if sys.getfilesystemencoding() == "ascii" else None
            stream.reconfigure(encoding=encoding, errors="backslashreplace")
    try:
        with warnings_printed():
            status = _call(verb, arguments)
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
        traceback.clear_frames(error.__traceback__)  # they hold the memory, and printing takes some
        return _failed(message)
    return status


def _stopped() -> int:
    """Print that a signal ended the command, if stderr can be written; returns the exit status."""
    with contextlib.suppress(OSError):
        print("stopped.", file=sys.stderr)
    return 130


def _from_a_signal(error: BaseException | None) -> bool:
    """Whether an error is what a package has made of a KeyboardInterrupt, such as C code that imports another."""
    for _ in range(20):
        if error is None or isinstance(error, KeyboardInterrupt):
            break
        error = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt)


def _failed(text: str) -> int:
    """Print an error, if stderr can be written; returns the exit status."""
    with contextlib.suppress(OSError):
        print_error(text)
    return 2


def _system_error_message(error: Exception) -> str:
    """The message where memory or threads have run out, or a package cannot be loaded; empty for other errors."""
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
    """Whether an installed package failed while it was imported, as PyTorch does with variables that it cannot read."""
    frames = [frame.f_code.co_filename for frame, _ in traceback.walk_tb(error.__traceback__)]
    ours = [number for number, name in enumerate(frames) if name.startswith(_HOME)]
    return any(name.startswith("<frozen importlib") for name in frames[ours[-1] + 1 :]) if ours else False


_RUN_OUT = ("can't start new thread", "can't allocate memory", "not enough memory")
_HOME = str(Path(__file__).parents[1])  # also of the neighbors, whose names begin with it
_SETTINGS = "Check the environment's variables for it (env), such as PYTORCH_JIT and TORCH_LOGS."
_MORE_ROOM = "Check this shell's limits (ulimit -a) and what else runs; --threads 1 takes less."


def _call(verb: str | None, arguments: Sequence[str]) -> int:
    """Call a verb; returns the exit status that it gives, 0 where it gives none."""
    if list(arguments) == ["--version"]:
        print(f"polarguide {polarguide.__version__}", flush=True)
        return 0
    if verb is not None:
        _require_place()
        check_variables()
        _refuse_paths(verb, arguments[1:])
        line = _sizes_as_numbers(arguments[1:])
        parsed = tyro.cli(function_of(verb), prog=f"polarguide {verb}", args=line)
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
    """Refuse a current folder that does not exist any more: some packages end the process there, without a word."""
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
    """Refuse what names no file or folder: null bytes, and empty texts, as unset variables of a shell leave them, which
    would mean this folder.

    Raises:
        PolarguideError: there is one.
    """
    paths = {
        _flag(name) for name, kind in options_of(function_of(verb)).items() if Path in (kind, *get_args(kind))
    }
    for place, value in _named_values(line):
        if (not value or "\0" in value) and (place in paths or not place.startswith("--")):
            raise PolarguideError(
                place or "the command line",
                expected="the name of a file or folder",
                found="a null byte" if value else "an empty one",
                remedy="Name it; . is the current folder.",
            )


def _sizes_as_numbers(line: Sequence[str]) -> list[str]:
    """The words with what --memory is given as a number of GiB: 4GB as 3.7252902984619140."""
    converted = list(line)
    for place, word in enumerate(line):
        option, equals, value = word.partition("=")
        if option == "--memory" and equals:
            size = gibibytes(value)
            converted[place] = word if size is None else f"--memory={size!r}"
        elif place and line[place - 1] == "--memory":
            size = gibibytes(word)
            converted[place] = word if size is None else repr(size)
    return converted


def _named_values(line: Sequence[str]) -> Iterator[tuple[str, str]]:
    """The option that each word is a value of, or an empty text, and the value."""
    before = ""
    for word in line:
        name, equals, value = word.partition("=")
        if equals and name.startswith("--"):
            yield name, value
        elif not word.startswith("--"):
            yield before if before.startswith("--") else "", word
        before = word


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


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
    if verb in (None, error.where) or error.is_path:  # a verb as the place: its package is missing
        return text
    if error.where in options_of(function_of(verb)):
        return f"{_flag(error.where)}{text.removeprefix(error.where)}"
    return text

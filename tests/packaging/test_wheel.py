"""The compiled module fits every Linux that manylinux_2_28 stands for, and every Python from 3.10."""

import re
from pathlib import Path

import pytest

from polarguide import _native

elftools = pytest.importorskip("elftools.elf.elffile", reason="no pyelftools -> pip install '.[test]'")

MODULE = Path(_native.__file__)
NEWEST = {"GLIBC": (2, 28), "GLIBCXX": (3, 4, 24), "CXXABI": (1, 3, 11), "GCC": (7, 0, 0)}
"""The newest version of every library's symbols that a system of manylinux_2_28 has (RHEL 8)."""
VERSION = re.compile(r"([A-Z]+)_(\d+(?:\.\d+)*)")

pytestmark = pytest.mark.skipif(MODULE.suffix != ".so", reason="not a system with glibc")


def too_new(versions: list[str], newest: dict[str, tuple[int, ...]] = NEWEST) -> list[str]:
    """Those of a module's symbol versions, such as GLIBC_2.34, that a system with the given ones does not have."""
    matches = [(version, VERSION.fullmatch(version)) for version in versions]
    return [
        version
        for version, match in matches
        if match is None or tuple(map(int, match[2].split("."))) > newest.get(match[1], ())
    ]


def test_symbols_are_those_of_manylinux_2_28() -> None:
    with MODULE.open("rb") as file:
        section = elftools.ELFFile(file).get_section_by_name(".gnu.version_r")
        versions = [each.name for _, needed in section.iter_versions() for each in needed]
    assert len(versions) > 5
    assert any(version.startswith("GLIBC_") for version in versions)
    assert too_new(versions) == []


def test_newer_and_unknown_symbols_would_be_named() -> None:
    versions = [
        "GLIBC_2.2.5",
        "GLIBC_2.28",
        "GLIBC_2.34",
        "CXXABI_1.3.13",
        "GLIBCXX_3.4.24",
        "FOO_1.0",
        "GLIBC_PRIVATE",
    ]
    assert too_new(versions) == ["GLIBC_2.34", "CXXABI_1.3.13", "FOO_1.0", "GLIBC_PRIVATE"]


def test_one_module_is_for_all_versions_of_python() -> None:
    assert MODULE.name == "_native.abi3.so"

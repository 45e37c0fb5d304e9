"""The one exception that means: the user's input or environment is at fault, and this is what to do."""

from __future__ import annotations


class PolarguideError(Exception):
    """A mistake in what was given to the program.

    The message names the file or field, what was expected, what was found, and what to do. The command line
    prints it as one line without a traceback.

    Args:
        where: the file, folder, flag or field.
        expected: what should have been there.
        found: what was there.
        remedy: what to do about it.
    """

    def __init__(self, where: object, *, expected: str, found: str, remedy: str) -> None:
        super().__init__(f"{where}: expected {expected}, found {found}. {remedy}")
        self.where = str(where)
        self.expected = expected
        self.found = found
        self.remedy = remedy

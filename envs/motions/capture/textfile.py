"""Text files of numbers, read line by line, with the line in errors."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

from torchrl_mcp.envs.motions.errors import MotionFormatError

LARGEST_FILE = 64 * 2**20
"""Most bytes of a file: a quarter of an hour of a whole body at 120 Hz."""

LARGEST_NUMBER = 1e7
"""Bound on positions in any unit, and on angles in degrees."""

LARGEST_SKELETON = 1000
"""Most joints of a skeleton."""

LARGEST_MOTION = 5_000_000
"""Most frames times joints of a motion; each takes a few hundred bytes."""


class Statement(NamedTuple):
    """A line, or a part of a line, as words.

    Attributes:
        line: Number of the line, from 1.
        words: One or more words.
    """

    line: int
    words: list[str]


@dataclass(frozen=True)
class TextFile:
    """The text of a motion file.

    Args:
        path: The file.
        text: Content of the file.
    """

    path: Path
    text: str

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a file with any line endings; bytes that are not UTF-8 become replacement characters.

        Raises:
            MotionFormatError: If the file cannot be read, or is too large for a motion.
        """
        path = Path(path)
        try:
            with path.open("rb") as file:
                content = file.read(LARGEST_FILE + 1)
        except (OSError, ValueError) as error:
            raise MotionFormatError(path, f"cannot be read: {error}") from error
        if len(content) > LARGEST_FILE:
            raise MotionFormatError(path, f"is larger than {LARGEST_FILE // 2**20} MiB: split it")
        return cls(path, re.sub(r"\r\n?", "\n", content.decode("utf-8-sig", errors="replace")))

    def statements(self, *, separators: str = "", comment: str = "") -> Iterator[Statement]:
        """Iterate over the non-blank lines, as words.

        Args:
            separators: Characters that are separate statements anywhere in a line.
            comment: Start of comments, which last to the end of the line.
        """
        for number, line in enumerate(self.text.split("\n"), start=1):
            content = line.partition(comment)[0] if comment else line
            parts = re.split(f"([{re.escape(separators)}])", content) if separators else [content]
            yield from (Statement(number, words) for part in parts if (words := part.split()))

    def error(self, message: str, line: int | None = None) -> MotionFormatError:
        """Return an error about this file."""
        return MotionFormatError(self.path, message, line)

    def numbers(self, words: Sequence[str], line: int) -> list[float]:
        """Convert words to finite numbers.

        Raises:
            MotionFormatError: If a word is not a finite number.
        """
        numbers = [parsed(word) for word in words]
        for word, number in zip(words, numbers, strict=True):
            if number is None:
                raise self.error(f"{shortened(word)} is not a number: correct it", line)
            if not abs(number) <= LARGEST_NUMBER:
                kind = "absurdly large" if math.isfinite(number) else "not finite"
                raise self.error(f"{shortened(word)} is {kind}: correct it", line)
        return [number for number in numbers if number is not None]

    def number(self, statement: Statement) -> float:
        """Convert the word after a keyword to a number.

        Raises:
            MotionFormatError: If the number of words is not one.
        """
        [number] = self._following(statement, 1)
        return number

    def vector(self, statement: Statement) -> list[float]:
        """Convert the words after a keyword to three numbers.

        Raises:
            MotionFormatError: If the number of words is not three.
        """
        return self._following(statement, 3)

    def require_size(self, frames: int, joints: int) -> None:
        """Check that a motion fits into memory, because joints without channels take no text.

        Raises:
            MotionFormatError: If the motion is larger than any recording.
        """
        if joints > LARGEST_SKELETON:
            raise self.error(f"has more than {LARGEST_SKELETON} joints: pass a file of one body")
        if frames * joints > LARGEST_MOTION:
            raise self.error(f"has {frames} frames of {joints} joints, which is more than {LARGEST_MOTION}: split it")

    def _following(self, statement: Statement, count: int) -> list[float]:
        keyword, *words = statement.words
        if len(words) != count:
            message = f"{shortened(keyword)} has {len(words)} words after it, but should have {count}: correct it"
            raise self.error(message, statement.line)
        return self.numbers(words, statement.line)


def shortened(word: str) -> str:
    """Quote a word, or its beginning if it is long."""
    return repr(word if len(word) <= 30 else f"{word[:27]}...")


def parsed(word: str) -> float | None:
    """Return a word as a number, or None if it is none."""
    try:
        return float(word)
    except ValueError:
        return None

"""NumPy archives (``.npz``) of plain arrays; reading them runs no code."""

import lzma
import struct
import zlib
from collections.abc import Collection
from pathlib import Path
from tokenize import TokenError
from zipfile import BadZipFile, ZipFile

import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.motions.errors import MotionFormatError

LARGEST = 2**28
"""Most bytes of the arrays of a motion: hours of a T-Rex at 60 frames per second."""

# Exceptions of zipfile, NumPy and torch when a file is damaged or of another kind.
UNREADABLE = (
    *(ArithmeticError, AttributeError, BadZipFile, EOFError, LookupError, MemoryError, OSError, RuntimeError),
    *(SyntaxError, TokenError, TypeError, ValueError, lzma.LZMAError, struct.error, zlib.error),
)


def load_arrays(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Return those of the named arrays that an archive has, or all, after checking their size."""
    with ZipFile(path) as archive:
        sizes = {member.filename.removesuffix(".npy"): member.file_size for member in archive.infolist()}
    wanted = [name for name in sizes if names is None or name in names]
    if (size := sum(sizes[name] for name in wanted)) > LARGEST:
        raise ValueError(f"it would unpack to {size} bytes, more than the {LARGEST} of hours of motion")
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in wanted}


class Archive:
    """An archive of motion capture, whose errors name the file.

    Args:
        path: The file.

    Raises:
        MotionFormatError: If the file is no archive.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            with np.load(self.path, allow_pickle=False) as archive:
                self.names: tuple[str, ...] = tuple(archive.files)
        except UNREADABLE as error:
            raise self.error(f"must be a NumPy archive ({error}): write it again with numpy.savez") from error

    def error(self, message: str) -> MotionFormatError:
        """Return an error about this file."""
        return MotionFormatError(self.path, message)

    def array(self, name: str) -> np.ndarray:
        """Return an array of numbers or text.

        Raises:
            MotionFormatError: If it is absent, damaged or pickled.
        """
        try:
            return load_arrays(self.path, [name])[name]
        except UNREADABLE as error:
            raise self.error(f"its array {name} cannot be read: {error}. Write it as a plain array") from error

    def numbers(self, name: str, *width: int) -> Tensor:
        """Return an array of finite numbers as float64, of shape ``(T, *width)``, T >= 2, if a width is given.

        Raises:
            MotionFormatError: If it is absent, damaged, not finite or of another shape.
        """
        array = self.array(name)
        if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise self.error(f"its array {name} holds a value that is not a finite number: correct it")
        if width and (array.shape[1:] != width or len(array) < 2):
            expected = ", ".join(map(str, width))
            raise self.error(f"its array {name} has shape {array.shape}, but should have (T, {expected}) with T >= 2")
        return torch.from_numpy(array.astype(np.float64))

    def number(self, *names: str) -> float | None:
        """Return the first of the named numbers that the archive has, or None.

        Raises:
            MotionFormatError: If it must be a positive number.
        """
        for name in names:
            if name in self.names:
                values = self.numbers(name)
                if values.numel() != 1 or float(values) <= 0:
                    raise self.error(f"its {name} must be a positive number: correct it")
                return float(values)
        return None

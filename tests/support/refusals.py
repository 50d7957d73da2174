"""Refusals: a call ends with an error whose message names what is wrong; the wording is free."""

import hashlib
import re

import pytest


def contents(folder):
    """Return a digest of every file in a folder and those in it."""
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


def refused(call, *names, error=ValueError, untouched=None):
    """Require that a call is refused with a message in which every name stands as a word; return the message.

    Args:
        call: A function without arguments.
        names: The argument, setting, file or value that is wrong, or the remedy, as a user would write it.
        error: Type of the error.
        untouched: A folder that must have the same files before and after.
    """
    before = untouched and contents(untouched)
    with pytest.raises(error) as refusal:
        call()
    message = str(refusal.value)
    for name in names:
        assert re.search(rf"(?<!\w){re.escape(name)}(?!\w)", message), f"{name!r} is not in {message!r}"
    assert not untouched or contents(untouched) == before
    return message

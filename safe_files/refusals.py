"""The one error that refusing a file raises."""

from __future__ import annotations


class UnsafeFileError(ValueError):
    """A file holds what may not stand in it, is damaged, or is too large: one line that says what.

    Attributes:
        key: the entry of a model file that is at fault, or None.
    """

    def __init__(self, message: str, key: str | None = None) -> None:
        # What a terminal obeys instead of showing it is spelt out.
        signs = (c if c.isprintable() else repr(c)[1:-1] for c in " ".join(message.split()))
        super().__init__("".join(signs))
        self.key = key


def shown(value: object) -> str:
    """A name from a file as a message quotes it: short, and nothing in it that a terminal obeys."""
    text = ascii(value)
    return text if len(text) <= 80 else f"{text[:76]}...'"

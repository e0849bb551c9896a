"""How GRBL 1.1 reads a line: which are refused with which error, and what a good one means."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

_MOTION = {0, 1, 2, 3, 38.2, 80}
_MODES = {17, 18, 19, 20, 21, 90, 91, 91.1, 93, 94, 40, 43.1, 49, 54, 55, 56, 57, 58, 59, 61}
_NON_MODAL = {4, 10, 28, 28.1, 30, 30.1, 53, 92, 92.1}
_M_WORDS = {0, 2, 3, 4, 5, 7, 8, 9, 30}
_GROUPS = {20: 6, 21: 6, 90: 3, 91: 3, 93: 5, 94: 5, 17: 2, 18: 2, 19: 2}
_VALUE_LETTERS = "FIJKLNPRSTXYZ"


class RefusedError(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class Words:
    g: set[float] = field(default_factory=set)
    m: set[int] = field(default_factory=set)
    values: dict[str, float] = field(default_factory=dict)

    @property
    def motion(self) -> float | None:
        return next(iter(self.g & _MOTION), None)


@dataclass
class Modes:
    """What lasts from line to line; a reset brings these back."""

    motion: float = 0
    absolute: bool = True
    inches: bool = False
    feed_mm_min: float = 0.0


def clean(raw: bytes) -> str:
    """Without blanks and comments, in capitals."""
    text = re.sub(r"\([^)]*\)|;.*|\(.*", "", raw.decode("latin-1"))
    return re.sub(r"[\s/]", "", text).upper()


def read_words(line: str) -> Words:
    words = Words()
    groups: set[int] = set()
    at = 0
    while at < len(line):
        letter = line[at]
        if not letter.isalpha():
            raise RefusedError(1)
        number = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)").match(line, at + 1)
        if number is None:
            raise RefusedError(2)
        value = float(number[0])
        at = number.end()
        if letter == "G":
            if value not in _MOTION | _MODES | _NON_MODAL:
                raise RefusedError(20)
            if value in _MOTION | {10, 28, 30, 92} and words.g & (_MOTION | {10, 28, 30, 92}):
                raise RefusedError(24)
            group = _GROUPS.get(int(value), 0)
            if group and group in groups:
                raise RefusedError(21)
            groups.add(group)
            words.g.add(value)
        elif letter == "M":
            if int(value) not in _M_WORDS:
                raise RefusedError(20)
            words.m.add(int(value))
        elif letter not in _VALUE_LETTERS:
            raise RefusedError(20)
        elif letter in words.values:
            raise RefusedError(25)
        else:
            words.values[letter] = value
    return words


def target_mm(words: Words, modes: Modes, machine_mm: float, offset_mm: float) -> float:
    """Machine coordinate that X asks for."""
    if "X" not in words.values:
        return machine_mm
    inches = 20 in words.g or (modes.inches and 21 not in words.g)
    x = words.values["X"] * (25.4 if inches else 1.0)
    absolute = 90 in words.g or (modes.absolute and 91 not in words.g)
    if not absolute:
        return machine_mm + x
    return x if 53 in words.g else x + offset_mm

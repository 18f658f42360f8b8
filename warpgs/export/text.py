"""Bytes as text in a ``<script>`` element of a UTF-8 page: 8 / 7 of their size, where base64 takes 4 / 3.

A character holds seven bits. A page may hold every character below 128 as it is, except NUL, which browsers replace,
CR, which becomes LF, and <, which could end the element. One of these and the character after it become one character
between 128 and 511, which takes two bytes in UTF-8, as they would; a last one becomes 512 plus itself.
"""

import re

import numpy as np

REPLACED = "\0\r<"
"""Characters that a page cannot hold."""


def to_text(data: bytes) -> str:
    """Encodes bytes as text without the characters of ``REPLACED``."""
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    groups = np.pad(bits, (0, -len(bits) % 7)).reshape(-1, 7)
    characters = (np.packbits(groups, axis=1) >> 1).tobytes().decode("ascii")
    return re.sub(f"([{REPLACED}])(.?)", _replacement, characters, flags=re.DOTALL)


def _replacement(match: re.Match[str]) -> str:
    first, second = match[1], match[2]
    return chr(128 * (1 + REPLACED.index(first)) + ord(second)) if second else chr(512 + ord(first))


def from_text(text: str) -> bytes:
    """Decodes the bytes that ``to_text`` encoded, as the player does."""
    values: list[int] = []
    for code in map(ord, text):
        if 128 <= code < 512:
            values.append(ord(REPLACED[code // 128 - 1]))
        values.append(code % 128)
    bits = np.unpackbits(np.array(values, np.uint8)[:, None], axis=1)[:, 1:].reshape(-1)
    return np.packbits(bits[: len(bits) // 8 * 8]).tobytes()

"""Damage to files at random, whatever is in them: for long runs, where hypothesis would be too slow."""

import random
import re

_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{2,}")
_NUMBERS = (
    *(b"0", b"-1", b"1e999", b"-1e308", b"1e-320", b"nan", b"-inf", b"NaN", b"Infinity", b"1" * 400, b"0x10"),
    *(b"2147483648", b"9223372036854775808", b"true", b"null", b'"1"', b"", b"1,5", b"\xd9\xa3", b"1_0"),
)
_SIGNS = tuple(bytes([sign]) for sign in b"[]{}()\",:=\n\r\t#'%&*!\0")
_DEEP = (b"[" * 5000, b'{"a":' * 3000, b"(" * 5000, b"{a=" * 3000, b"\n " * 3000)


def damaged(rng: random.Random, good: bytes, others: tuple[bytes, ...]) -> bytes:
    """A file with one to six things done to it."""
    data = good
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 6))):
        data = rng.choice(_DAMAGES)(rng, data, rng.choice(others))
    return data


def _bytes(rng: random.Random, data: bytes, _: bytes) -> bytes:
    changed = bytearray(data)
    for _count in range(rng.choice((1, 1, 2, 8))):
        if changed:
            # Most of what is not pixels comes first.
            at = rng.randrange(min(len(changed), rng.choice((64, 700, 10**9))))
            changed[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, changed[at] ^ 1 << rng.randrange(8)))
    return bytes(changed)


def _word_of_bytes(rng: random.Random, data: bytes, _: bytes) -> bytes:
    at = rng.randrange(len(data) + 1)
    new = rng.choice((b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\0\0\1", b"\xff\xff", b"\0\0"))
    return data[:at] + new + data[at + len(new) :]


def _cut_end(rng: random.Random, data: bytes, _: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _stretch(rng: random.Random, data: bytes, other: bytes) -> bytes:
    start = rng.randrange(len(data) + 1)
    stop = min(len(data), start + rng.choice((1, 4, 40, 400)))
    at = rng.randrange(len(other) + 1)
    new = rng.choice((b"", data[start:stop] * 2, other[at : at + stop - start]))
    return data[:start] + new + data[stop:]


def _number(rng: random.Random, data: bytes, _: bytes) -> bytes:
    return _replaced(rng, _NUMBER, data, rng.choice(_NUMBERS))


def _word(rng: random.Random, data: bytes, other: bytes) -> bytes:
    words = _WORD.findall(other) or [b"word"]
    return _replaced(rng, _WORD, data, rng.choice((*words, b"nan", b"\xff\xfe", b"\xed\xb3\xbf", b"x" * 70000)))


def _lines(rng: random.Random, data: bytes, other: bytes) -> bytes:
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    what = rng.randrange(4)
    if what == 0:
        lines[i], lines[j] = lines[j], lines[i]
    elif what == 1:
        lines.insert(i, lines[j])
    elif what == 2:
        lines.insert(i, rng.choice(other.split(b"\n")))
    else:
        del lines[i]
    return b"\n".join(lines)


def _deep(rng: random.Random, data: bytes, _: bytes) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice((*_DEEP, *_SIGNS)) + data[at:]


def _replaced(rng: random.Random, pattern: re.Pattern[bytes], data: bytes, new: bytes) -> bytes:
    found = list(pattern.finditer(data))
    if not found:
        return data
    match = rng.choice(found)
    return data[: match.start()] + new + data[match.end() :]


_DAMAGES = (_bytes, _bytes, _word_of_bytes, _cut_end, _stretch, _number, _number, _word, _lines, _deep)

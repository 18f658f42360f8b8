"""Finding the files that an index lists, also where its names come from another system.

Names may have the separators of Windows (``images\\a.png``), folders of another machine (``C:\\scan\\images\\a.png``),
umlauts that a Mac decomposed, other capitals (A.PNG), escapes of addresses (``my%20scan/a.png``), or the suffix from
before images were converted to JPEG. A file is found by such a name only if exactly one fits.
"""

import difflib
import itertools
import os
import unicodedata
from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from urllib.parse import unquote

from warpgs.files import first_file

from .skipped import IMAGE_SUFFIXES

MAX_PATH = 1024
"""Maximum length of a name that an index lists."""

MAX_SEARCHED = 20_000
"""Maximum number of files that are looked at for a message about a missing one."""

NUM_SHOWN = 3
"""Maximum number of file names in such a message."""

Parts = tuple[str, ...]


def find_file(folder: Path, name: str, endings: Sequence[str] = ("",), is_image: bool = False) -> Path | None:
    """The file that ``name`` means in a folder; None if none or several fit.

    Args:
        folder: Folder that names are relative to.
        name: Path as an index lists it.
        endings: What the name may lack, the first ones preferred.
        is_image: Whether the file may have the suffix of another image format, and an absolute path may name a file in
            the folder itself.
    """
    try:
        exact = first_file(folder / f"{name}{ending}" for ending in endings)
    except (OSError, ValueError):  # a name that is too long, or has a null character
        return None
    if exact is not None:
        return exact
    for parts in itertools.chain.from_iterable(_ends(folder, spelled, is_image) for spelled in _spellings(name)):
        if (found := _descend(folder, parts, endings, is_image)) is not None:
            return found
    return None


def without_image_suffix(name: str) -> str:
    """A path without the suffix of an image; other dots are a part of the name."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in IMAGE_SUFFIXES else name


class ListedFiles:
    """The files in a folder that an index lists.

    Args:
        folder: Folder that names are relative to.
        index: Name of the index, for messages.
    """

    def __init__(self, folder: Path, index: str) -> None:
        self.folder, self._index = folder, index
        self._names: dict[Path, str] = {}
        self._respelled: dict[str, Path] = {}

    def find(self, name: str, endings: Sequence[str] = ("",), is_image: bool = False) -> Path | None:
        """``find_file``, which finds no file by two different names unless both are exact."""
        found = find_file(self.folder, name, endings, is_image)
        if found is None:
            return None
        is_exact = any(found == self.folder / f"{name}{ending}" for ending in endings)
        plain = "/".join(next(_spellings(name)))
        if self._names.setdefault(found, plain) != plain and not is_exact:
            return None
        if not is_exact:
            self._respelled.setdefault(name, found)
        return found

    def as_stored(self, name: str) -> str:
        """A name that was found, as the folder spells it: times and order are those of the file itself."""
        path = self._respelled.get(name)
        return name if path is None else Path(os.path.relpath(path, self.folder)).as_posix()

    @property
    def found(self) -> Collection[Path]:
        """The files that were found so far."""
        return self._names.keys()

    def missing(self, name: str, reason: str) -> str:
        """Message that a file is missing, why it is needed, and which files are near."""
        return f"{self.folder / name} is missing: {reason}{_near(self.folder, name)}"

    @property
    def notes(self) -> tuple[str, ...]:
        """A note on names that are spelled otherwise in the folder, if there are any."""
        if not self._respelled:
            return ()
        name, path = next(iter(self._respelled.items()))
        count, shown = len(self._respelled), os.path.relpath(path, self.folder)
        names = "a file name" if count == 1 else f"{count} file names"
        return (
            f"{names} in {self._index} differ from the files in spelling or place, such as {name}, read as {shown}"
            f"{_unseen_difference(name, shown)}",
        )


def _unseen_difference(name: str, shown: str) -> str:
    """How two names differ that look the same, as the end of a sentence; empty if they do not look the same."""
    if name.strip() == shown:
        return " without the blanks around it"
    if unicodedata.normalize("NFC", name) == unicodedata.normalize("NFC", shown):
        return ", in which letters with accents are stored differently (Unicode NFC or NFD)"
    same = unicodedata.normalize("NFKC", name) == unicodedata.normalize("NFKC", shown)
    return ", in which blanks or other characters are of another kind" if same else ""


def _spellings(name: str) -> Iterator[Parts]:
    """The parts of a path; absolute paths begin with "/"."""
    text = name.strip()
    decoded = unquote(text)
    for spelled in (text,) if decoded == text or ".." in decoded else (text, decoded):  # loaders looked for .. in text
        plain = spelled.removeprefix("file://").replace("\\", "/")
        has_drive = plain[1:3] == ":/"
        parts = [part for part in plain[2 * has_drive :].split("/") if part not in ("", ".")]
        yield ("/", *parts) if plain.startswith("/") or has_drive else tuple(parts)


def _ends(folder: Path, parts: Parts, is_image: bool) -> Iterator[Parts]:
    """What a path may mean in a folder: all of it, or an end of it.

    An end follows the name of the folder, or is one of an absolute path of at least two parts (one for images): the
    name of a mask alone could belong to an image.
    """
    is_absolute = parts[:1] == ("/",)
    if not is_absolute:
        yield parts
    name = _key(folder.resolve().name)
    for k in range(1, len(parts)):
        is_long = k == 1 or len(parts) - k >= (1 if is_image else 2)
        if _key(parts[k - 1]) == name or (is_absolute and is_long):
            yield parts[k:]


def _descend(folder: Path, parts: Parts, endings: Sequence[str], is_image: bool) -> Path | None:
    """The file that a path means from a folder on."""
    *folders, name = parts or ("",)
    for part in folders:
        step = folder.parent if part == ".." else _entry(folder, part)
        if step is None:
            return None
        folder = step
    for ending in endings:
        found = _entry(folder, f"{name}{ending}")
        if found is not None and found.is_file():
            return found
    if not is_image:
        return None
    names = (stem + suffix for stem in (without_image_suffix(name), name) for suffix in ("", *IMAGE_SUFFIXES))
    others = {found for name in names if (found := _entry(folder, name)) and found.is_file()}
    return others.pop() if len(others) == 1 else None


def _entry(folder: Path, name: str) -> Path | None:
    """The only file or folder in a folder whose name is written like ``name``, apart from case and composition."""
    try:
        modified = folder.stat().st_mtime_ns
    except OSError:
        return None
    names = _listing(folder, modified).get(_key(name), [])
    composed = unicodedata.normalize("NFC", name)
    same = [found for found in names if unicodedata.normalize("NFC", found) == composed]
    chosen = [name] if name in names else same or names
    return folder / chosen[0] if len(chosen) == 1 else None


@lru_cache(64)
def _listing(folder: Path, modified: int) -> dict[str, list[str]]:
    """The names in a folder by their keys, remembered until the folder changes."""
    found: dict[str, list[str]] = {}
    for name in _names(folder):
        found.setdefault(_key(name), []).append(name)
    return found


def _names(folder: Path) -> list[str]:
    try:
        return sorted(os.listdir(folder))
    except OSError:  # no folder, or one that cannot be read
        return []


def _key(name: str) -> str:
    """A name apart from case, composition, and kinds of spaces."""
    return unicodedata.normalize("NFKC", name).casefold()


def _near(folder: Path, name: str) -> str:
    """The end of a message about a missing file: one of its name elsewhere, similar names, or its folder's names."""
    parts = [part for part in next(_spellings(name)) if part != "/"]
    same = [
        path for path in itertools.islice(_search(folder), MAX_SEARCHED) if parts and _key(path.name) == _key(parts[-1])
    ]
    if same:
        return f"; there is {', '.join(os.path.relpath(path, folder) for path in same[:NUM_SHOWN])}"
    here = folder
    for part in parts[:-1]:
        step = _entry(here, part)
        if step is None or not step.is_dir():
            break
        here, parts = step, parts[1:]
    shown, names = os.path.relpath(here, folder), [n for n in _names(here) if not n.startswith(".")]
    where = str(here) if shown == "." else shown
    if not names:
        return f"; {where} is empty" if here.is_dir() else f"; there is no folder {here}"
    close = difflib.get_close_matches(parts[0] if parts else "", names[:MAX_SEARCHED], NUM_SHOWN)
    if close:
        return f"; {where} has {', '.join(close)}"
    more = f" and {len(names) - NUM_SHOWN} more" if len(names) > NUM_SHOWN else ""
    return f"; {where} has {', '.join(names[:NUM_SHOWN])}{more}"


def _search(folder: Path) -> Iterator[Path]:
    """The files of a folder and of the folders in it."""
    for parent, folders, names in itertools.islice(os.walk(folder), MAX_SEARCHED):
        folders.sort()
        yield from (Path(parent) / name for name in sorted(names))

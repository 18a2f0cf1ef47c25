"""XML from outside, checked while it is copied: no DTD, no entities, limits on length, expansion and depth."""

import bz2
import gzip
import zlib
from pathlib import Path
from typing import IO, Any
from xml.sax import SAXException, SAXParseException
from xml.sax.handler import ContentHandler

import defusedxml.sax
from defusedxml import DefusedXmlException

from uavmec_jax.errors import UserError
from uavmec_jax.files.locations import reason_of
from uavmec_jax.files.reading import open_regular, size_in_words

MAX_BYTES = 4 * 2**30
"""Longest file, decompressed: a compressed file of a few kilobytes can expand to any length."""

MAX_EXPANSION = 60
"""Most bytes that a compressed byte may become, once ``FREE_BYTES`` are exceeded; maps reach 10 to 25."""

FREE_BYTES = 4 * 2**20

MAX_DEPTH = 40
"""Deepest nesting of elements."""


class RefusedError(Exception):
    """A file holds something that is not allowed; raised by handlers."""


def copy_xml(source: Path, target: Path, handler: "CheckingHandler", error: type[UserError]) -> None:
    """Copy an XML file, decompressed, while a handler checks its elements.

    Args:
        source: plain, gzip or bzip2; its name does not matter.
        target: the copy; after an error it is incomplete.
        handler: its errors (:class:`RefusedError`) refuse the file.
        error: the type of the errors.

    Raises:
        UserError: the file cannot be read, is no regular file, is not XML, is truncated, too long, nested too deep or
            compressed too much, declares a DTD or entities, or is refused by the handler; of the type ``error``.
    """
    try:
        with open_regular(source) as raw, target.open("wb") as copy:
            defusedxml.sax.parse(_Tee(raw, copy), handler, forbid_dtd=True)
    except DefusedXmlException:
        raise error(f"{source}: declares a DTD or entities, which are refused; export it without them") from None
    except SAXParseException as problem:
        where = f"line {problem.getLineNumber()}: {problem.getMessage()}"
        raise error(f"{source}: is not XML, or is truncated ({where})") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as problem:
        raise error(f"{source}: is truncated or damaged: {problem}") from None
    except LookupError as problem:
        raise error(f"{source}: is in an encoding that is not known ({problem}); save it as UTF-8") from None
    except RefusedError as problem:
        raise error(f"{source}: {problem}") from None
    except OSError as problem:
        raise error(f"{source}: cannot be read: {reason_of(problem)}") from None
    except (SAXException, ValueError) as problem:  # UnicodeError among them
        raise error(f"{source}: is not XML: {problem}") from None


class CheckingHandler(ContentHandler):
    """Limits the depth of elements; what it is derived for checks them in :meth:`check`."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def startElement(self, name: str, attrs: Any) -> None:  # noqa: N802  (SAX's name)
        """Count the depth, and check the element."""
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise RefusedError(f"nests elements more than {MAX_DEPTH} deep")
        self.check(name, attrs)

    def endElement(self, name: str) -> None:  # noqa: N802  (SAX's name)
        """Count the depth."""
        self._depth -= 1

    def check(self, name: str, attrs: Any) -> None:
        """Check an element and its attributes.

        Raises:
            RefusedError: it is not allowed.
        """


def _decompress(raw: IO[bytes]) -> Any:
    magic = raw.read(3)
    raw.seek(0)
    if magic[:2] == b"\x1f\x8b":
        return gzip.GzipFile(fileobj=raw)
    return bz2.BZ2File(raw) if magic == b"BZh" else raw


class _Tee:
    """A file whose contents are decompressed and written to another file as they are read."""

    def __init__(self, raw: IO[bytes], copy: IO[bytes]) -> None:
        self._raw, self._copy, self._bytes = raw, copy, 0
        self._source = _decompress(raw)

    def read(self, size: int = -1) -> bytes:
        chunk: bytes = self._source.read(size)
        self._bytes += len(chunk)
        if self._bytes > MAX_BYTES:
            raise RefusedError(f"is longer than {size_in_words(MAX_BYTES)}; cut out the area that you need first")
        if self._bytes > FREE_BYTES and self._bytes > MAX_EXPANSION * self._raw.tell():
            raise RefusedError(f"expands to more than {MAX_EXPANSION} times its length; give it without compression")
        self._copy.write(chunk)
        return chunk

    def close(self) -> None:
        """Do nothing: :func:`copy_xml` closes the files that it opened."""

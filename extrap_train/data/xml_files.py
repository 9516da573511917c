"""XML from outside, read with care."""

from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers.expat import ExpatError, ParserCreate

from extrap_train.data.paths import require_file
from extrap_train.errors import InputError

MAX_XML_BYTES = 64 * 2**20
"""Largest file that is parsed: in memory XML takes many times its text."""


def read_xml(path: Path) -> Element:
    """The root of an XML file without entities of its own.

    Raises InputError where it is none, larger than `MAX_XML_BYTES`, or has a document type, whose
    entities may stand for other files or for gigabytes.
    """

    def refuse_doctype(*_: object) -> NoReturn:
        raise InputError(f"{path}: declares a document type; remove its DOCTYPE")

    if require_file(path).stat().st_size > MAX_XML_BYTES:
        raise InputError(f"{path}: has more than {MAX_XML_BYTES >> 20} MiB; export fewer cameras")
    builder = TreeBuilder()
    parser = ParserCreate()
    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(path.read_bytes(), True)
    except (ExpatError, ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is not valid XML ({error}); export it again") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    return builder.close()
